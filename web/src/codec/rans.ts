/**
 * Chunks of a stream, by asymmetric numeral systems (docs/bitstream.md, "Streams").
 *
 * A state has 63 bits: its upper and lower 32 are two numbers, and f * (state >> 16) is made of two products that
 * doubles hold exactly.
 */

import { CorruptSection } from "../errors.ts";
import { SINGLE_STATE_SYMBOLS } from "./constants.ts";
import { ESCAPED } from "./kernels.ts";
import { type ChunkRows, TableShift } from "./rows.ts";
import type { FrequencyTables } from "./tables.ts";

const WORD = 2 ** 32;
const INITIAL_LOW = 2 ** 31;

export function decodeChunk(
  words: Uint8Array,
  tables: FrequencyTables,
  choices: Uint8Array,
  symbols: Int32Array,
  rows: ChunkRows | null,
  section: string,
): void {
  const view = new DataView(words.buffer, words.byteOffset, words.byteLength);
  const refuse = (problem: string): never => {
    throw new CorruptSection(`${section}: ${problem}`);
  };
  const tableShift = rows && new TableShift(rows);
  const states = symbols.length < SINGLE_STATE_SYMBOLS ? 1 : 2;
  if (words.length < 8 * states) refuse("a chunk has fewer words than its states need");
  const { base, entries, lowest, frequencies, cumulated, hints } = tables;
  const low = [0, 0];
  const high = [0, 0];
  let at = 0;
  for (let i = 0; i < states; i++) {
    low[i] = view.getUint32(at, true);
    high[i] = view.getUint32(at + 4, true);
    at += 8;
    const isLegal = high[i]! < 2 ** 31 && (high[i]! > 0 || low[i]! >= INITIAL_LOW);
    if (!isLegal) refuse("a state of the entropy coder begins out of range");
  }
  for (let i = 0; i < symbols.length; i++) {
    const which = states === 2 ? i & 1 : 0;
    const lo = low[which]!;
    const hi = high[which]!;
    const slot = lo & 0xffff;
    const given = choices[i]!;
    const table = tableShift ? tableShift.shifted(given) : given;
    const first = base[table]!;
    const last = entries[table]! - 1;
    let j = hints[256 * table + (slot >> 8)]!;
    while (j < last && cumulated[first + j + 1]! <= slot) j++;
    const f = frequencies[first + j]!;
    // f floor(state / 2^16) + slot - c, with floor(state / 2^16) = quotientHigh 2^32 + quotientLow
    const quotientLow = ((hi & 0xffff) * 65536 + (lo >>> 16)) >>> 0;
    const quotientHigh = hi >>> 16;
    const product = f * quotientLow + (slot - cumulated[first + j]!);
    let nextHigh = f * quotientHigh + Math.floor(product / WORD);
    let nextLow = product % WORD;
    if (nextHigh === 0 && nextLow < INITIAL_LOW) {
      if (at === words.length) refuse("the words of a chunk end before its symbols");
      nextHigh = nextLow;
      nextLow = view.getUint32(at, true);
      at += 4;
    }
    low[which] = nextLow;
    high[which] = nextHigh;
    const symbol = j === last ? ESCAPED : lowest[table]! + j;
    symbols[i] = symbol;
    if (tableShift) {
      choices[i] = table;
      tableShift.learn(given, symbol);
    }
  }
  if (at !== words.length) refuse("words of a chunk are left over");
  for (let i = 0; i < states; i++) {
    if (high[i] !== 0 || low[i] !== INITIAL_LOW)
      refuse("a state of the entropy coder does not end where it began");
  }
}
