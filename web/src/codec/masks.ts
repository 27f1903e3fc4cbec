/** The masks section: which slots have a coupled primitive. */

import { CorruptSection } from "../errors.ts";
import type { Kernels } from "./kernels.ts";

/** [N, K] 1 where a coupled primitive exists. */
export function readMasks(
  payload: Uint8Array,
  anchors: number,
  slots: number,
  name: string,
  kernels: Kernels,
): Uint8Array {
  if (payload.length === 0) return new Uint8Array(anchors * slots).fill(1);
  const { mask, end } = kernels.decodeMasks(payload, anchors, slots, name);
  if (end !== payload.length) {
    throw new CorruptSection(`${name}: ${payload.length} bytes, but the code ends after ${end}`);
  }
  if (mask.every((flag) => flag === 1))
    throw new CorruptSection(`${name}: all flags are 1, expected no bytes`);
  return mask;
}
