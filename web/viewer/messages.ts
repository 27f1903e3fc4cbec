/** What page and worker say to each other. Everything is in the local frame of the scene. */

import type { SceneInfo } from "../src/scene_info.ts";
import type { Sight } from "../src/tiles/detail.ts";
import type { FirstView } from "./first_view.ts";
import type { Vector } from "./pose.ts";

/** Where splats are seen from, as far as the worker needs it. */
export interface Eye {
  /** Rises with each camera; a frame says for which one it is. */
  id: number;
  centre: [number, number, number];
  /** Third row of the rotation: the direction of depth. */
  axis: [number, number, number];
  /** The same for a picture as large as it is at rest. */
  sight: Sight;
}

/** Rows of 2048 primitives that the renderer has. */
export type Rows = number[];

export type ToWorker =
  /** `most`: splats that are wanted; finer parts of the file that would be more are left out. */
  | { kind: "bytes"; bytes: ArrayBuffer; most: number }
  | { kind: "url"; url: string; most: number }
  | { kind: "eye"; eye: Eye }
  /** What is along this ray? `direction` has length one; `pixel`: angle of a pixel, radians. */
  | { kind: "pick"; id: number; origin: Vector; direction: Vector; pixel: number }
  /** The renderer is a new one, and has nothing of the scene. */
  | { kind: "again" };

export type FromWorker =
  | { kind: "progress"; loaded: number; total: number | null }
  | { kind: "scene"; info: SceneInfo; first: FirstView }
  /** More, or less, of a scene of tiles is there. */
  | { kind: "counts"; anchors: number; coupled: number }
  /** World units along the ray, null where there is nothing. */
  | { kind: "picked"; id: number; distance: number | null }
  /** Everything is forgotten; there is room for so many rows. */
  | { kind: "reserve"; rows: number }
  | { kind: "geometry"; planes: Float32Array<ArrayBuffer>; rows: Rows }
  /** Colors and opacities. */
  | { kind: "appearance"; values: Float32Array<ArrayBuffer>; rows: Rows }
  /**
   * Primitives to draw, the farthest first. `settled`: all colors are those of this eye; `sharp`: and everything that
   * it needs is there.
   */
  | { kind: "frame"; id: number; order: Uint32Array<ArrayBuffer>; settled: boolean; sharp: boolean }
  /** Everything is there, or of a scene of tiles everything that the eye at hand needs. */
  | { kind: "complete"; bytes: number }
  /** `head`: the first bytes of the file, as far as there are any. */
  | { kind: "error"; name: string; message: string; head: Uint8Array };
