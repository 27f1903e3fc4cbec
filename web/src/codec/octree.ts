/** The walk of the context-mixed octree (docs/bitstream.md, "Positions"). */

import { CorruptSection } from "../errors.ts";
import type { ArithmeticDecoder } from "./arithmetic_decoder.ts";
import { AdaptiveStates, Mixer } from "./mixer.ts";
import {
  AROUND_HIGH,
  AROUND_LOW,
  FACES,
  FACE_NODES,
  NEIGHBOUR_HIGH,
  NEIGHBOUR_LOW,
  OCCUPIED_HIGH,
  OCCUPIED_LOW,
  STEP_CHILD,
  STEP_NODE,
  TOUCHING,
  countBits,
} from "./octree_grid.ts";

const NOTHING = -1;
/** References to nodes: the index of a waiting node, or -2 - index of a single anchor, or NOTHING. */
const single = (anchor: number): number => -2 - anchor;
const DIRECT_STATES = 128;

/** The nodes of one level that hold at least two anchors each, in the order of the walk. */
interface Waiting {
  count: number;
  /** [count, 3] */
  place: Int32Array;
  /** [count, 27] references */
  neighbours: Int32Array;
  /** [count] sum of 2^i over the occupied children i of the parent */
  siblings: Uint8Array;
  /** [count] own place among the parent's eight */
  index: Uint8Array;
}

function room(capacity: number): Waiting {
  return {
    count: 0,
    place: new Int32Array(capacity * 3),
    neighbours: new Int32Array(capacity * 27).fill(NOTHING),
    siblings: new Uint8Array(capacity),
    index: new Uint8Array(capacity),
  };
}

/** Offsets [n, 3] of n distinct anchors in the order of the walk. */
export class OctreeWalk {
  readonly offsets: Int32Array;
  private found = 0;
  private waitingChildren = 0;

  private readonly occupancy = new Mixer({
    contexts: [8192, 29160, 5120, 1300, 10752, 16384, 16384],
    weightSets: 168 + 65,
    refinements: 8 * 32,
    initialWeight: 16384,
    limit: 400,
    rate: 4,
  });
  private readonly singles = new Mixer({
    contexts: [1344, 1040, 2916, 2048, 2808],
    weightSets: 168 + 260,
    refinements: 84,
    initialWeight: 16384,
    limit: 400,
    rate: 4,
  });
  private readonly direct = new AdaptiveStates(368, 1000);

  // The cells around the node at hand: low and high halves of occupied and unknown ones.
  private occupiedLow = 0;
  private occupiedHigh = 0;
  private unknownLow = 0;
  private unknownHigh = 0;

  constructor(
    private readonly decoder: ArithmeticDecoder,
    private readonly anchors: number,
    private readonly depth: number,
    private readonly mostNodes: number,
    private readonly section: string,
  ) {
    this.offsets = new Int32Array(anchors * 3);
  }

  run(): Int32Array {
    if (this.anchors === 1) {
      this.singleAnchor(0, 0, 0, this.depth, [0, 0, 0]);
      return this.offsets;
    }
    let level = room(1);
    level.count = 1;
    level.neighbours[13] = 0;
    level.siblings[0] = 1;
    let nodes = 0;
    for (let step = 0; step < this.depth && level.count; step++) {
      nodes += level.count;
      if (nodes > this.mostNodes) this.refuse(`more than ${this.mostNodes} nodes, the most for this file`);
      level = this.walkLevel(level, step);
    }
    if (this.found !== this.anchors) this.refuse(`${this.found} anchors, expected ${this.anchors}`);
    return this.offsets;
  }

  private refuse(problem: string): never {
    throw new CorruptSection(`${this.section}: ${problem}`);
  }

  private walkLevel(level: Waiting, step: number): Waiting {
    // Reference of each child of each node of the level.
    const children = new Int32Array(level.count * 8).fill(NOTHING);
    const occupancies = new Uint8Array(level.count);
    this.waitingChildren = 0;
    for (let node = 0; node < level.count; node++) {
      this.lookAround(level, node, step, occupancies);
      occupancies[node] = this.decodeOccupancy(level, node, step);
      this.decodeSingles(level, node, step, occupancies[node]!, children);
      this.checkCount(level.count - 1 - node);
    }
    return this.nextLevel(level, step, occupancies, children);
  }

  /** Refuses when the anchors that were found, and two for each node that waits, are more than there are. */
  private checkCount(waitingHere: number): void {
    const least = this.found + 2 * (this.waitingChildren + waitingHere);
    if (least > this.anchors) this.refuse(`at least ${least} anchors, expected ${this.anchors}`);
  }

