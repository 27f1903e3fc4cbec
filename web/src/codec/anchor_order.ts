/** The canonical order of anchors: coarse to fine (docs/bitstream.md, "Order of anchors"). */

export interface OrderedAnchors {
  /** [N, 3] */
  offsets: Int32Array;
  /** [depth + 1] number of anchors of the levels up to each. */
  upToLevel: number[];
  /** [N] place of each anchor among all, sorted by Morton code. */
  mortonRank: Int32Array;
}

const DIGITS_PER_PASS = 3;

/** Sorts distinct offsets [N, 3] of `depth` bits. */
export function canonicalOrder(offsets: Int32Array, depth: number): OrderedAnchors {
  const byMorton = sortByMorton(offsets, depth);
  const count = byMorton.length;
  const levels = new Uint8Array(count);
  const upToLevel: number[] = new Array(depth + 1).fill(0);
  for (let i = 0; i < count; i++) {
    levels[i] = i === 0 ? 0 : depth - highestDifference(offsets, byMorton[i - 1]!, byMorton[i]!);
    upToLevel[levels[i]!]!++;
  }
  for (let level = 1; level <= depth; level++) upToLevel[level]! += upToLevel[level - 1]!;
  const next = [0, ...upToLevel];
  const ordered = new Int32Array(3 * count);
  const mortonRank = new Int32Array(count);
  for (let i = 0; i < count; i++) {
    const to = next[levels[i]!]!++;
    for (let axis = 0; axis < 3; axis++) ordered[3 * to + axis] = offsets[3 * byMorton[i]! + axis]!;
    mortonRank[to] = i;
  }
  return { offsets: ordered, upToLevel, mortonRank };
}

/** Index of the highest octal digit in which two Morton codes differ. */
function highestDifference(offsets: Int32Array, a: number, b: number): number {
  const difference =
    (offsets[3 * a]! ^ offsets[3 * b]!) |
    (offsets[3 * a + 1]! ^ offsets[3 * b + 1]!) |
    (offsets[3 * a + 2]! ^ offsets[3 * b + 2]!);
  return 31 - Math.clz32(difference);
}

/** Indices of anchors by Morton code: a radix sort, three octal digits a pass. */
function sortByMorton(offsets: Int32Array, depth: number): Int32Array {
  const count = offsets.length / 3;
  let order = Int32Array.from({ length: count }, (_, i) => i);
  let spare = new Int32Array(count);
  const keys = new Uint16Array(count);
  for (let digit = 0; digit < depth; digit += DIGITS_PER_PASS) {
    const starts = new Int32Array(513);
    for (let i = 0; i < count; i++) {
      const at = 3 * order[i]!;
      const key =
        (SPREAD[(offsets[at]! >> digit) & 7]! << 2) |
        (SPREAD[(offsets[at + 1]! >> digit) & 7]! << 1) |
        SPREAD[(offsets[at + 2]! >> digit) & 7]!;
      keys[i] = key;
      starts[key + 1]!++;
    }
    for (let key = 0; key < 512; key++) starts[key + 1]! += starts[key]!;
    for (let i = 0; i < count; i++) spare[starts[keys[i]!]!++] = order[i]!;
    [order, spare] = [spare, order];
  }
  return order;
}

/** Three bits, two zeros between each. */
const SPREAD = [0, 1, 8, 9, 64, 65, 72, 73];

/**
 * [n] Of the first n anchors, which are those up to a level: how many anchors their nodes of that level hold.
 * `mortonRank` is of all anchors.
 */
export function standsFor(mortonRank: Int32Array, n: number): Int32Array {
  const total = mortonRank.length;
  const isFirst = new Int32Array(total).fill(-1);
  for (let i = 0; i < n; i++) isFirst[mortonRank[i]!] = i;
  const held = new Int32Array(n);
  // Each node's first anchor in Morton order is the one that is there; the others follow until the next node.
  let current = 0;
  for (let rank = 0; rank < total; rank++) {
    if (isFirst[rank]! >= 0) current = isFirst[rank]!;
    held[current]!++;
  }
  return held;
}
