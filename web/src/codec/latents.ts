/** Latents of one range of octree levels (docs/bitstream.md, "Latents"). */

import {
  FRACTION_BITS,
  GAUSSIAN_COUNT,
  MAX_ANCHORS,
  MAX_COUPLED_PRIMITIVES,
  MAX_DEPTH,
  MAX_SYMBOL,
} from "./constants.ts";
import { FieldReader } from "./fields.ts";
import type { Kernels } from "./kernels.ts";
import type { IntegerNetwork } from "./networks.ts";
import { type GroupShape, Role } from "./scene_section.ts";
import { readStream } from "./streams.ts";
import { type FrequencyTables, gaussianTables } from "./tables.ts";

const ONE = 1 << FRACTION_BITS;
/** A network's outputs that are in memory at a time. */
const OUTPUTS = 1 << 18;

export interface RangeHead {
  level: number;
  anchors: number;
  coupled: number;
}

/** Reads a range's head; `reader` is then at its streams. */
export function readRangeHead(reader: FieldReader): RangeHead {
  return {
    level: reader.varint("level", 0, MAX_DEPTH),
    anchors: reader.varint("range_anchors", 1, MAX_ANCHORS),
    coupled: reader.varint("range_coupled", 0, MAX_ANCHORS * MAX_COUPLED_PRIMITIVES),
  };
}

/** What a range's symbols depend on: its anchors, in canonical order. */
export interface RangeAnchors {
  count: number;
  /** [count, 3] */
  offsets: Int32Array;
  depth: number;
  /** [count, K] */
  mask: Uint8Array;
  slots: number;
  coupled: number;
}

export interface GroupLatents {
  /** [count, channels], of role residual [coupled, channels] */
  symbols: Int32Array;
  /** Of the same shape, Q12. */
  latents: Int32Array;
}

/** Of each group, the symbols and latents of a range. */
export function readRange(
  reader: FieldReader,
  groups: GroupShape[],
  tables: Array<FrequencyTables | null>,
  networks: Array<IntegerNetwork | null>,
  anchors: RangeAnchors,
  kernels: Kernels,
): GroupLatents[] {
  const decoded: GroupLatents[] = [];
  groups.forEach((group, i) => {
    const table = tables[i];
    const network = networks[i];
    if (table) decoded.push(readByTables(reader, group, table, anchors, kernels));
    else decoded.push(readByNetwork(reader, group, network!, anchors, decoded, kernels));
  });
  reader.end();
  return decoded;
}

function readByTables(
  reader: FieldReader,
  group: GroupShape,
  tables: FrequencyTables,
  anchors: RangeAnchors,
  kernels: Kernels,
): GroupLatents {
  const choices = new Uint8Array(symbolCount(group, anchors));
  let at = 0;
  forEachSymbol(group, anchors, 0, anchors.count, (_, column) => {
    choices[at++] = column;
  });
  const symbols = readStream(reader, tables, choices, -MAX_SYMBOL, MAX_SYMBOL, kernels);
  return { symbols, latents: symbols.map((q) => q * ONE) };
}

function readByNetwork(
  reader: FieldReader,
  group: GroupShape,
  network: IntegerNetwork,
  anchors: RangeAnchors,
  before: GroupLatents[],
  kernels: Kernels,
): GroupLatents {
  const count = symbolCount(group, anchors);
  const choices = new Uint8Array(count);
  const means = new Int32Array(count);
  const most = Math.max(1, Math.floor(OUTPUTS / network.outputs));
  let at = 0;
  for (let first = 0; first < anchors.count; first += most) {
    const rows = Math.min(most, anchors.count - first);
    const outputs = kernels.evaluate(
      network,
      networkInputs(group, network, anchors, before, first, rows),
      rows,
    );
    forEachSymbol(group, anchors, first, rows, (row, column) => {
      const place = row * network.outputs + column;
      means[at] = outputs[place]!;
      const scale = (outputs[place + group.width]! + ONE / 2) >> FRACTION_BITS;
      choices[at++] = scale < 0 ? 0 : scale > GAUSSIAN_COUNT - 1 ? GAUSSIAN_COUNT - 1 : scale;
    });
  }
  const symbols = readStream(reader, gaussianTables(), choices, -MAX_SYMBOL, MAX_SYMBOL, kernels);
  const latents = means;
  for (let i = 0; i < count; i++) latents[i] = symbols[i]! * ONE + means[i]!;
  return { symbols, latents };
}

function symbolCount(group: GroupShape, anchors: RangeAnchors): number {
  return group.channels * (group.role === Role.residual ? anchors.coupled : anchors.count);
}

/** Calls with each symbol's row, counted from `first`, and its column among the group's `width`. */
function forEachSymbol(
  group: GroupShape,
  anchors: RangeAnchors,
  first: number,
  rows: number,
  call: (row: number, column: number) => void,
): void {
  const { mask, slots } = anchors;
  const isResidual = group.role === Role.residual;
  for (let row = 0; row < rows; row++) {
    for (let slot = 0; slot < (isResidual ? slots : 1); slot++) {
      if (isResidual && !mask[(first + row) * slots + slot]) continue;
      for (let c = 0; c < group.channels; c++) call(row, slot * group.channels + c);
    }
  }
}

/** [rows, inputs], Q12: coordinates if the group sees them, then the latents of its context, side by side. */
function networkInputs(
  group: GroupShape,
  network: IntegerNetwork,
  anchors: RangeAnchors,
  before: GroupLatents[],
  first: number,
  rows: number,
): Int32Array {
  const inputs = new Int32Array(rows * network.inputs);
  let column = 0;
  const put = (width: number, value: (place: number) => number): void => {
    for (let row = 0; row < rows; row++) {
      for (let c = 0; c < width; c++)
        inputs[row * network.inputs + column + c] = value((first + row) * width + c);
    }
    column += width;
  };
  if (group.seesCoordinates) {
    const scale = 2 ** -anchors.depth;
    // Up to 2^34 before the shift.
    put(3, (place) => Math.floor((2 * anchors.offsets[place]! + 1) * ONE * scale) - ONE);
  }
  for (const j of group.context) {
    const { latents } = before[j]!;
    put(latents.length / anchors.count, (place) => latents[place]!);
  }
  return inputs;
}
