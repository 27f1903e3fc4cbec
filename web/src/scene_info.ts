/** What is told about a scene beside its splats, and what a camera starts from. */

import type { Scene } from "./codec/scene_decoder.ts";
import type { Viewpoints } from "./codec/viewpoints.ts";
import type { Predictor } from "./prediction/predictor.ts";

export interface SceneInfo {
  /** Anchors and coupled primitives that are there, and those of the whole file. */
  anchors: number;
  totalAnchors: number;
  coupled: number;
  totalCoupled: number;
  background: [number, number, number];
  angularDilation: number | null;
  worldOffset: [number, number, number];
  viewpoints: Viewpoints | null;
  /** Middle and half extent of most anchors. */
  middle: [number, number, number];
  extent: number;
}

export function sceneInfo(scene: Scene, { positions }: Pick<Predictor, "positions">): SceneInfo {
  const range = [0, 1, 2].map((axis) => {
    const sorted = Float32Array.from({ length: scene.anchors }, (_, n) => positions[3 * n + axis]!).sort();
    const at = (share: number): number => sorted[Math.floor(share * (sorted.length - 1))]!;
    return { middle: at(0.5), half: (at(0.9) - at(0.1)) / 2 };
  });
  const { anchors, totalAnchors, coupled, totalCoupled } = scene;
  const { background, angularDilation, worldOffset, viewpoints } = scene;
  const middle: [number, number, number] = [range[0]!.middle, range[1]!.middle, range[2]!.middle];
  const extent = Math.max(...range.map(({ half }) => half), scene.voxelSize);
  return {
    anchors,
    totalAnchors,
    coupled,
    totalCoupled,
    background,
    angularDilation,
    worldOffset,
    viewpoints,
    middle,
    extent,
  };
}
