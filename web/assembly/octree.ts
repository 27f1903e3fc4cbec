/** The walk of the context-mixed octree (docs/bitstream.md, "Positions"). */

import { alloc, release } from "./memory";
import { Mixer, choose, decide, decideByState, endDecoder, mix, newMixer, newStates, startDecoder } from "./mixing";

/** Beyond what the walk returns as the code's end. */
const TOO_MANY_NODES = -3;
const WRONG_COUNT = -2;
const BAD_END = -1;
const NOTHING = -1;
const DIRECT_LIMIT = 1000;
const O1 = 8192;
const O2 = O1 + 29160;
const O3 = O2 + 5120;
const O4 = O3 + 1300;
const O5 = O4 + 10752;
const O6 = O5 + 16384;
const OCCUPANCY_CONTEXTS = O6 + 16384;
const S1 = 1344;
const S2 = S1 + 1040;
const S3 = S2 + 2916;
const S4 = S3 + 2048;
const SINGLE_CONTEXTS = S4 + 2808;

/** Tables of src/codec/octree_grid.ts, put there by `setGrid`. */
let OCCUPIED: usize = 0; // [27, 256] u64
let AROUND: usize = 0; // [8] u64
let FACES: usize = 0; // [8, 6] u8
let TOUCHING: usize = 0; // [8, 7] u8
let STEP_NODE: usize = 0; // [8, 27] u8
let STEP_CHILD: usize = 0; // [8, 27] u8

export function setGrid(
  occupied: usize,
  around: usize,
  faces: usize,
  touching: usize,
  stepNode: usize,
  stepChild: usize,
): void {
  OCCUPIED = occupied;
  AROUND = around;
  FACES = faces;
  TOUCHING = touching;
  STEP_NODE = stepNode;
  STEP_CHILD = stepChild;
}

let offsets: usize = 0;
let anchors: i32 = 0;
let depth: i32 = 0;
let found: i32 = 0;
let waitingChildren: i32 = 0;
let direct: usize = 0;
let occupied: u64 = 0;
let unknown: u64 = 0;

// The level at hand: nodes that hold at least two anchors each.
let count: i32 = 0;
let place: usize = 0; // [count, 3] i32
let neighbours: usize = 0; // [count, 27] i32: index of a waiting node, or -2 - index of a single anchor, or NOTHING
let siblings: usize = 0; // [count] u8
let index: usize = 0; // [count] u8

@inline
function levelBytes(nodes: i32): usize {
  return <usize>nodes * (12 + 108 + 2);
}

function useLevel(base: usize, nodes: i32): void {
  count = nodes;
  place = base;
  neighbours = base + <usize>nodes * 12;
  siblings = base + <usize>nodes * 120;
  index = base + <usize>nodes * 121;
}

@inline
function neighbourOf(node: i32, j: i32): i32 {
  return load<i32>(neighbours + (<usize>(27 * node + j) << 2));
}

@inline
function byte(table: usize, at: i32): i32 {
  return load<u8>(table + at);
}

@inline
function occupiedCells(j: i32, occupancy: i32): u64 {
  return load<u64>(OCCUPIED + (<usize>(256 * j + occupancy) << 3));
}

@inline
function countAround(c: i32, cells: u64): i32 {
  return <i32>popcnt<u64>(cells & load<u64>(AROUND + (<usize>c << 3)));
}

/** 0 empty, 1 occupied, 2 unknown. */
@inline
function stateOf(cell: i32, taken: u64, open: u64): i32 {
  return <i32>((taken >> cell) & 1) + 2 * <i32>((open >> cell) & 1);
}

/** Which child of its node, `height` bits above the voxels, holds a single anchor. */
@inline
function childHolding(anchor: i32, height: i32): i32 {
  const at = offsets + <usize>anchor * 12;
  return (
    4 * ((load<i32>(at) >> height) & 1) + 2 * ((load<i32>(at, 4) >> height) & 1) + ((load<i32>(at, 8) >> height) & 1)
  );
}

