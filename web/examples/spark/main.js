/** Shows the file of ?url= in Spark. The mouse turns the camera, the keys 1 to 9 go to the file's viewpoints. */

import { Scene, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { CgsMesh, setStage } from "compgs/spark";

const url = new URLSearchParams(location.search).get("url") ?? "../scene.cgs";
const canvas = document.querySelector("canvas");
const renderer = new WebGLRenderer({ canvas });
renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
const scene = new Scene();
const mesh = new CgsMesh(url);
await mesh.initialized;
const camera = setStage(scene, renderer, mesh);
const controls = new OrbitControls(camera, canvas);

function goTo(view) {
  controls.target.copy(mesh.target(view));
  camera.copy(mesh.camera(view, camera.aspect));
}

goTo(0);
addEventListener("keydown", ({ key }) => {
  const view = Number(key) - 1;
  if (mesh.info.viewpoints?.views[view]) goTo(view);
});
renderer.setAnimationLoop(() => renderer.render(scene, camera));

// For those who want to know when the picture is whole.
await mesh.complete;
window.splats = mesh;
