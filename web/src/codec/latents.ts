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
import { type EarlierAnchors, NEIGHBOUR_INPUTS, type Surroundings, followNeighbours } from "./neighbours.ts";
import type { IntegerNetwork } from "./networks.ts";
import { rowsOf, stepsOf } from "./rows.ts";
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

/** What a range's symbols depend on: its anchors, in canonical order, and the ranges before. */
export interface RangeAnchors {
  count: number;
  /** [count, 3] */
  offsets: Int32Array;
  depth: number;
  /** [count, K] */
  mask: Uint8Array;
  slots: number;
  coupled: number;
  /** Null for the first range. */
  earlier: EarlierRanges | null;
}

export interface EarlierRanges {
  anchors: EarlierAnchors;
  /** Of each range what `readRange` has given. */
  pieces: GroupLatents[][];
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
  const surroundings = group.seesNeighbours ? surroundingsOf(before.length, network, anchors) : null;
  const sources = inputSources(group, anchors, before, surroundings);
  const count = symbolCount(group, anchors);
  const choices = new Uint8Array(count);
  const means = new Int32Array(count);
  const most = Math.max(1, Math.floor(OUTPUTS / network.outputs));
  let at = 0;
  for (let first = 0; first < anchors.count; first += most) {
    const rows = Math.min(most, anchors.count - first);
    const outputs = kernels.evaluate(network, networkInputs(network, sources, first, rows), rows);
    forEachSymbol(group, anchors, first, rows, (row, column) => {
      const place = row * network.outputs + column;
      means[at] = outputs[place]!;
      const scale = (outputs[place + group.width]! + ONE / 2) >> FRACTION_BITS;
      choices[at++] = scale < 0 ? 0 : scale > GAUSSIAN_COUNT - 1 ? GAUSSIAN_COUNT - 1 : scale;
    });
  }
  if (network.follow) {
    const around = surroundings?.around ?? new Int32Array(count); // in the first range nothing is known
    followNeighbours(means, around, centreOf(network), network.follow);
  }
  const rows = rowsOf(network.inertia, group.channels);
  const symbols = readStream(reader, gaussianTables(), choices, -MAX_SYMBOL, MAX_SYMBOL, kernels, rows);
  const steps = network.chain ? stepsOf(symbols, group.channels, network.chain, reader) : symbols;
  const latents = means;
  for (let i = 0; i < count; i++) latents[i] = steps[i]! * ONE + means[i]!;
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

/** Some of a network's inputs, side by side: `width` numbers of each anchor of the range, Q12. */
interface Source {
  width: number;
  /** The number at a place of [count, width]. */
  at: (place: number) => number;
}

/** What neighbours have of a group; null in the first range, where all of it is 0. */
function surroundingsOf(
  index: number,
  network: IntegerNetwork,
  { offsets, earlier }: RangeAnchors,
): Surroundings | null {
  if (!earlier) return null;
  const latents = concatenate(earlier.pieces.map((piece) => piece[index]!.latents));
  return earlier.anchors.surroundings(offsets, latents, centreOf(network));
}

/** Begins with the mean of each channel where nothing is known. */
function centreOf(network: IntegerNetwork): Int32Array {
  return network.layers[network.layers.length - 1]!.bias;
}

/** What a group's network takes, in the order of its inputs; `before`: the groups before it, of the same range. */
function inputSources(
  group: GroupShape,
  anchors: RangeAnchors,
  before: GroupLatents[],
  surroundings: Surroundings | null,
): Source[] {
  const sources: Source[] = [];
  if (group.seesCoordinates) {
    const scale = 2 ** -anchors.depth;
    // Up to 2^34 before the shift.
    const at = (place: number) => Math.floor((2 * anchors.offsets[place]! + 1) * ONE * scale) - ONE;
    sources.push({ width: 3, at });
  }
  for (const j of group.context) {
    const { latents } = before[j]!;
    sources.push({ width: latents.length / anchors.count, at: (place) => latents[place]! });
  }
  if (surroundings) sources.push({ width: NEIGHBOUR_INPUTS, at: (place) => surroundings.inputs[place]! });
  return sources;
}

/** [rows, inputs], Q12: of the anchors from `first` on, what the sources have, and 0 where none is left: neighbours in the first range. */
function networkInputs(network: IntegerNetwork, sources: Source[], first: number, rows: number): Int32Array {
  const inputs = new Int32Array(rows * network.inputs);
  let column = 0;
  for (const { width, at } of sources) {
    for (let row = 0; row < rows; row++) {
      for (let c = 0; c < width; c++)
        inputs[row * network.inputs + column + c] = at((first + row) * width + c);
    }
    column += width;
  }
  return inputs;
}

export function concatenate(pieces: Int32Array[]): Int32Array {
  if (pieces.length === 1) return pieces[0]!;
  const all = new Int32Array(pieces.reduce((sum, piece) => sum + piece.length, 0));
  let at = 0;
  for (const piece of pieces) {
    all.set(piece, at);
    at += piece.length;
  }
  return all;
}
