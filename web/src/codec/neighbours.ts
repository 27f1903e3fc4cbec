/** What anchors of earlier ranges have around those of a range (docs/bitstream.md, "Neighbours"). */

import { FRACTION_BITS, NEAREST_WEIGHT } from "./constants.ts";
import { type Follow, clampActivation } from "./networks.ts";

/** Numbers that a network takes of an anchor's neighbours: known, activity. */
export const NEIGHBOUR_INPUTS = 2;
const ONE = 1 << FRACTION_BITS;
const MAX_NEIGHBOURS = 27;

/** What the neighbours of n anchors have of a group, Q12. */
export interface Surroundings {
  /** [n, 2] known, activity */
  inputs: Int32Array;
  /** [n, channels] */
  around: Int32Array;
}

/**
 * Moves means [n, channels] by what is around them, of the same shape, whole steps from the `centre`, which begins with
 * a number for each channel. All Q12.
 */
export function followNeighbours(
  means: Int32Array,
  around: Int32Array,
  centre: Int32Array,
  { weight, shift }: Follow,
): void {
  const half = shift > 0 ? 2 ** (shift - 1) : 0;
  const scale = 2 ** -shift;
  for (let i = 0; i < means.length; i++) {
    const c = i % weight.length;
    // Up to 2^51 before the shift.
    const moved = means[i]! - centre[c]! + Math.floor((weight[c]! * around[i]! + half) * scale);
    means[i] = clampActivation(centre[c]! + Math.floor((moved + ONE / 2) / ONE) * ONE);
  }
}

/** The anchors of earlier ranges: one for each occupied node. */
export class EarlierAnchors {
  private nodes: NodeTable | null = null;

  /** `offsets` [count, 3]; an anchor's node is its offset without the lowest `shift` bits. */
  constructor(
    private readonly offsets: Int32Array,
    private readonly shift: number,
  ) {}

  /**
   * Of anchors at `offsets` [n, 3].
   *
   * `latents` [count, channels], Q12, are those of the earlier anchors; `means`, Q12, begin with one for each channel.
   */
  surroundings(offsets: Int32Array, latents: Int32Array, means: Int32Array): Surroundings {
    const channels = (3 * latents.length) / this.offsets.length;
    const values = departures(latents, means, channels);
    const count = offsets.length / 3;
    const inputs = new Int32Array(count * NEIGHBOUR_INPUTS);
    const around = new Int32Array(count * channels);
    const sums = new Float64Array(1 + channels);
    const found = new Int32Array(MAX_NEIGHBOURS);
    let neighbours = 0;
    for (let row = 0; row < count; row++) {
      const i = 3 * row;
      // Anchors of one node often follow each other.
      if (i === 0 || !this.haveSameNode(offsets, i - 3, i)) neighbours = this.find(offsets, i, found);
      sums.fill(0);
      let weights = 0;
      for (let n = 0; n < neighbours; n++) {
        const j = found[n]!;
        const weight = 1 + Math.floor(NEAREST_WEIGHT / this.distance(j, offsets, i));
        weights += weight;
        for (let c = 0; c < sums.length; c++) sums[c]! += weight * values[j * sums.length + c]!;
      }
      // Exact floors: where a / b is not whole, it is at least 1 / b away from what is, and rounding moves it by less,
      // as |a| + b < 2^53.
      inputs[2 * row] = ONE;
      inputs[2 * row + 1] = Math.floor(sums[0]! / weights);
      for (let c = 0; c < channels; c++) around[row * channels + c] = Math.floor(sums[1 + c]! / weights);
    }
    return { inputs, around };
  }

  private haveSameNode(offsets: Int32Array, i: number, j: number): boolean {
    const differences =
      (offsets[i]! ^ offsets[j]!) | (offsets[i + 1]! ^ offsets[j + 1]!) | (offsets[i + 2]! ^ offsets[j + 2]!);
    return differences >> this.shift === 0;
  }

  private distance(anchor: number, offsets: Int32Array, i: number): number {
    return (
      Math.abs(offsets[i]! - this.offsets[3 * anchor]!) +
      Math.abs(offsets[i + 1]! - this.offsets[3 * anchor + 1]!) +
      Math.abs(offsets[i + 2]! - this.offsets[3 * anchor + 2]!)
    );
  }

  /** Puts the neighbours of the anchor whose offset begins at `i` into `found`; how many they are. */
  private find(offsets: Int32Array, i: number, found: Int32Array): number {
    const { shift } = this;
    this.nodes ??= new NodeTable(this.offsets.map((offset) => offset >> shift));
    const [x, y, z] = [offsets[i]! >> shift, offsets[i + 1]! >> shift, offsets[i + 2]! >> shift];
    let neighbours = 0;
    for (let dx = -1; dx <= 1; dx++) {
      for (let dy = -1; dy <= 1; dy++) {
        for (let dz = -1; dz <= 1; dz++) {
          const j = this.nodes.find(x + dx, y + dy, z + dz);
          if (j >= 0) found[neighbours++] = j;
        }
      }
    }
    return neighbours;
  }
}

/** [n, 1 + channels] how far latents [n, channels] are from the means: on average, and in each channel. */
function departures(latents: Int32Array, means: Int32Array, channels: number): Int32Array {
  const values = new Int32Array((latents.length / channels) * (1 + channels));
  let at = 0;
  for (let i = 0; i < latents.length; i += channels) {
    const average = at++;
    let sum = 0;
    for (let c = 0; c < channels; c++) {
      const difference = latents[i + c]! - means[c]!; // may leave 32 bits
      const clamped = clampActivation(difference);
      sum += Math.abs(clamped);
      values[at++] = clamped;
    }
    values[average] = Math.floor(sum / channels);
  }
  return values;
}

/** Finds nodes by their three numbers, 63 bits in all: hashing with open addressing. */
class NodeTable {
  /** Of a node its index plus 1, at its place or behind; 0: free. At least half are. */
  private readonly entries: Int32Array;
  private readonly last: number;
  private readonly hashShift: number;
  /** Drawn anew for each table: nobody can write a file all of whose nodes have one place. */
  private readonly a = randomFactor();
  private readonly b = randomFactor();
  private readonly c = randomFactor();

  /** `nodes` [count, 3], distinct. */
  constructor(private readonly nodes: Int32Array) {
    const count = nodes.length / 3;
    const bits = 33 - Math.clz32(count - 1);
    this.entries = new Int32Array(2 ** bits);
    this.last = this.entries.length - 1;
    this.hashShift = 32 - bits;
    for (let i = 0; i < count; i++) {
      let place = this.placeOf(nodes[3 * i]!, nodes[3 * i + 1]!, nodes[3 * i + 2]!);
      while (this.entries[place]) place = (place + 1) & this.last;
      this.entries[place] = i + 1;
    }
  }

  /** Index of a node, or -1. */
  find(x: number, y: number, z: number): number {
    const { nodes, entries, last } = this;
    for (let place = this.placeOf(x, y, z); entries[place]; place = (place + 1) & last) {
      const i = entries[place]! - 1;
      if (nodes[3 * i] === x && nodes[3 * i + 1] === y && nodes[3 * i + 2] === z) return i;
    }
    return -1;
  }

  private placeOf(x: number, y: number, z: number): number {
    // The highest bits depend on all those of the node.
    return (Math.imul(this.a, x) + Math.imul(this.b, y) + Math.imul(this.c, z)) >>> this.hashShift;
  }
}

/** Odd, of 32 bits. */
function randomFactor(): number {
  return (Math.random() * 2 ** 32) | 1;
}
