/** Streams of symbols: chunks, then the values of escapes (docs/bitstream.md, "Streams"). */

import { CHUNK_SYMBOLS, MAX_ESCAPE_BYTES } from "./constants.ts";
import { FieldReader } from "./fields.ts";
import { ESCAPED, type Kernels } from "./kernels.ts";
import type { Rows } from "./rows.ts";
import type { FrequencyTables } from "./tables.ts";

const INT32 = 2 ** 31;

/**
 * Symbols, one for each of `choices`, which names its table; refuses those below `least` or above `most`. With `rows`
 * tables shift within each row, and `choices` become those that were used: escapes need them.
 */
export function readStream(
  reader: FieldReader,
  tables: FrequencyTables,
  choices: Uint8Array,
  least: number,
  most: number,
  kernels: Kernels,
  rows: Rows | null = null,
): Int32Array {
  const count = choices.length;
  const symbols = new Int32Array(count);
  if (count === 0) return symbols;
  const words: number[] = [];
  for (let start = 0; start < count; start += CHUNK_SYMBOLS) {
    const size = Math.min(CHUNK_SYMBOLS, count - start);
    words.push(reader.varint("words", 2, Math.floor(size / 2) + 5));
  }
  const escapeBytes = reader.varint("escape_bytes", 0, MAX_ESCAPE_BYTES * count);
  words.forEach((n, chunk) => {
    const [start, end] = [chunk * CHUNK_SYMBOLS, Math.min(count, (chunk + 1) * CHUNK_SYMBOLS)];
    const bytes = reader.slice(4 * n, "words of a chunk");
    kernels.decodeChunk(
      bytes,
      tables,
      choices.subarray(start, end),
      symbols.subarray(start, end),
      rows && { ...rows, first: start % rows.channels },
      reader.section,
    );
  });
  const escapes = new FieldReader(reader.slice(escapeBytes, "escapes"), reader.section);
  readEscapes(escapes, tables, choices, symbols);
  escapes.end();
  for (let i = 0; i < count; i++) {
    const symbol = symbols[i]!;
    if (symbol < least || symbol > most) reader.refuse(`a symbol is ${symbol}, expected ${least} to ${most}`);
  }
  return symbols;
}

function readEscapes(
  escapes: FieldReader,
  tables: FrequencyTables,
  choices: Uint8Array,
  symbols: Int32Array,
): void {
  for (let i = 0; i < symbols.length; i++) {
    if (symbols[i] !== ESCAPED) continue;
    const v = escapes.varint("an escaped symbol", 0, Infinity, MAX_ESCAPE_BYTES);
    const lowest = tables.lowest[choices[i]!]!;
    const behind = lowest + tables.entries[choices[i]!]! - 1; // highest + 1
    const symbol = v % 2 ? lowest - 1 - (v - 1) / 2 : behind + v / 2;
    if (symbol < -INT32 || symbol >= INT32) escapes.refuse(`an escaped symbol is ${symbol}, beyond 32 bits`);
    symbols[i] = symbol;
  }
}
