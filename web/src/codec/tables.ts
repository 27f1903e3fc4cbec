/** Frequency tables: the format's Gaussian ones, and those that a file brings. */

import { GAUSSIAN_COUNT, LEVELS, MANTISSAS, MAX_HYPER_SYMBOLS, MAX_LOWEST, TOTAL } from "./constants.ts";
import { FieldReader } from "./fields.ts";
import { gaussianTableBytes } from "./gaussian_tables.ts";
import { readArrays } from "./integer_arrays.ts";
import type { Kernels } from "./kernels.ts";
import type { GroupShape } from "./scene_section.ts";

const HINTS = 256;

/** Several tables, one after the other; entry j of table t is at `base[t] + j`, its escape comes last. */
export interface FrequencyTables {
  base: Int32Array;
  /** Entries, the escape included. */
  entries: Int32Array;
  /** Symbol of entry 0. */
  lowest: Int32Array;
  frequencies: Uint16Array;
  /** Sum of the frequencies before each entry. */
  cumulated: Uint16Array;
  /** [tables, 256] entry of the slot 256 i: where to begin to look for slots from there. */
  hints: Uint16Array;
}

interface Table {
  lowest: number;
  frequencies: number[];
}

function collect(tables: Table[]): FrequencyTables {
  const size = tables.reduce((sum, table) => sum + table.frequencies.length, 0);
  const result: FrequencyTables = {
    base: new Int32Array(tables.length),
    entries: Int32Array.from(tables, (table) => table.frequencies.length),
    lowest: Int32Array.from(tables, (table) => table.lowest),
    frequencies: new Uint16Array(size),
    cumulated: new Uint16Array(size),
    hints: new Uint16Array(tables.length * HINTS),
  };
  let base = 0;
  tables.forEach((table, t) => {
    result.base[t] = base;
    let sum = 0;
    table.frequencies.forEach((frequency, j) => {
      result.frequencies[base + j] = frequency;
      result.cumulated[base + j] = sum;
      // Hints of the slots that begin within this entry.
      for (let i = Math.ceil(sum / HINTS); i * HINTS < sum + frequency; i++) result.hints[t * HINTS + i] = j;
      sum += frequency;
    });
    base += table.frequencies.length;
  });
  return result;
}

let gaussian: FrequencyTables | undefined;

/** The 128 tables that are constants of the format. */
export function gaussianTables(): FrequencyTables {
  gaussian ??= collect(unpackGaussian(gaussianTableBytes()));
  return gaussian;
}

function unpackGaussian(bytes: Uint8Array): Table[] {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let at = 0;
  const next = () => view.getUint16((at += 2) - 2, true);
  return Array.from({ length: GAUSSIAN_COUNT }, () => {
    const radius = next();
    const half = Array.from({ length: radius + 1 }, next);
    return { lowest: -radius, frequencies: [...half.slice(1).reverse(), ...half, next()] };
  });
}

/** The file's tables: for each group without network, its `width` of them. */
export function readTables(
  payload: Uint8Array,
  groups: GroupShape[],
  name: string,
  kernels: Kernels,
): Array<FrequencyTables | null> {
  const reader = new FieldReader(payload, name);
  const count = groups.reduce((sum, group) => sum + (group.hasNetwork ? 0 : group.width), 0);
  const entries: number[] = [];
  const lowest: number[] = [];
  for (let t = 0; t < count; t++) {
    entries.push(reader.varint(`entries of table ${t}`, 2, MAX_HYPER_SYMBOLS + 1));
    lowest.push(reader.signedVarint(`lowest of table ${t}`, -MAX_LOWEST, MAX_LOWEST));
  }
  let differences: Int32Array = new Int32Array(0);
  if (count)
    [differences] = readArrays(reader, [entries.reduce((a, b) => a + b, 0)], kernels) as [Int32Array];
  reader.end();
  let at = 0;
  const tables = entries.map((size, t) => {
    const frequencies = frequenciesOf(differences.subarray(at, (at += size)), reader, t);
    return { lowest: lowest[t]!, frequencies };
  });
  let first = 0;
  return groups.map((group) => {
    if (group.hasNetwork) return null;
    return collect(tables.slice(first, (first += group.width)));
  });
}

function frequenciesOf(differences: Int32Array, reader: FieldReader, table: number): number[] {
  const m = differences.length;
  let level = 0;
  const weights: number[] = [];
  let largest = -1;
  let place = 0;
  for (let j = 0; j < m; j++) {
    // The escape has its own level, not a difference.
    level = j === m - 1 ? differences[j]! : level + differences[j]!;
    if (level < 0 || level >= LEVELS)
      reader.refuse(`level ${level} in table ${table}, expected 0 to ${LEVELS - 1}`);
    if (level > largest) [largest, place] = [level, j];
    weights.push(MANTISSAS[level & 7]! * 2 ** (level >> 3));
  }
  // Weights are below 2^26, and a table's below 2^37: their products with 65536 stay exact in doubles.
  const sum = weights.reduce((a, b) => a + b, 0);
  const frequencies = weights.map((weight) => 1 + Math.floor((weight * (TOTAL - m)) / sum));
  frequencies[place]! += TOTAL - frequencies.reduce((a, b) => a + b, 0);
  return frequencies;
}
