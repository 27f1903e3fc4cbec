/** What a page and the worker of a live scene say to each other. Everything is in the local frame of the scene. */

import type { SceneInfo } from "../scene_info.ts";
import type { Layout, Layouts } from "./packing.ts";

export type ToWorker =
  | { kind: "open"; layout: Layout; url: string | null; most: number }
  /** Bytes of a file that has no address, in their order; and their end. */
  | { kind: "piece"; bytes: Uint8Array<ArrayBuffer> }
  | { kind: "end" }
  /** Where colors and opacities shall be seen from. */
  | { kind: "eye"; id: number; centre: [number, number, number] };

export type FromWorker =
  | { kind: "progress"; loaded: number; total: number | null }
  /** A scene, or a finer one: takes the place of all splats before it. `eye` is the id of what it is seen from. */
  | {
      kind: "splats";
      info: SceneInfo;
      geometry: Layouts[Layout];
      colors: Uint8Array<ArrayBuffer>;
      eye: number;
    }
  | { kind: "colors"; colors: Uint8Array<ArrayBuffer>; eye: number }
  | { kind: "complete" }
  | { kind: "error"; name: string; message: string };