/** Offsets [n, 3] at `out`. Returns the place behind the code, or a negative number that says what is wrong. */
export function walkOctree(
  payload: usize,
  start: i32,
  length: i32,
  n: i32,
  levels: i32,
  mostNodes: i32,
  out: usize,
): i32 {
  offsets = out;
  anchors = n;
  depth = levels;
  found = 0;
  startDecoder(payload, start, length);
  direct = newStates(368);
  if (anchors === 1) {
    singleAnchor(0, 0, 0, depth, 0, 0, 0);
    return endDecoder();
  }
  const occupancies = newMixer(7, OCCUPANCY_CONTEXTS, 168 + 65, 256, 16384, 400, 4);
  const singles = newMixer(5, SINGLE_CONTEXTS, 168 + 260, 84, 16384, 400, 4);
  const base = alloc(levelBytes(1));
  useLevel(base, 1);
  memory.fill(place, 0, 12);
  for (let j = 0; j < 27; j++) store<i32>(neighbours + (<usize>j << 2), j === 13 ? 0 : NOTHING);
  store<u8>(siblings, 1);
  store<u8>(index, 0);
  let nodes: i64 = 0;
  for (let step = 0; step < depth && count > 0; step++) {
    nodes += count;
    if (nodes > <i64>mostNodes) return TOO_MANY_NODES;
    if (!walkLevel(base, step, occupancies, singles)) return WRONG_COUNT;
  }
  if (found !== anchors) return WRONG_COUNT;
  const end = endDecoder();
  return end < 0 ? BAD_END : end;
}

function walkLevel(base: usize, step: i32, occupancyMixer: Mixer, singleMixer: Mixer): bool {
  const children = alloc(<usize>count << 5); // [count, 8] references
  memory.fill(children, 0xff, <usize>count << 5);
  const occupancies = alloc(count);
  waitingChildren = 0;
  for (let node = 0; node < count; node++) {
    lookAround(node, step, occupancies);
    const occupancy = decodeOccupancy(node, step, occupancyMixer);
    store<u8>(occupancies + node, occupancy);
    if (!decodeSingles(node, step, occupancy, children, singleMixer)) return false;
    if (<i64>found + 2 * <i64>(waitingChildren + count - 1 - node) > <i64>anchors) return false;
  }
  nextLevel(base, step, occupancies, children);
  return true;
}

function lookAround(node: i32, step: i32, occupancies: usize): void {
  occupied = 0;
  unknown = 0;
  const height = depth - 1 - step;
  for (let j = 0; j < 27; j++) {
    const reference = neighbourOf(node, j);
    if (reference === NOTHING || j === 13) continue;
    if (reference > node) {
      unknown |= occupiedCells(j, 255);
      continue;
    }
    const occupancy = reference >= 0 ? byte(occupancies, reference) : 1 << childHolding(-2 - reference, height);
    occupied |= occupiedCells(j, occupancy);
  }
}

@inline
function gridOf(node: i32, height: i32): i32 {
  if (height > 2) return 0;
  const at = place + <usize>node * 12;
  const bits = load<i32>(at) | load<i32>(at, 4) | load<i32>(at, 8);
  const aligned = (bits & ((1 << (3 - height)) - 1)) === 0 ? 1 : 0;
  return aligned + (height === 0 && (bits & 1) === 0 ? 2 : 0);
}

