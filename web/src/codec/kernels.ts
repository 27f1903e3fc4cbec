/** The loops that take the time, which are in WebAssembly (assembly/), as the rest of the decoder sees them. */

import type { IntegerNetwork } from "./networks.ts";
import type { ChunkRows } from "./rows.ts";
import type { FrequencyTables } from "./tables.ts";

/** In the place of a symbol that is coded as an escape. No table has it. */
export const ESCAPED = -(2 ** 31);

export interface Kernels {
  /**
   * Offsets [anchors, 3] in the order of the walk, and the place behind the code's last byte. The code begins at byte
   * `start`. Throws CorruptSection for another number of anchors, more than `mostNodes` nodes that hold two anchors or
   * more, or a code that does not end as it should.
   */
  walkOctree(
    payload: Uint8Array,
    start: number,
    anchors: number,
    depth: number,
    mostNodes: number,
    section: string,
  ): { offsets: Int32Array; end: number };

  /** Flags [anchors, slots], and the place behind the code's last byte. */
  decodeMasks(
    payload: Uint8Array,
    anchors: number,
    slots: number,
    section: string,
  ): { mask: Uint8Array; end: number };

  /**
   * Symbols of a chunk of a stream, each with the table that `choices` has for it; ESCAPED for escapes.
   * `words` are little-endian, four bytes each. With `rows` tables shift by what their row has shown so far: `choices`
   * then become the tables that were used.
   */
  decodeChunk(
    words: Uint8Array,
    tables: FrequencyTables,
    choices: Uint8Array,
    symbols: Int32Array,
    rows: ChunkRows | null,
    section: string,
  ): void;

  /** Outputs [rows, outputs] of a network for inputs [rows, inputs], Q12. */
  evaluate(network: IntegerNetwork, inputs: Int32Array, rows: number): Int32Array;

  /** Outputs [P, outputs] of a residual MLP for the coupled primitives of some anchors. */
  runCoupled(mlp: PackedMLP, task: CoupledTask): Float32Array;
}

/** A residual MLP whose widths are padded by zeros: hidden ones to a multiple of 16, outputs to one of 4. */
export interface PackedMLP {
  width: number;
  padded: number;
  outputs: number;
  blockCount: number;
  /** Of each block weight1 [width, width], bias1, weight2, bias2. */
  blocks: Float32Array;
  /** [width, padded] */
  outputWeight: Float32Array;
  /**
   * What residual embeddings become: [K, width] and [K, padded] of each slot if they are shared, else the weights
   * [residualDim, width] and [residualDim, padded].
   */
  ownEntry: Float32Array;
  ownSkip: Float32Array;
}

export interface CoupledTask {
  anchors: number;
  /** [anchors, width] and [anchors, padded]: the anchors' part of first layer and skip, biases included. */
  entries: Float32Array;
  skips: Float32Array;
  /** [anchors + 1] from 0 */
  firstCoupled: Int32Array;
  /** [P] if residual embeddings are shared */
  slots: Uint8Array | null;
  /** [P, residualDim] if they are not */
  residuals: Float32Array | null;
  residualDim: number;
}
