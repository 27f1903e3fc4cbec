/** The Gaussians of a scene that a camera sees. */

import { type Camera, cameraCentre } from "./cameras.ts";
import type { Scene } from "./codec/scene_decoder.ts";
import { OPACITY_CUTOFF, Predictor } from "./prediction/predictor.ts";

export interface Gaussians {
  /** [M, 3] world units from the scene's `worldOffset` */
  means: Float32Array;
  /** [M, 4] w, x, y, z; not normalized */
  quaternions: Float32Array;
  /** [M, 3] standard deviations, world units */
  scales: Float32Array;
  /** [M] above 1/255 */
  opacities: Float32Array;
  /** [M, 3] red, green, blue; display values 0 to 1 */
  colors: Float32Array;
}

/**
 * What a camera of the world sees, in the order of the file. For many cameras keep a `Predictor`: geometry does not
 * depend on the camera.
 */
export function gaussians(scene: Scene, camera: Pick<Camera, "worldToCamera">): Gaussians {
  return gaussiansOf(new Predictor(scene), scene.worldOffset, camera);
}

/** What a camera sees of a scene whose geometry is there. */
export function gaussiansOf(
  predictor: Predictor,
  worldOffset: ArrayLike<number>,
  camera: Pick<Camera, "worldToCamera">,
): Gaussians {
  const appearance = predictor.newAppearance();
  const centre = cameraCentre(camera).map((x, axis) => x - worldOffset[axis]!);
  predictor.predictAppearance(centre, appearance);
  const { means, quaternions, scales, sound } = predictor.geometry;
  const drawn: number[] = [];
  // Numbers that are not a number are not above anything.
  appearance.opacities.forEach((opacity, p) => {
    if (sound[p] && opacity > OPACITY_CUTOFF && isFinite3(appearance.colors, p)) drawn.push(p);
  });
  const gather = (values: Float32Array, columns: number): Float32Array => {
    const result = new Float32Array(drawn.length * columns);
    drawn.forEach((p, i) => result.set(values.subarray(p * columns, (p + 1) * columns), i * columns));
    return result;
  };
  return {
    means: gather(means, 3),
    quaternions: gather(quaternions, 4),
    scales: gather(scales, 3),
    opacities: gather(appearance.opacities, 1),
    colors: gather(appearance.colors, 3),
  };
}

function isFinite3(values: Float32Array, p: number): boolean {
  return Number.isFinite(values[3 * p]! + values[3 * p + 1]! + values[3 * p + 2]!);
}