function decodeOccupancy(node: i32, step: i32, mixer: Mixer): i32 {
  const height = depth - 1 - step;
  const least = height === 0 ? 2 : 1;
  const parents: i32 = load<u8>(siblings + node);
  const brothers = <i32>popcnt<u32>(parents) - 1;
  const own: i32 = load<u8>(index + node);
  let faceNodes = 0;
  if (neighbourOf(node, 4) !== NOTHING) faceNodes |= 1;
  if (neighbourOf(node, 22) !== NOTHING) faceNodes |= 2;
  if (neighbourOf(node, 10) !== NOTHING) faceNodes |= 4;
  if (neighbourOf(node, 16) !== NOTHING) faceNodes |= 8;
  if (neighbourOf(node, 12) !== NOTHING) faceNodes |= 16;
  if (neighbourOf(node, 14) !== NOTHING) faceNodes |= 32;
  const scaleGrid = 4 * min(height, 7) + gridOf(node, height);
  let children = 0;
  let taken = 0;
  for (let c = 0; c < 8; c++) {
    if (taken + 8 - c <= least) {
      children |= 1 << c;
      taken++;
      continue;
    }
    const few = min(taken, 4);
    const prefix = (1 << c) + children;
    const here = occupied | occupiedCells(13, children);
    const later = unknown | occupiedCells(13, 0xff & ~((1 << c) - 1));
    const full = min(countAround(c, here), 12);
    const open = min(countAround(c, later), 19);
    let faces = 0;
    for (let face = 0; face < 6; face++) faces = 3 * faces + stateOf(byte(FACES, 6 * c + face), here, later);
    let touching = 0;
    for (let k = 0; k < 7; k++) {
      if (neighbourOf(node, byte(TOUCHING, 7 * c + k)) !== NOTHING) touching |= 1 << k;
    }
    choose(mixer, 0, 256 * scaleGrid + prefix);
    choose(mixer, 1, O1 + (8 * faces + c) * 5 + few);
    choose(mixer, 2, O2 + (8 * touching + c) * 5 + few);
    choose(mixer, 3, O3 + (20 * full + open) * 5 + few);
    choose(mixer, 4, O4 + ((8 * step + brothers) * 8 + c) * 8 + taken);
    choose(mixer, 5, O5 + 256 * faceNodes + prefix);
    choose(mixer, 6, O6 + (8 * parents + own) * 8 + c);
    const bit = mix(mixer, 8 * step + c, 168 + 5 * full + few, 8 * scaleGrid + c);
    children |= bit << c;
    taken += bit;
  }
  occupied |= occupiedCells(13, children);
  return children;
}

function decodeSingles(node: i32, step: i32, children: i32, references: usize, mixer: Mixer): bool {
  const height = depth - 1 - step;
  const taken = <i32>popcnt<u32>(children);
  let existing = 0;
  let crowds = 0;
  for (let j = 0; j < 27; j++) {
    const reference = neighbourOf(node, j);
    if (j === 13 || reference === NOTHING) continue;
    existing++;
    if (reference >= 0) crowds++;
  }
  let crowded = 0;
  const at = place + <usize>node * 12;
  for (let c = 0; c < 8; c++) {
    if (!((children >> c) & 1)) continue;
    let isSingle = height === 0 ? 1 : 0;
    if (height > 0 && taken > 1) {
      const full = min(countAround(c, occupied), 12);
      const open = min(countAround(c, unknown), 19);
      const crowd = min(crowded, 3);
      const last = children >> (c + 1) === 0 ? 1 : 0;
      const three = min(taken, 3);
      choose(mixer, 0, (8 * step + taken - 1) * 8 + 2 * crowd + last);
      choose(mixer, 1, S1 + (20 * full + open) * 4 + three);
      choose(mixer, 2, S2 + (27 * existing + crowds) * 4 + three);
      choose(mixer, 3, S3 + 8 * children + c);
      choose(mixer, 4, S4 + (13 * crowds + full) * 8 + taken - 1);
      isSingle = mix(mixer, 8 * step + taken - 1, 168 + 20 * full + open, 4 * step + crowd);
    }
    const reference = references + (<usize>(8 * node + c) << 2);
    if (!isSingle) {
      crowded++;
      store<i32>(reference, waitingChildren++);
      continue;
    }
    if (found >= anchors) return false;
    store<i32>(reference, -2 - found);
    singleAnchor(
      2 * load<i32>(at) + (c >> 2),
      2 * load<i32>(at, 4) + ((c >> 1) & 1),
      2 * load<i32>(at, 8) + (c & 1),
      height,
      sides(c, 0),
      sides(c, 2),
      sides(c, 4),
    );
  }
  return true;
}

