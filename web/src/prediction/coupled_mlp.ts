/**
 * A residual MLP applied to the coupled primitives of all anchors (docs/bitstream_prediction.md, "The residual MLP").
 *
 * What its first layer and its skip make of an anchor's numbers is the same for all coupled primitives of the anchor,
 * and what they make of a shared residual embedding the same for all anchors: both are computed once.
 */

import type { Kernels, PackedMLP } from "../codec/kernels.ts";
import type { HeadNetwork } from "./head_networks.ts";
import type { CoupledPrimitives } from "./scene_values.ts";

/** Entries [rows, width] of the first layer and [rows, outputs] of the skip. */
interface Partial {
  rows: number;
  entry: Float32Array;
  skip: Float32Array;
}

export class CoupledMLP {
  /** Of each anchor: its reference embedding's part, biases included. */
  private readonly ofAnchors: Partial;
  /** Of each slot, if residual embeddings are shared. */
  private readonly ofSlots: Partial | null;
  /** Rows of the input weights at which the view and the residual embedding begin. */
  private readonly viewRow: number;
  private readonly residualRow: number;

  private readonly packed: PackedMLP;

  constructor(
    readonly network: HeadNetwork,
    private readonly primitives: CoupledPrimitives,
    private readonly kernels: Kernels,
  ) {
    const { referenceDim, residualDim, anchors } = primitives;
    this.viewRow = referenceDim;
    this.residualRow = network.inputs - residualDim;
    this.ofAnchors = {
      rows: anchors,
      entry: product(
        primitives.references,
        referenceDim,
        network.inputWeight,
        0,
        network.width,
        network.inputBias,
      ),
      skip: product(
        primitives.references,
        referenceDim,
        network.skipWeight,
        0,
        network.outputs,
        network.outputBias,
      ),
    };
    const shared = primitives.sharedResiduals;
    this.ofSlots = shared && this.partOfResiduals(shared);
    this.packed = this.pack();
  }

  private pack(): PackedMLP {
    const { width, outputs, blocks, outputWeight, inputWeight, skipWeight } = this.network;
    const { residualDim } = this.primitives;
    const [wide, padded] = [roundedUp(width, 16), roundedUp(outputs, 4)];
    const parts = blocks.flatMap(({ weight1, bias1, weight2, bias2 }) => [
      paddedRows(weight1, width, wide, wide),
      paddedRows(bias1, width, 1, wide),
      paddedRows(weight2, width, wide, wide),
      paddedRows(bias2, width, 1, wide),
    ]);
    const all = new Float32Array(parts.reduce((sum, part) => sum + part.length, 0));
    let at = 0;
    for (const part of parts) {
      all.set(part, at);
      at += part.length;
    }
    const entry = this.ofSlots?.entry ?? inputWeight.subarray(this.residualRow * width);
    const skip = this.ofSlots?.skip ?? skipWeight.subarray(this.residualRow * outputs);
    const rows = this.ofSlots?.rows ?? residualDim;
    return {
      width: wide,
      padded,
      outputs,
      blockCount: blocks.length,
      blocks: all,
      outputWeight: paddedRows(outputWeight, outputs, wide, padded),
      ownEntry: paddedRows(entry, width, rows, wide),
      ownSkip: paddedRows(skip, outputs, rows, padded),
    };
  }

  /**
   * Outputs [P, outputs] of the coupled primitives of anchors first ... end - 1, into `out`, which is that of all.
   * `views` [N, 4]: the view embeddings, for networks that see the view. The anchors' parts are made here, the rest by a
   * kernel.
   */
  run(first: number, end: number, views: Float32Array | null, out: Float32Array): void {
    const mlp = this.packed;
    const { firstCoupled, slots, residuals, residualDim } = this.primitives;
    const { width, outputs, inputWeight, skipWeight } = this.network;
    const anchors = end - first;
    const entries = new Float32Array(anchors * mlp.width);
    const skips = new Float32Array(anchors * mlp.padded);
    const sums = new Float64Array(Math.max(width, outputs));
    const fill = (
      to: Float32Array,
      stride: number,
      from: Float32Array,
      columns: number,
      weight: Float32Array,
    ): void => {
      for (let n = 0; n < anchors; n++) {
        for (let j = 0; j < columns; j++) sums[j] = from[(first + n) * columns + j]!;
        if (views) addProduct(views, 4 * (first + n), 4, weight, this.viewRow, columns, sums);
        for (let j = 0; j < columns; j++) to[n * stride + j] = sums[j]!;
      }
    };
    fill(entries, mlp.width, this.ofAnchors.entry, width, inputWeight);
    fill(skips, mlp.padded, this.ofAnchors.skip, outputs, skipWeight);
    const [from, to] = [firstCoupled[first]!, firstCoupled[end]!];
    const found = this.kernels.runCoupled(mlp, {
      anchors,
      entries,
      skips,
      firstCoupled: firstCoupled.subarray(first, end + 1).map((p) => p - from),
      slots: this.ofSlots && slots.subarray(from, to),
      residuals: residuals && residuals.subarray(from * residualDim, to * residualDim),
      residualDim,
    });
    out.set(found, from * outputs);
  }

  private partOfResiduals(residuals: Float32Array): Partial {
    const { inputWeight, skipWeight, width, outputs } = this.network;
    const { residualDim } = this.primitives;
    return {
      rows: residuals.length / residualDim,
      entry: product(residuals, residualDim, inputWeight, this.residualRow, width, null),
      skip: product(residuals, residualDim, skipWeight, this.residualRow, outputs, null),
    };
  }
}

function roundedUp(count: number, unit: number): number {
  return Math.ceil(count / unit) * unit;
}

/** Rows of `columns` numbers as `rows` rows of `width`, zeros where there is nothing. */
function paddedRows(values: Float32Array, columns: number, rows: number, width: number): Float32Array {
  const result = new Float32Array(rows * width);
  for (let row = 0; row < Math.min(rows, values.length / columns); row++) {
    result.set(values.subarray(row * columns, (row + 1) * columns), row * width);
  }
  return result;
}

/** [rows, columns] of x [rows, inputs] times the rows of `weight` from `firstRow` on, plus `bias`. */
function product(
  x: Float32Array,
  inputs: number,
  weight: Float32Array,
  firstRow: number,
  columns: number,
  bias: Float32Array | null,
): Float32Array {
  const rows = x.length / inputs;
  const result = new Float32Array(rows * columns);
  const sums = new Float64Array(columns);
  for (let row = 0; row < rows; row++) {
    if (bias) sums.set(bias);
    else sums.fill(0);
    addProduct(x, row * inputs, inputs, weight, firstRow, columns, sums);
    result.set(sums, row * columns);
  }
  return result;
}

function addProduct(
  x: Float32Array,
  at: number,
  inputs: number,
  weight: Float32Array,
  firstRow: number,
  columns: number,
  sums: Float64Array,
): void {
  for (let i = 0; i < inputs; i++) {
    const value = x[at + i]!;
    const row = (firstRow + i) * columns;
    for (let j = 0; j < columns; j++) sums[j]! += value * weight[row + j]!;
  }
}
