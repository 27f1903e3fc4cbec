/** How far the tables of a row are shifted, symbol by symbol (docs/bitstream.md, "Rows"). */

const ONE: i64 = 1 << 12;
const RATIO_BITS: i64 = 15;
const LARGEST_TABLE_SHIFT: i32 = 36;
const LAST_TABLE: i32 = 127;

/** Tables of i32, put there by `setRowTables`. */
let EXPECTED: usize = 0;
let SEEN: usize = 0;
let SEEN_BASE: usize = 0;
let RATIOS: usize = 0;

/** Addresses of the four tables of `RowTables`. */
export function setRowTables(expected: usize, seen: usize, seenBase: usize, ratios: usize): void {
  EXPECTED = expected;
  SEEN = seen;
  SEEN_BASE = seenBase;
  RATIOS = ratios;
}

@inline
function at32(table: usize, index: i32): i32 {
  return load<i32>(table + (<usize>index << 2));
}

let channels: i32 = 0;
let column: i32 = 0;
let start: i64 = 0;
let seen: i64 = 0;
let expected: i64 = 0;
let shift: i32 = 0;

/** The next symbol is the one at `first` of a row of so many `symbols`. */
export function startRows(symbols: i32, inertia: i32, first: i32): void {
  channels = symbols;
  column = first;
  start = ONE * inertia;
  seen = start;
  expected = start;
  shift = 0;
}

/** What the next symbol's table, as the network gives it, becomes. */
@inline
export function shifted(table: i32): i32 {
  return max(0, min(LAST_TABLE, table + shift));
}

/** Takes that symbol into account, whose table is `table` as the network gives it. */
@inline
export function learn(table: i32, isEscaped: bool, symbol: i32): void {
  if (++column === channels) {
    column = 0;
    shift = 0;
    seen = start;
    expected = start;
    return;
  }
  const most = at32(SEEN_BASE, table + 1) - 1;
  seen += at32(SEEN, isEscaped ? most : min(most, at32(SEEN_BASE, table) + abs(symbol)));
  expected += at32(EXPECTED, table);
  const scaled = seen << RATIO_BITS;
  let i = shift + LARGEST_TABLE_SHIFT;
  while (i < 2 * LARGEST_TABLE_SHIFT && scaled >= expected * at32(RATIOS, i + 1)) i++;
  while (i > 0 && scaled < expected * at32(RATIOS, i)) i--;
  shift = i - LARGEST_TABLE_SHIFT;
}