@inline
function sides(c: i32, face: i32): i32 {
  return (
    3 * stateOf(byte(FACES, 6 * c + face), occupied, unknown) +
    stateOf(byte(FACES, 6 * c + face + 1), occupied, unknown)
  );
}

/** The last `bits` bits per axis of an anchor that is alone in its node. */
function singleAnchor(x: i32, y: i32, z: i32, bits: i32, sideX: i32, sideY: i32, sideZ: i32): void {
  const at = offsets + <usize>found * 12;
  found++;
  store<i32>(at, x);
  store<i32>(at, y, 4);
  store<i32>(at, z, 8);
  for (let b = bits - 1; b >= 4; b--) {
    for (let axis = 0; axis < 3; axis++) {
      const component = at + (<usize>axis << 2);
      const value = load<i32>(component);
      const side = axis === 0 ? sideX : axis === 1 ? sideY : sideZ;
      let bit: i32;
      if (b === bits - 1) bit = decideByState(direct + (<usize>(3 * side + axis) << 2), DIRECT_LIMIT);
      else if (b === bits - 2) {
        bit = decideByState(direct + (<usize>(27 + 3 * (2 * side + (value & 1)) + axis) << 2), DIRECT_LIMIT);
      } else bit = decide(32768);
      store<i32>(component, 2 * value + bit);
    }
  }
  const low = min(bits, 4);
  for (let axis = 0; axis < 3; axis++) {
    const component = at + (<usize>axis << 2);
    store<i32>(component, load<i32>(component) << low);
  }
  let zeros = 1;
  let coarse = 0;
  for (let half = 0; half < 2; half++) {
    for (let axis = 0; axis < 3; axis++) {
      const component = at + (<usize>axis << 2);
      for (let b = min(low, 2 * half + 2) - 1; b >= 2 * half; b--) {
        const state = 128 + ((((half * 3 + axis) * 2 + (b & 1)) * 2 + zeros) * 2 + coarse) * 5 + low;
        const bit = decideByState(direct + (<usize>state << 2), DIRECT_LIMIT);
        store<i32>(component, load<i32>(component) | (bit << b));
        if (bit) zeros = 0;
      }
    }
    if (half === 0) coarse = zeros;
  }
}

/** The nodes that wait for the next step take the place of this one's, at `base`. */
function nextLevel(base: usize, step: i32, occupancies: usize, children: usize): void {
  const height = depth - 1 - step;
  const next = alloc(levelBytes(waitingChildren));
  const nextNeighbours = next + <usize>waitingChildren * 12;
  const nextSiblings = next + <usize>waitingChildren * 120;
  const nextIndex = next + <usize>waitingChildren * 121;
  let to = 0;
  for (let node = 0; node < count; node++) {
    for (let c = 0; c < 8; c++) {
      if (load<i32>(children + (<usize>(8 * node + c) << 2)) < 0) continue;
      const from = place + <usize>node * 12;
      const at = next + <usize>to * 12;
      store<i32>(at, 2 * load<i32>(from) + (c >> 2));
      store<i32>(at, 2 * load<i32>(from, 4) + ((c >> 1) & 1), 4);
      store<i32>(at, 2 * load<i32>(from, 8) + (c & 1), 8);
      store<u8>(nextSiblings + to, load<u8>(occupancies + node));
      store<u8>(nextIndex + to, c);
      for (let j = 0; j < 27; j++) {
        const reference = neighbourOf(node, byte(STEP_NODE, 27 * c + j));
        const child = byte(STEP_CHILD, 27 * c + j);
        let known = NOTHING;
        if (reference >= 0) known = load<i32>(children + (<usize>(8 * reference + child) << 2));
        else if (reference !== NOTHING && childHolding(-2 - reference, height) === child) known = reference;
        store<i32>(nextNeighbours + (<usize>(27 * to + j) << 2), known);
      }
      to++;
    }
  }
  memory.copy(base, next, levelBytes(waitingChildren));
  release(base + levelBytes(waitingChildren));
  useLevel(base, waitingChildren);
}
