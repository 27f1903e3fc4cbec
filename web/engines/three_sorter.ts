/** The worker that sorts the splats of one scene in plain three.js, from back to front. */

import { DepthOrder, type DepthPart } from "../viewer/depth_order.ts";
import { rowsOf } from "../viewer/splat_planes.ts";
import { NEAR } from "../viewer/splatting.ts";

/** A scene, or a finer one; or from where it is looked at: the third row of the matrix from it to the camera. */
export type ToSorter =
  { kind: "splats"; means: Float32Array } | { kind: "camera"; axis: [number, number, number]; shift: number };

/** Splats in front of the camera, the farthest first. */
export interface FromSorter {
  order: Uint32Array<ArrayBuffer>;
}

declare const self: {
  onmessage: ((event: MessageEvent<ToSorter>) => void) | null;
  postMessage(message: FromSorter, transfer: Transferable[]): void;
};

const depths = new DepthOrder();
let part: DepthPart = partOf(new Float32Array(0));

self.onmessage = ({ data }) => {
  if (data.kind === "splats") {
    part = partOf(data.means);
    return;
  }
  const order = depths.sort([{ ...part, shift: data.shift }], data.axis, 0, NEAR);
  self.postMessage({ order }, [order.buffer]);
};

/** All splats: opacities change with the camera, and the shader leaves out what is not seen. */
function partOf(means: Float32Array): DepthPart {
  const count = means.length / 3;
  const rows = Array.from({ length: rowsOf(count) }, (_, row) => row);
  return {
    means,
    opacities: new Float32Array(count).fill(1),
    sound: new Uint8Array(count).fill(1),
    shift: 0,
    rows,
  };
}
