/** Shows the file of ?url= in PlayCanvas. Dragging turns the camera, the keys 1 to 9 go to the file's viewpoints. */

import { Application, Asset, Entity, FILLMODE_FILL_WINDOW, RESOLUTION_AUTO, Vec3 } from "playcanvas";
import { goTo, registerCgs, setStage } from "compgs/playcanvas";

const url = new URLSearchParams(location.search).get("url") ?? "../scene.cgs";
const canvas = document.querySelector("canvas");
const app = new Application(canvas);
app.setCanvasFillMode(FILLMODE_FILL_WINDOW);
app.setCanvasResolution(RESOLUTION_AUTO);
app.start();

// As the engine's own files are loaded: an asset, and an entity that shows it.
registerCgs(app);
const asset = new Asset("scene", "gsplat", { url });
app.assets.add(asset);
await new Promise((resolve, reject) => {
  asset.once("load", resolve);
  asset.once("error", (message) => reject(new Error(message)));
  app.assets.load(asset);
});
const splats = new Entity("splats");
splats.addComponent("gsplat", { asset });
const camera = setStage(app, splats);

addEventListener("keydown", ({ key }) => {
  const view = Number(key) - 1;
  if (asset.resource.info.viewpoints?.views[view]) goTo(camera, splats, view);
});
canvas.addEventListener("pointermove", ({ buttons, movementX, movementY }) => {
  if (!buttons) return;
  const { middle } = asset.resource.info;
  const pivot = splats.getWorldTransform().transformPoint(new Vec3(middle));
  const arm = camera.getPosition().clone().sub(pivot).length();
  camera.rotateLocal(-0.3 * movementY, 0, 0);
  camera.rotate(0, -0.3 * movementX, 0);
  camera.setPosition(pivot.sub(camera.forward.clone().mulScalar(arm)));
});

// For those who want to know when the picture is whole.
await asset.resource.complete;
window.splats = asset.resource;
