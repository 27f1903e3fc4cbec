/** The prediction heads section: named tensors (docs/bitstream.md, "Prediction heads"). */

import {
  MAX_EXPONENT,
  MAX_LAYER_WIDTH,
  MAX_NAME_BYTES,
  MAX_RANK,
  MAX_TENSORS,
  MAX_WEIGHTS,
} from "./constants.ts";
import { FieldReader } from "./fields.ts";
import { readArrays } from "./integer_arrays.ts";
import type { Kernels } from "./kernels.ts";

export interface Tensor {
  shape: number[];
  /** A parameter is its integer times 2^-exponent. */
  exponent: number;
  values: Int32Array;
}

export function readHeads(payload: Uint8Array, name: string, kernels: Kernels): Map<string, Tensor> {
  const reader = new FieldReader(payload, name);
  const count = reader.varint("tensors", 0, MAX_TENSORS);
  const heads: Array<{ name: string; shape: number[]; exponent: number; size: number }> = [];
  let previous: Uint8Array = new Uint8Array(0);
  let elements = 0;
  for (let i = 0; i < count; i++) {
    previous = readName(reader, previous);
    const tensorName = decodeText(previous, reader);
    if (heads.some((head) => head.name === tensorName)) reader.refuse(`tensor ${tensorName} is there twice`);
    const rank = reader.varint("rank", 0, MAX_RANK);
    const shape: number[] = [];
    for (let side = 0; side < rank; side++) shape.push(reader.varint("side", 0, MAX_LAYER_WIDTH));
    const exponent = reader.signedVarint("exponent", -MAX_EXPONENT, MAX_EXPONENT);
    const size = shape.reduce((a, b) => a * b, 1);
    elements += size;
    if (elements > MAX_WEIGHTS) reader.refuse(`more than ${MAX_WEIGHTS} elements of tensors`);
    heads.push({ name: tensorName, shape, exponent, size });
  }
  const arrays = count
    ? readArrays(
        reader,
        heads.map((head) => head.size),
        kernels,
      )
    : [];
  reader.end();
  return new Map(
    heads.map(({ name, shape, exponent }, i) => [name, { shape, exponent, values: arrays[i]! }]),
  );
}

function readName(reader: FieldReader, previous: Uint8Array): Uint8Array {
  const shared = reader.varint("shared", 0, previous.length);
  const rest = reader.slice(reader.varint("rest", 0, MAX_NAME_BYTES), "rest of a name");
  const name = new Uint8Array(shared + rest.length);
  name.set(previous.subarray(0, shared));
  name.set(rest, shared);
  if (name.length < 1 || name.length > MAX_NAME_BYTES)
    reader.refuse(`a tensor's name has ${name.length} bytes`);
  const mostShared =
    shared === previous.length || shared === name.length || name[shared] !== previous[shared];
  if (!mostShared) reader.refuse("a name shares fewer bytes than it could");
  return name;
}

/** UTF-8, refused where it is not. */
export function decodeText(bytes: Uint8Array, reader: FieldReader): string {
  try {
    return new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes);
  } catch {
    return reader.refuse("a text is not UTF-8");
  }
}
