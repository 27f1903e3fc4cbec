/** Which of a file's viewpoints a scene is opened from, and whether one looks around there or turns about something. */

import type { Viewpoints } from "../src/codec/viewpoints.ts";
import { Pose, type Vector, add, dot, unit } from "./pose.ts";

export interface FirstView {
  /** Number of a viewpoint that has much of the scene in its picture, from the side that most viewpoints look from. */
  view: number;
  /** The cameras stand in the middle and look outwards: one looks around there. */
  isInside: boolean;
}

/** Anchors that are looked at, at most: more say nothing else. */
const SAMPLES = 4000;
/** Of the anchors of the viewpoint that has most in its picture: others with as many are as good. */
const AS_GOOD = 0.8;
/** Share of the picture's sides, beyond which an anchor is too near its edge to be counted. */
const EDGE = 0.02;
/** Of the mean of directions: cameras that look to all sides have less. */
const ALL_SIDES = 0.7;
/** Mean cosine between where a camera looks and where it stands, seen from the middle of all. */
const OUTWARDS = 0.2;
/** Of the scene's extent: cameras that stand closer together turn in one place. */
const ONE_PLACE = 0.25;

/**
 * Of the anchors: what so many belong to, in the middle of cameras that look inwards, is what these were around. Few are
 * enough, as the beginning of a file has most of its anchors in the background.
 */
const SURROUNDED = 0.002;

/** `positions`: 3 numbers for each anchor. */
export function firstView(
  positions: ArrayLike<number>,
  viewpoints: Viewpoints | null,
  extent: number,
): FirstView {
  if (!viewpoints) return { view: 0, isInside: false };
  const poses = viewpoints.views.map(({ position, rotation }) => Pose.of([...position] as Vector, rotation));
  const counts = viewpoints.views.map((lens, i) => seen(positions, poses[i]!, lens));
  return { view: amongFullest(poses, counts), isInside: looksOutwards(positions, poses, extent) };
}

/**
 * Of the viewpoints with many anchors in their pictures, the one that looks most as all do: people take most photographs
 * of what they care for from its front.
 */
function amongFullest(poses: Pose[], counts: number[]): number {
  const most = Math.max(...counts);
  const mean = meanOf(poses.map(({ forward }) => forward));
  const agreement = poses.map(({ forward }, i) =>
    counts[i]! >= AS_GOOD * most ? dot(forward, mean) : -Infinity,
  );
  return agreement.indexOf(Math.max(...agreement));
}

function meanOf(vectors: Vector[]): Vector {
  return vectors.reduce((sum, vector) => add(sum, vector, 1 / vectors.length), [0, 0, 0] as Vector);
}

interface Lens {
  width: number;
  height: number;
  fx: number;
  fy: number;
}

/** Anchors in the picture of a viewpoint, of some that stand for all. */
function seen(positions: ArrayLike<number>, pose: Pose, { width, height, fx, fy }: Lens): number {
  const stride = 3 * Math.max(1, Math.floor(positions.length / 3 / SAMPLES));
  const [across, down] = [((0.5 - EDGE) * width) / fx, ((0.5 - EDGE) * height) / fy];
  let count = 0;
  for (let at = 0; at + 2 < positions.length; at += stride) {
    const offset = add([positions[at]!, positions[at + 1]!, positions[at + 2]!], pose.centre, -1);
    const depth = dot(offset, pose.forward);
    if (depth <= 0) continue;
    const [x, y] = [dot(offset, pose.right) / depth, dot(offset, pose.down) / depth];
    if (Math.abs(x) < across && Math.abs(y) < down) count++;
  }
  return count;
}

/** Something stands around a place: a part of all anchors is that near. */
function isAround(positions: ArrayLike<number>, place: Vector, radius: number): boolean {
  const stride = 3 * Math.max(1, Math.floor(positions.length / 3 / SAMPLES));
  let [near, all] = [0, 0];
  for (let at = 0; at + 2 < positions.length; at += stride) {
    all++;
    if (Math.hypot(...add([positions[at]!, positions[at + 1]!, positions[at + 2]!], place, -1)) < radius)
      near++;
  }
  return near > SURROUNDED * all;
}

function looksOutwards(positions: ArrayLike<number>, poses: Pose[], extent: number): boolean {
  if (poses.length < 3) return false;
  if (Math.hypot(...meanOf(poses.map(({ forward }) => forward))) > ALL_SIDES) return false;
  const middle = meanOf(poses.map(({ centre }) => centre));
  const offsets = poses.map(({ centre }) => add(centre, middle, -1));
  const spread = Math.max(...offsets.map((offset) => Math.hypot(...offset)));
  const cosines = poses.map(({ forward }, i) => dot(forward, unit(offsets[i]!)));
  const outwards = cosines.reduce((sum, cosine) => sum + cosine, 0) / cosines.length;
  if (outwards < -OUTWARDS && isAround(positions, middle, spread / 2)) return false;
  return spread < ONE_PLACE * extent || outwards > OUTWARDS;
}
