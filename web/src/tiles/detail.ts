/**
 * How much of each tile a camera needs, and in which order: what would look coarsest comes first.
 *
 * The coarseness of a tile is the distance between neighbouring splats in the picture, in pixels: the tile's size over
 * the root of their number, seen from where the camera is. Nothing but the manifest is needed for it.
 */

import type { TileEntry } from "./manifest.ts";

/** Pixels between splats, below which more of them are not seen. */
const SHARP = 1;
/** Of the coarseness of a tile in view: what somebody sees who turns around. */
const OUT_OF_VIEW = 1 / 64;
/** Of a tile's size: nearer to it, or within it, it does not become more urgent. */
const NEAREST = 0.1;

/** A camera in the frame of the manifest, for a picture in pixels. */
export interface Sight {
  centre: ArrayLike<number>;
  /** 9 numbers, row by row: x_camera = R (x - centre) */
  rotation: ArrayLike<number>;
  width: number;
  height: number;
  fx: number;
  fy: number;
}

/** One more level of a tile. */
export interface Step {
  tile: number;
  /** Levels that are there before. */
  level: number;
  /** Of the tile without this step, pixels. */
  coarseness: number;
}

export interface Plan {
  /** How many levels of each tile are wanted. */
  levels: Int32Array;
  /** How they come about, the coarsest tile first. */
  steps: Step[];
}

/** Length over which the splats of a tile are spread, world units. */
export function sizeOf({ spheres }: Pick<TileEntry, "spheres">): number {
  const groups = spheres.length / 4;
  const radii = Float64Array.from({ length: groups }, (_, i) => spheres[4 * i + 3]!).sort();
  // Of groups of neighbours, each on a piece of a surface; the sky among them must not count.
  return Math.max(radii[groups >> 1]! * Math.sqrt(groups), 1e-30);
}

/** Whether a camera sees any of a tile. */
export function isInView({ spheres }: Pick<TileEntry, "spheres">, sight: Sight): boolean {
  return nearest(spheres, sight)[1];
}

/**
 * `most`: splats of all tiles together. `kept`: levels of each tile that are there; as long as there is room for them
 * they stay, although the camera does not need them.
 */
export function planDetail(
  tiles: readonly TileEntry[],
  sizes: ArrayLike<number>,
  sight: Sight,
  most: number,
  kept: ArrayLike<number>,
): Plan {
  const steps: Step[] = [];
  tiles.forEach(({ levels, spheres }, tile) => {
    const [distance, isSeen] = nearest(spheres, sight);
    const extent = (sight.fx * sizes[tile]!) / Math.max(distance, NEAREST * sizes[tile]!);
    for (let level = 0; level < levels.length; level++) {
      const splats = level ? Math.max(1, levels[level - 1]!.coupled) : 1;
      const coarseness = ((isSeen ? 1 : OUT_OF_VIEW) * extent) / Math.sqrt(splats);
      if (coarseness < SHARP && level >= kept[tile]!) break;
      steps.push({ tile, level, coarseness });
    }
  });
  // What is only kept is less coarse than anything that is needed, and comes last.
  steps.sort((a, b) => b.coarseness - a.coarseness || a.level - b.level);
  const levels = new Int32Array(tiles.length);
  let left = most;
  const taken = steps.filter(({ tile, level }) => {
    const { coupled } = tiles[tile]!.levels[level]!;
    const more = coupled - (level ? tiles[tile]!.levels[level - 1]!.coupled : 0);
    if (levels[tile] !== level || more > left) return false; // of a tile that had no room nothing finer comes
    left -= more;
    levels[tile] = level + 1;
    return true;
  });
  return { levels, steps: taken };
}

/** Distance to the nearest sphere, of those in view if any is; and whether one is. */
function nearest(
  spheres: Float64Array,
  { centre, rotation: r, width, height, fx, fy }: Sight,
): [number, boolean] {
  const [across, down] = [width / 2 / fx, height / 2 / fy];
  const [sideways, upwards] = [Math.hypot(1, across), Math.hypot(1, down)];
  let [seen, any] = [Infinity, Infinity];
  for (let at = 0; at < spheres.length; at += 4) {
    const [x, y, z] = [
      spheres[at]! - centre[0]!,
      spheres[at + 1]! - centre[1]!,
      spheres[at + 2]! - centre[2]!,
    ];
    const radius = spheres[at + 3]!;
    const distance = Math.hypot(x, y, z) - radius;
    if (distance < any) any = distance;
    if (distance >= seen) continue;
    const u = Math.abs(r[0]! * x + r[1]! * y + r[2]! * z);
    const v = Math.abs(r[3]! * x + r[4]! * y + r[5]! * z);
    const depth = r[6]! * x + r[7]! * y + r[8]! * z;
    const isOutside =
      depth < -radius || (u - across * depth) / sideways > radius || (v - down * depth) / upwards > radius;
    if (!isOutside) seen = distance;
  }
  return seen < Infinity ? [seen, true] : [any, false];
}
