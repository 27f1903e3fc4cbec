/** Shows the file of ?url= in three.js without Spark. The mouse turns the camera, the keys 1 to 9 go to the file's viewpoints. */

import { Scene, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { CgsSplats, setStage } from "compgs/three";

const url = new URLSearchParams(location.search).get("url") ?? "../scene.cgs";
const canvas = document.querySelector("canvas");
const renderer = new WebGLRenderer({ canvas });
renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
const scene = new Scene();
const splats = new CgsSplats(url);
await splats.initialized;
const camera = setStage(scene, renderer, splats);
const controls = new OrbitControls(camera, canvas);

function goTo(view) {
  controls.target.copy(splats.target(view));
  camera.copy(splats.camera(view, camera.aspect));
}

goTo(0);
addEventListener("keydown", ({ key }) => {
  const view = Number(key) - 1;
  if (splats.info.viewpoints?.views[view]) goTo(view);
});
renderer.setAnimationLoop(() => renderer.render(scene, camera));

// For those who want to know when the picture is whole.
await splats.complete;
window.splats = splats;
