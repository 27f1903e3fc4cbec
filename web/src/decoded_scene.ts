/** A scene that tells what a camera sees of it. */

import type { Camera } from "./cameras.ts";
import type { Scene } from "./codec/scene_decoder.ts";
import { type Gaussians, gaussiansOf } from "./gaussians.ts";
import { Predictor } from "./prediction/predictor.ts";

export interface DecodedScene extends Scene {
  /**
   * The splats that a camera of the world sees, in the order of the file. Geometry is predicted with the first call and
   * kept; each call predicts opacity and color.
   */
  splatsFor(camera: Pick<Camera, "worldToCamera">): Gaussians;
}

export function withSplats(scene: Scene): DecodedScene {
  let predictor: Predictor | null = null;
  return {
    ...scene,
    splatsFor(camera) {
      predictor ??= new Predictor(scene);
      return gaussiansOf(predictor, scene.worldOffset, camera);
    },
  };
}
