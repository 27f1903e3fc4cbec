/** What page and worker say to each other. Everything is in the local frame of the scene. */

import type { Viewpoints } from "../src/codec/viewpoints.ts";

/** Where splats are seen from, as far as the worker needs it. */
export interface Eye {
  /** Rises with each camera; a frame says for which one it is. */
  id: number;
  centre: [number, number, number];
  /** Third row of the rotation: the direction of depth. */
  axis: [number, number, number];
}

export type ToWorker =
  { kind: "bytes"; bytes: ArrayBuffer } | { kind: "url"; url: string } | { kind: "eye"; eye: Eye };

/** What the page shows about a scene, and what a camera starts from. */
export interface SceneInfo {
  anchors: number;
  totalAnchors: number;
  coupled: number;
  background: [number, number, number];
  worldOffset: [number, number, number];
  viewpoints: Viewpoints | null;
  /** Middle and half extent of most anchors. */
  middle: [number, number, number];
  extent: number;
}

export type FromWorker =
  | { kind: "progress"; loaded: number; total: number | null }
  | { kind: "scene"; info: SceneInfo; planes: Float32Array; rows: number }
  /** Primitives to draw, the farthest first; colors and opacities of some rows of them. */
  | {
      kind: "frame";
      id: number;
      order: Uint32Array;
      appearance: Float32Array | null;
      firstRow: number;
      settled: boolean;
    }
  | { kind: "complete"; bytes: number }
  | { kind: "error"; name: string; message: string };
