/** The file's viewpoints as engines have cameras: y up, looking along -z. */

import type { SceneInfo } from "../src/scene_info.ts";
import { FIELD_OF_VIEW, startOf } from "../viewer/start.ts";

export interface StartCamera {
  /** Columns of the rotation camera to local frame, and the camera's centre. */
  right: [number, number, number];
  up: [number, number, number];
  back: [number, number, number];
  centre: [number, number, number];
  /** What is above, for controls: unlike `up` it is the same for all viewpoints. */
  sceneUp: [number, number, number];
  /** World units to what controls turn about, straight ahead. */
  distance: number;
  /** Radians, from top to bottom. */
  fieldOfView: number;
}

/**
 * One of the file's viewpoints, counted from 0, or a place beside the scene where it has none. All of the viewpoint's
 * picture is seen in a picture of this `aspect`, width by height.
 */
export function startCamera(info: SceneInfo, view: number, aspect: number): StartCamera {
  const { pose, up, distance } = startOf(info, view);
  const lens = info.viewpoints?.views[view];
  const half = Math.tan(FIELD_OF_VIEW / 2);
  const [wide, high] = lens ? [lens.width / (2 * lens.fx), lens.height / (2 * lens.fy)] : [half, half];
  const negated = ([x, y, z]: readonly [number, number, number]): [number, number, number] => [-x, -y, -z];
  return {
    right: pose.right,
    up: negated(pose.down),
    back: negated(pose.forward),
    centre: pose.centre,
    sceneUp: up,
    distance,
    fieldOfView: 2 * Math.atan(Math.max(high, wide / aspect)),
  };
}
