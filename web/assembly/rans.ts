/** Chunks of a stream, by asymmetric numeral systems (docs/bitstream.md, "Streams"). */

import { learn, shifted, startRows } from "./rows";

const ESCAPED: i32 = i32.MIN_VALUE;
const INITIAL: u64 = 1 << 31;
const SINGLE_STATE_SYMBOLS = 1 << 18;

/**
 * 0, or the number of what is wrong: 1 too few words, 2 words left over, 3 a state's begin, 4 a state's end.
 *
 * With `inertia` tables shift within rows of `channels` symbols, of which the chunk's first is at `firstColumn`:
 * `choices` then become those that were used.
 */
export function decodeChunk(
  words: usize,
  wordBytes: i32,
  base: usize, // [tables] i32
  entries: usize, // [tables] i32
  lowest: usize, // [tables] i32
  frequencies: usize, // u16
  cumulated: usize, // u16
  hints: usize, // [tables, 256] u16
  choices: usize, // [symbols] u8
  symbols: usize, // [symbols] i32
  count: i32,
  channels: i32,
  inertia: i32,
  firstColumn: i32,
): i32 {
  const end = words + wordBytes;
  const isDouble = count >= SINGLE_STATE_SYMBOLS;
  let next = words + (isDouble ? 16 : 8);
  if (next > end) return 1;
  // The state whose turn it is, and the other one.
  let state = load<u64>(words);
  let other = isDouble ? load<u64>(words, 8) : INITIAL;
  if (<i64>state < <i64>INITIAL || <i64>other < <i64>INITIAL) return 3;
  if (inertia) startRows(channels, inertia, firstColumn);
  for (let i = 0; i < count; i++) {
    const slot = <i32>(state & 0xffff);
    const given: i32 = load<u8>(choices + i);
    const table = <usize>(inertia ? shifted(given) : given);
    const first = <usize>load<i32>(base + (table << 2));
    const last = load<i32>(entries + (table << 2)) - 1;
    let j: i32 = load<u16>(hints + (((table << 8) + (slot >> 8)) << 1));
    while (j < last && <i32>load<u16>(cumulated + ((first + j + 1) << 1)) <= slot) j++;
    const place = (first + j) << 1;
    const f: u64 = load<u16>(frequencies + place);
    const c: u64 = load<u16>(cumulated + place);
    state = f * (state >> 16) + <u64>slot - c;
    if (state < INITIAL) {
      if (next === end) return 1;
      state = (state << 32) | <u64>load<u32>(next);
      next += 4;
    }
    const isEscaped = j === last;
    const symbol = load<i32>(lowest + (table << 2)) + j;
    store<i32>(symbols + (<usize>i << 2), isEscaped ? ESCAPED : symbol);
    if (inertia) {
      store<u8>(choices + i, <u8>table);
      learn(given, isEscaped, symbol);
    }
    if (isDouble) {
      const turn = state;
      state = other;
      other = turn;
    }
  }
  if (next !== end) return 2;
  return state === INITIAL && other === INITIAL ? 0 : 4;
}
