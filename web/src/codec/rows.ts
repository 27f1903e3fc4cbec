/**
 * Symbols that say something about later ones of their row (docs/bitstream.md, "Rows").
 *
 * A row is an anchor's symbols of a group, or those of a coupled primitive. They are large or small together: with
 * inertia, a row's tables shift by how large its symbols have been so far. They may also predict one another: with a
 * chain, a step is a symbol and what the steps before it say.
 */

import {
  CHAIN_BITS,
  FRACTION_BITS,
  LARGEST_TABLE_SHIFT,
  MAX_SYMBOL,
  SIZE_CAP,
  SIZE_OFFSET,
} from "./constants.ts";
import type { FieldReader } from "./fields.ts";
import { gaussianTables } from "./tables.ts";

const ONE = 1 << FRACTION_BITS;
/** Ratios of sizes are in units of 2^-15. */
const RATIO_ONE = 2 ** 15;
/** Shifts in which a standard deviation becomes twice as large, times two. */
const HALF_SHIFTS_PER_OCTAVE = 24;

/** Rows whose tables shift. */
export interface Rows {
  /** Symbols of a row; at least 2, as the first one's table never shifts. */
  channels: number;
  /** 1 to MAX_INERTIA */
  inertia: number;
}

/** Those of a chunk. */
export interface ChunkRows extends Rows {
  /** Place in its row of the chunk's first symbol. */
  first: number;
}

/** Null where no table shifts, so that nothing need be kept count of. */
export function rowsOf(inertia: number, channels: number): Rows | null {
  return inertia > 0 && channels > 1 ? { channels, inertia } : null;
}

/** What the two sums and their ratio are made of, computed once. */
export interface RowTables {
  /** [128] What a symbol of each table adds to `expected`. */
  expected: Int32Array;
  /**
   * What a symbol adds to `seen`: for each table one number for each absolute value from 0 on, the last of them for all
   * beyond, and for escapes.
   */
  seen: Int32Array;
  /** [129] Where those of each table begin, and where the last one's end. */
  seenBase: Int32Array;
  /** [73] M(d): the ratio from which on tables shift by d, for d from -LARGEST_TABLE_SHIFT on. */
  ratios: Int32Array;
}

let rowTablesMade: RowTables | undefined;

export function rowTables(): RowTables {
  rowTablesMade ??= makeRowTables();
  return rowTablesMade;
}

function makeRowTables(): RowTables {
  const sizes = expectedSizes();
  const share = (size: number, of: number): number => Math.floor((ONE * size) / (of + SIZE_OFFSET));
  const seen: number[] = [];
  const seenBase = [0];
  for (const size of sizes) {
    const cap = SIZE_CAP * size;
    for (let magnitude = 0; magnitude * ONE < cap; magnitude++) seen.push(share(magnitude * ONE, size));
    seen.push(share(cap, size));
    seenBase.push(seen.length);
  }
  const ratio = (_: unknown, i: number): number =>
    Math.floor(RATIO_ONE * 2 ** ((2 * (i - LARGEST_TABLE_SHIFT) - 1) / HALF_SHIFTS_PER_OCTAVE));
  return {
    expected: Int32Array.from(sizes, (size) => share(size, size)),
    seen: Int32Array.from(seen),
    seenBase: Int32Array.from(seenBase),
    ratios: Int32Array.from({ length: 2 * LARGEST_TABLE_SHIFT + 1 }, ratio),
  };
}

/** [128] E(t): the mean absolute value of a symbol of each Gaussian table, Q12. */
function expectedSizes(): number[] {
  const { base, lowest, frequencies } = gaussianTables();
  return Array.from(base, (first, table) => {
    const radius = -lowest[table]!;
    let sum = 0;
    for (let q = 1; q <= radius; q++) sum += q * frequencies[first + radius + q]!;
    return Math.floor(sum / 8); // two sides, 4096 in units of 2^-16
  });
}

/** Steps between latents and means, of symbols [rows, channels]. */
export function stepsOf(
  symbols: Int32Array,
  channels: number,
  chain: Int32Array,
  reader: FieldReader,
): Int32Array {
  const steps = new Int32Array(symbols.length);
  // Sums are below 2^38.
  const weights = Float64Array.from(chain);
  const before = new Float64Array(channels);
  const scale = 2 ** -CHAIN_BITS;
  for (let row = 0; row < symbols.length; row += channels) {
    let at = 0;
    for (let c = 0; c < channels; c++) {
      let sum = 2 ** (CHAIN_BITS - 1);
      for (let j = 0; j < c; j++) sum += weights[at++]! * before[j]!;
      const step = symbols[row + c]! + Math.floor(sum * scale);
      if (Math.abs(step) > MAX_SYMBOL)
        reader.refuse(`a step is ${step}, expected ${-MAX_SYMBOL} to ${MAX_SYMBOL}`);
      before[c] = step;
      steps[row + c] = step;
    }
  }
  return steps;
}