  /** What is known of the cells around a node before its own children are decoded. */
  private lookAround(level: Waiting, node: number, step: number, occupancies: Uint8Array): void {
    let [occupiedLow, occupiedHigh, unknownLow, unknownHigh] = [0, 0, 0, 0];
    const height = this.depth - 1 - step;
    for (let j = 0; j < 27; j++) {
      const reference = level.neighbours[27 * node + j]!;
      if (reference === NOTHING || j === 13) continue;
      if (reference > node) {
        unknownLow |= NEIGHBOUR_LOW[j]!;
        unknownHigh |= NEIGHBOUR_HIGH[j]!;
        continue;
      }
      const occupancy =
        reference >= 0 ? occupancies[reference]! : 1 << this.childHolding(-2 - reference, height);
      occupiedLow |= OCCUPIED_LOW[256 * j + occupancy]!;
      occupiedHigh |= OCCUPIED_HIGH[256 * j + occupancy]!;
    }
    this.occupiedLow = occupiedLow;
    this.occupiedHigh = occupiedHigh;
    this.unknownLow = unknownLow;
    this.unknownHigh = unknownHigh;
  }

  /** Which child of its node, `height` bits above the voxels, holds an anchor. */
  private childHolding(anchor: number, height: number): number {
    const { offsets } = this;
    const bit = (axis: number) => (offsets[3 * anchor + axis]! >> height) & 1;
    return 4 * bit(0) + 2 * bit(1) + bit(2);
  }

  private decodeOccupancy(level: Waiting, node: number, step: number): number {
    const { neighbours } = level;
    const { at } = this.occupancy;
    const height = this.depth - 1 - step;
    const least = height === 0 ? 2 : 1;
    const base = 27 * node;
    const parents = level.siblings[node]!;
    const siblings = countBits(parents) - 1;
    const index = level.index[node]!;
    let faceNodes = 0;
    for (let k = 0; k < 6; k++) if (neighbours[base + FACE_NODES[k]!] !== NOTHING) faceNodes |= 1 << k;
    const scaleGrid = 4 * Math.min(height, 7) + gridOf(level.place, node, height);
    let children = 0;
    let taken = 0;
    for (let c = 0; c < 8; c++) {
      if (taken + 8 - c <= least) {
        children |= 1 << c;
        taken++;
        continue;
      }
      const few = Math.min(taken, 4);
      const prefix = (1 << c) + children;
      const later = 0xff & ~((1 << c) - 1);
      const occupiedLow = this.occupiedLow | OCCUPIED_LOW[256 * 13 + children]!;
      const occupiedHigh = this.occupiedHigh | OCCUPIED_HIGH[256 * 13 + children]!;
      const unknownLow = this.unknownLow | OCCUPIED_LOW[256 * 13 + later]!;
      const unknownHigh = this.unknownHigh | OCCUPIED_HIGH[256 * 13 + later]!;
      const occupied = Math.min(countAround(c, occupiedLow, occupiedHigh), 12);
      const open = Math.min(countAround(c, unknownLow, unknownHigh), 19);
      let faces = 0;
      for (let face = 0; face < 6; face++) {
        const cell = FACES[6 * c + face]!;
        faces = 3 * faces + stateOf(cell, occupiedLow, occupiedHigh, unknownLow, unknownHigh);
      }
      let touching = 0;
      for (let k = 0; k < 7; k++) if (neighbours[base + TOUCHING[7 * c + k]!] !== NOTHING) touching |= 1 << k;
      at[0] = 256 * scaleGrid + prefix;
      at[1] = (8 * faces + c) * 5 + few;
      at[2] = (8 * touching + c) * 5 + few;
      at[3] = (20 * occupied + open) * 5 + few;
      at[4] = ((8 * step + siblings) * 8 + c) * 8 + taken;
      at[5] = 256 * faceNodes + prefix;
      at[6] = (8 * parents + index) * 8 + c;
      const bit = this.occupancy.decide(
        this.decoder,
        8 * step + c,
        168 + 5 * occupied + few,
        8 * scaleGrid + c,
      );
      children |= bit << c;
      taken += bit;
    }
    this.occupiedLow |= OCCUPIED_LOW[256 * 13 + children]!;
    this.occupiedHigh |= OCCUPIED_HIGH[256 * 13 + children]!;
    return children;
  }

  private decodeSingles(
    level: Waiting,
    node: number,
    step: number,
    children: number,
    references: Int32Array,
  ): void {
    const { at } = this.singles;
    const { occupiedLow, occupiedHigh, unknownLow, unknownHigh } = this;
    const height = this.depth - 1 - step;
    const taken = countBits(children);
    let neighbours = 0;
    let crowds = 0;
    for (let j = 0; j < 27; j++) {
      const reference = level.neighbours[27 * node + j]!;
      if (j === 13 || reference === NOTHING) continue;
      neighbours++;
      if (reference >= 0) crowds++;
    }
    let crowded = 0;
    for (let c = 0; c < 8; c++) {
      if (!((children >> c) & 1)) continue;
      let isSingle = height === 0 ? 1 : 0;
      if (height > 0 && taken > 1) {
        const occupied = Math.min(countAround(c, occupiedLow, occupiedHigh), 12);
        const open = Math.min(countAround(c, unknownLow, unknownHigh), 19);
        const crowd = Math.min(crowded, 3);
        const last = children >> (c + 1) === 0 ? 1 : 0;
        const three = Math.min(taken, 3);
        at[0] = (8 * step + taken - 1) * 8 + 2 * crowd + last;
        at[1] = (20 * occupied + open) * 4 + three;
        at[2] = (27 * neighbours + crowds) * 4 + three;
        at[3] = 8 * children + c;
        at[4] = (13 * crowds + occupied) * 8 + taken - 1;
        isSingle = this.singles.decide(
          this.decoder,
          8 * step + taken - 1,
          168 + 20 * occupied + open,
          4 * step + crowd,
        );
      }
      if (!isSingle) {
        crowded++;
        references[8 * node + c] = this.waitingChildren++;
        continue;
      }
      if (this.found >= this.anchors) this.refuse(`more than ${this.anchors} anchors`);
      references[8 * node + c] = single(this.found);
      const state = (face: number): number =>
        stateOf(FACES[6 * c + face]!, occupiedLow, occupiedHigh, unknownLow, unknownHigh);
      const sides: [number, number, number] = [
        3 * state(0) + state(1),
        3 * state(2) + state(3),
        3 * state(4) + state(5),
      ];
      const place = level.place;
      const x = 2 * place[3 * node]! + (c >> 2);
      const y = 2 * place[3 * node + 1]! + ((c >> 1) & 1);
      const z = 2 * place[3 * node + 2]! + (c & 1);
      this.singleAnchor(x, y, z, height, sides);
    }
  }

