/** The prediction heads section: tensors, until version 4 with their names (docs/bitstream.md, "Prediction heads"). */

import {
  FIRST_WITH_ROWS,
  MAX_EXPONENT,
  MAX_LAYER_WIDTH,
  MAX_NAME_BYTES,
  MAX_RANK,
  MAX_TENSORS,
  MAX_WEIGHTS,
} from "./constants.ts";
import { FieldReader } from "./fields.ts";
import { type TensorShape, headTensors } from "./head_tensors.ts";
import { readArrays } from "./integer_arrays.ts";
import type { Kernels } from "./kernels.ts";
import type { SceneSection } from "./scene_section.ts";

export interface Tensor {
  shape: number[];
  /** A parameter is its integer times 2^-exponent. */
  exponent: number;
  values: Int32Array;
}

interface TensorHead extends TensorShape {
  exponent: number;
}

/** Tensors by name, in the order of the file. */
export function readHeads(
  payload: Uint8Array,
  scene: SceneSection,
  name: string,
  version: number,
  kernels: Kernels,
): Map<string, Tensor> {
  const reader = new FieldReader(payload, name);
  const heads = version < FIRST_WITH_ROWS ? readNamed(reader) : readExponents(reader, headTensors(scene));
  const arrays = heads.length ? readArrays(reader, heads.map(elementsOf), kernels) : [];
  reader.end();
  return new Map(
    heads.map(({ name, shape, exponent }, i) => [name, { shape, exponent, values: arrays[i]! }]),
  );
}

/** From version 5 on: the scene section says which tensors there are. */
function readExponents(reader: FieldReader, tensors: TensorShape[]): TensorHead[] {
  const elements = tensors.reduce((sum, tensor) => sum + elementsOf(tensor), 0);
  checkElements(elements, reader);
  return tensors.map((tensor) => ({ ...tensor, exponent: readExponent(reader) }));
}

function readNamed(reader: FieldReader): TensorHead[] {
  const count = reader.varint("tensors", 0, MAX_TENSORS);
  const heads: TensorHead[] = [];
  let previous: Uint8Array = new Uint8Array(0);
  let elements = 0;
  for (let i = 0; i < count; i++) {
    previous = readName(reader, previous);
    const name = decodeText(previous, reader);
    if (heads.some((head) => head.name === name)) reader.refuse(`tensor ${name} is there twice`);
    const rank = reader.varint("rank", 0, MAX_RANK);
    const shape: number[] = [];
    for (let side = 0; side < rank; side++) shape.push(reader.varint("side", 0, MAX_LAYER_WIDTH));
    const head = { name, shape, exponent: readExponent(reader) };
    elements += elementsOf(head);
    checkElements(elements, reader);
    heads.push(head);
  }
  return heads;
}

function elementsOf({ shape }: TensorShape): number {
  return shape.reduce((a, b) => a * b, 1);
}

function checkElements(elements: number, reader: FieldReader): void {
  if (elements > MAX_WEIGHTS) reader.refuse(`more than ${MAX_WEIGHTS} elements of tensors`);
}

function readExponent(reader: FieldReader): number {
  return reader.signedVarint("exponent", -MAX_EXPONENT, MAX_EXPONENT);
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
