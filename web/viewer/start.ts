/** Where a scene is looked at from, before somebody moves. */

import type { SceneInfo } from "../src/scene_info.ts";
import type { Target } from "./controls.ts";
import { Pose, type Vector, add, dot } from "./pose.ts";

/** Radians, of the smaller side, for files without viewpoints. */
export const FIELD_OF_VIEW = 0.9;

/** One of the file's viewpoints, or a place beside the scene where it has none. */
export function startOf(info: SceneInfo, view: number): Target {
  const { middle, extent, viewpoints } = info;
  const start = viewpoints?.views[view];
  if (viewpoints && start) {
    const pose = Pose.of([...start.position], start.rotation);
    const depth = dot(pose.forward, add(middle, pose.centre, -1));
    return { pose, up: viewpoints.up, distance: Math.max(depth, 0.1 * extent) };
  }
  const up: Vector = [0, -1, 0];
  const distance = (2.5 * extent) / Math.tan(FIELD_OF_VIEW / 2);
  const centre = add(add(middle, [0, 0, -1], distance), up, 0.3 * distance);
  return { pose: Pose.lookingAt(centre, middle, up), up, distance };
}