  /** The last `bits` bits per axis of an anchor that is alone in its node. */
  private singleAnchor(x: number, y: number, z: number, bits: number, sides: [number, number, number]): void {
    const { decoder, direct } = this;
    const place = [x, y, z];
    for (let b = bits - 1; b >= 4; b--) {
      for (let axis = 0; axis < 3; axis++) {
        let bit: number;
        if (b === bits - 1) bit = direct.decide(decoder, 3 * sides[axis]! + axis);
        else if (b === bits - 2)
          bit = direct.decide(decoder, 27 + 3 * (2 * sides[axis]! + (place[axis]! & 1)) + axis);
        else bit = decoder.decide(32768);
        place[axis] = 2 * place[axis]! + bit;
      }
    }
    const low = Math.min(bits, 4);
    let zeros = 1;
    let coarse = 0;
    const fine = [0, 0, 0];
    for (let half = 0; half < 2; half++) {
      for (let axis = 0; axis < 3; axis++) {
        for (let b = Math.min(low, 2 * half + 2) - 1; b >= 2 * half; b--) {
          const state =
            DIRECT_STATES + ((((half * 3 + axis) * 2 + (b & 1)) * 2 + zeros) * 2 + coarse) * 5 + low;
          const bit = direct.decide(decoder, state);
          fine[axis]! |= bit << b;
          if (bit) zeros = 0;
        }
      }
      if (half === 0) coarse = zeros;
    }
    const at = 3 * this.found++;
    for (let axis = 0; axis < 3; axis++) this.offsets[at + axis] = (place[axis]! << low) | fine[axis]!;
  }

  /** The nodes that wait for the next step, with references to what lies around them. */
  private nextLevel(level: Waiting, step: number, occupancies: Uint8Array, children: Int32Array): Waiting {
    const next = room(this.waitingChildren);
    if (!this.waitingChildren) return next;
    const height = this.depth - 1 - step;
    for (let node = 0; node < level.count; node++) {
      for (let c = 0; c < 8; c++) {
        if (children[8 * node + c]! < 0) continue;
        const to = next.count++;
        next.place[3 * to] = 2 * level.place[3 * node]! + (c >> 2);
        next.place[3 * to + 1] = 2 * level.place[3 * node + 1]! + ((c >> 1) & 1);
        next.place[3 * to + 2] = 2 * level.place[3 * node + 2]! + (c & 1);
        next.siblings[to] = occupancies[node]!;
        next.index[to] = c;
        for (let j = 0; j < 27; j++) {
          const reference = level.neighbours[27 * node + STEP_NODE[27 * c + j]!]!;
          if (reference === NOTHING) continue;
          const child = STEP_CHILD[27 * c + j]!;
          if (reference >= 0) next.neighbours[27 * to + j] = children[8 * reference + child]!;
          else if (this.childHolding(-2 - reference, height) === child)
            next.neighbours[27 * to + j] = reference;
        }
      }
    }
    return next;
  }
}

function gridOf(place: Int32Array, node: number, height: number): number {
  if (height > 2) return 0;
  const bits = place[3 * node]! | place[3 * node + 1]! | place[3 * node + 2]!;
  const aligned = (bits & ((1 << (3 - height)) - 1)) === 0 ? 1 : 0;
  return aligned + (height === 0 && (bits & 1) === 0 ? 2 : 0);
}

function countAround(child: number, low: number, high: number): number {
  return countBits(low & AROUND_LOW[child]!) + countBits(high & AROUND_HIGH[child]!);
}

/** 0 empty, 1 occupied, 2 unknown. */
function stateOf(cell: number, occLow: number, occHigh: number, unkLow: number, unkHigh: number): number {
  const bit = cell & 31;
  if (cell < 32) return ((occLow >>> bit) & 1) + 2 * ((unkLow >>> bit) & 1);
  return ((occHigh >>> bit) & 1) + 2 * ((unkHigh >>> bit) & 1);
}
