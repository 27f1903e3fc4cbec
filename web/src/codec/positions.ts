/** The positions section: N distinct integer coordinates. */

import { MAX_DEPTH } from "./constants.ts";
import { FieldReader } from "./fields.ts";
import type { Kernels } from "./kernels.ts";

const ORIGIN_UNIT = 16;
const MAX_ORIGIN_BYTES = 4;
const ANCHORS_PER_BYTE = 4;

export interface Positions {
  depth: number;
  origin: [number, number, number];
  /** [N, 3] coordinates minus the origin */
  offsets: Int32Array;
}

/** The anchors' offsets, in the order of the walk. */
export function readPositions(
  payload: Uint8Array,
  anchors: number,
  mostNodes: number,
  name: string,
  kernels: Kernels,
): Positions {
  const reader = new FieldReader(payload, name);
  const least = Math.ceil(anchors / ANCHORS_PER_BYTE);
  if (payload.length < least) {
    reader.refuse(`${payload.length} bytes, expected at least ${least} for ${anchors} anchors`);
  }
  const depth = reader.u8("depth");
  if (depth > MAX_DEPTH) reader.refuse(`depth is ${depth}, expected 0 to ${MAX_DEPTH}`);
  if (anchors > 8 ** depth) reader.refuse(`${anchors} anchors do not fit into an octree of depth ${depth}`);
  const component = () => ORIGIN_UNIT * reader.signedVarint("origin", -Infinity, Infinity, MAX_ORIGIN_BYTES);
  const origin: [number, number, number] = [component(), component(), component()];
  const { offsets, end } = kernels.walkOctree(payload, reader.position, anchors, depth, mostNodes, name);
  checkPadding(reader, end, least);
  checkFrame(reader, offsets, origin, depth);
  return { depth, origin, offsets };
}

/** Behind the code are zeros, and only as many as the shortest payload needs. */
function checkPadding(reader: FieldReader, end: number, least: number): void {
  const { bytes } = reader;
  if (bytes.length !== Math.max(end, least)) {
    reader.refuse(`${bytes.length} bytes, but the code ends after ${end}`);
  }
  for (let i = end; i < bytes.length; i++) if (bytes[i]) reader.refuse("bytes behind the code are not zero");
}

/** Origin and depth are the ones that the coordinates give, and coordinates have 32 bits. */
function checkFrame(reader: FieldReader, offsets: Int32Array, origin: number[], depth: number): void {
  const smallest = [Infinity, Infinity, Infinity];
  const largest = [0, 0, 0];
  for (let i = 0; i < offsets.length; i += 3) {
    for (let axis = 0; axis < 3; axis++) {
      const offset = offsets[i + axis]!;
      if (offset < smallest[axis]!) smallest[axis] = offset;
      if (offset > largest[axis]!) largest[axis] = offset;
    }
  }
  if (smallest.some((offset) => offset >= ORIGIN_UNIT))
    reader.refuse("origin is not that of the coordinates");
  if (32 - Math.clz32(Math.max(...largest)) !== depth) reader.refuse("depth is not that of the coordinates");
  const leaves = origin.some((o, axis) => o < -(2 ** 31) || o + largest[axis]! > 2 ** 31 - 1);
  if (leaves) reader.refuse("coordinates do not fit into 32 bits");
}
