/** The file's viewpoints for cameras and controls of three.js. */

import { Matrix4, type Object3D, PerspectiveCamera, Vector3 } from "three";
import type { SceneInfo } from "../src/scene_info.ts";
import { NEAR } from "../viewer/splatting.ts";
import { startCamera } from "./viewpoint.ts";

/** Times the extent of the scene, from the camera: beyond it nothing is drawn. */
const FAR = 1_000;

/** A camera at one of the file's viewpoints, that sees all of its picture; its `up` is the scene's, for controls. */
export function viewpointCamera(
  splats: Object3D,
  info: SceneInfo,
  view: number,
  aspect: number,
): PerspectiveCamera {
  const { right, up, back, centre, sceneUp, fieldOfView } = startCamera(info, view, aspect);
  const far = FAR * info.extent + Math.hypot(...centre);
  const camera = new PerspectiveCamera((fieldOfView * 180) / Math.PI, aspect, NEAR, far);
  splats.updateWorldMatrix(true, false);
  new Matrix4()
    .makeBasis(new Vector3(...right), new Vector3(...up), new Vector3(...back))
    .setPosition(...centre)
    .premultiply(splats.matrixWorld)
    .decompose(camera.position, camera.quaternion, new Vector3());
  camera.up.set(...sceneUp).transformDirection(splats.matrixWorld);
  return camera;
}

/** What controls turn about, from one of the file's viewpoints. */
export function viewpointTarget(splats: Object3D, info: SceneInfo, view: number): Vector3 {
  const { back, centre, distance } = startCamera(info, view, 1);
  splats.updateWorldMatrix(true, false);
  return new Vector3(...back)
    .multiplyScalar(-distance)
    .add(new Vector3(...centre))
    .applyMatrix4(splats.matrixWorld);
}
