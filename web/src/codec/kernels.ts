/**
 * The loops that take the time, behind one interface: in plain TypeScript (plain_kernels.ts), which is the readable
 * truth, and in WebAssembly (wasm_kernels.ts), which is compared with it.
 */

import type { IntegerNetwork } from "./networks.ts";
import type { FrequencyTables } from "./tables.ts";

/** In the place of a symbol that is coded as an escape. No table has it. */
export const ESCAPED = -(2 ** 31);

export interface Kernels {
  /**
   * Offsets [anchors, 3] in the order of the walk, and the place behind the code's last byte. The code begins at byte
   * `start`. Throws CorruptSection for another number of anchors, or a code that does not end as it should.
   */
  walkOctree(
    payload: Uint8Array,
    start: number,
    anchors: number,
    depth: number,
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
   * `words` are little-endian, four bytes each.
   */
  decodeChunk(
    words: Uint8Array,
    tables: FrequencyTables,
    choices: Uint8Array,
    symbols: Int32Array,
    section: string,
  ): void;

  /** Outputs [rows, outputs] of a network for inputs [rows, inputs], Q12. */
  evaluate(network: IntegerNetwork, inputs: Int32Array, rows: number): Int32Array;
}
