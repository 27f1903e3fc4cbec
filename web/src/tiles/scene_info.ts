/** What is told about a scene of tiles beside its splats. */

import { cameraCentre } from "../cameras.ts";
import type { Viewpoint, Viewpoints } from "../codec/viewpoints.ts";
import type { SceneInfo } from "../scene_info.ts";
import type { Manifest, Vector } from "./manifest.ts";

/** Anchors and coupled primitives of so many levels of each tile. */
export function countsOf(
  { tiles }: Manifest,
  levels: ArrayLike<number>,
): Pick<SceneInfo, "anchors" | "coupled"> {
  const counts = { anchors: 0, coupled: 0 };
  tiles.forEach((tile, i) => {
    if (!levels[i]) return;
    const { anchors, coupled } = tile.levels[levels[i]! - 1]!;
    counts.anchors += anchors;
    counts.coupled += coupled;
  });
  return counts;
}

/** Before any of it is there. */
export function tilesInfo(manifest: Manifest): SceneInfo {
  const { background, angularDilation, worldOffset } = manifest;
  const whole = countsOf(
    manifest,
    manifest.tiles.map(({ levels }) => levels.length),
  );
  const places = sphereCentres(manifest);
  const range = [0, 1, 2].map((axis) => {
    const sorted = Float64Array.from({ length: places.length / 3 }, (_, n) => places[3 * n + axis]!).sort();
    const at = (share: number): number => sorted[Math.floor(share * (sorted.length - 1))]!;
    return { middle: at(0.5), half: (at(0.9) - at(0.1)) / 2 };
  });
  const middle = range.map((axis) => axis.middle) as Vector;
  const extent = Math.max(...range.map(({ half }) => half), 1e-9);
  const viewpoints = viewpointsOf(manifest, middle, extent);
  return {
    anchors: 0,
    coupled: 0,
    totalAnchors: whole.anchors,
    totalCoupled: whole.coupled,
    background,
    angularDilation,
    worldOffset,
    viewpoints,
    middle,
    extent,
  };
}

/** 3 numbers for each group of anchors. */
export function sphereCentres({ tiles }: Manifest): Float64Array {
  return Float64Array.from(tiles.flatMap(({ spheres }) => [...spheres].filter((_, i) => i % 4 < 3)));
}

function viewpointsOf(
  { viewpoints, worldOffset, up }: Manifest,
  centre: Vector,
  radius: number,
): Viewpoints | null {
  if (!viewpoints.length) return null;
  const views: Viewpoint[] = viewpoints.map((camera) => {
    const { width, height, fx, fy, worldToCamera } = camera;
    const position = cameraCentre(camera).map((x, axis) => x - worldOffset[axis]!) as Vector;
    return { width, height, fx, fy, position, rotation: quaternionOf(worldToCamera) };
  });
  const length = Math.hypot(...up) || 1;
  return { up: up.map((x) => x / length) as Vector, centre, radius, views };
}

/** Unit quaternion w, x, y, z of the rotation of a pose (Shepperd's method: the largest component first). */
function quaternionOf(m: ArrayLike<number>): [number, number, number, number] {
  const [a, b, c] = [m[0]!, m[5]!, m[10]!];
  const squares = [a + b + c, a - b - c, b - a - c, c - a - b];
  const largest = squares.indexOf(Math.max(...squares));
  const [x, y, z] = [m[9]! - m[6]!, m[2]! - m[8]!, m[4]! - m[1]!];
  const [xy, xz, yz] = [m[1]! + m[4]!, m[2]! + m[8]!, m[6]! + m[9]!];
  const rows = [
    [1 + squares[0]!, x, y, z],
    [x, 1 + squares[1]!, xy, xz],
    [y, xy, 1 + squares[2]!, yz],
    [z, xz, yz, 1 + squares[3]!],
  ];
  const row = rows[largest]!;
  const length = Math.hypot(...row);
  return row.map((part) => part / length) as [number, number, number, number];
}
