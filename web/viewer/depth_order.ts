/** Which primitives are drawn, from back to front: a radix sort of depths in two passes of 11 bits. */

import { ROW } from "./splatting.ts";

const BITS = 11;
const BUCKETS = 1 << BITS;
const STEPS = 2 ** (2 * BITS) - 1;

/** Primitives that have one frame. */
export interface DepthPart {
  means: Float32Array;
  opacities: Float32Array;
  sound: Uint8Array;
  /** Added to the product of axis and mean, it is the depth. */
  shift: number;
  /** Where the renderer has each 2048 of them. */
  rows: readonly number[];
}

export class DepthOrder {
  private depths = new Float32Array(0);
  private chosen = new Uint32Array(0);
  private keys = new Uint32Array(0);
  private spare = new Uint32Array(0);
  private spareKeys = new Uint32Array(0);

  /**
   * The renderer's indices of primitives that are in front of the camera and have an opacity above `cutoff`, the
   * farthest first. `axis`: third row of the camera's rotation.
   */
  sort(
    parts: readonly DepthPart[],
    axis: readonly [number, number, number],
    cutoff: number,
    near: number,
  ): Uint32Array<ArrayBuffer> {
    const total = parts.reduce((sum, { opacities }) => sum + opacities.length, 0);
    if (this.keys.length < total) {
      this.depths = new Float32Array(total);
      for (const name of ["chosen", "keys", "spare", "spareKeys"] as const)
        this[name] = new Uint32Array(total);
    }
    const { depths, chosen, keys, spare, spareKeys } = this;
    const [x, y, z] = axis;
    let count = 0;
    let [nearest, farthest] = [Infinity, near];
    for (const { means, opacities, sound, shift, rows } of parts) {
      for (let p = 0; p < opacities.length; p++) {
        if (!(opacities[p]! > cutoff) || !sound[p]) continue;
        const depth = x * means[3 * p]! + y * means[3 * p + 1]! + z * means[3 * p + 2]! + shift;
        if (depth < near) continue;
        if (depth < nearest) nearest = depth;
        if (depth > farthest) farthest = depth;
        depths[count] = depth;
        chosen[count++] = rows[Math.floor(p / ROW)]! * ROW + (p % ROW);
      }
    }
    const scale = STEPS / Math.max(farthest - nearest, 1e-30);
    for (let i = 0; i < count; i++) keys[i] = Math.min(STEPS, Math.max(0, (farthest - depths[i]!) * scale));
    pass(chosen, keys, spare, spareKeys, count, 0);
    pass(spare, spareKeys, chosen, keys, count, BITS);
    return chosen.slice(0, count);
  }
}

function pass(
  from: Uint32Array,
  fromKeys: Uint32Array,
  to: Uint32Array,
  toKeys: Uint32Array,
  count: number,
  bit: number,
): void {
  const starts = new Uint32Array(BUCKETS + 1);
  for (let i = 0; i < count; i++) starts[((fromKeys[i]! >>> bit) & (BUCKETS - 1)) + 1]!++;
  for (let bucket = 0; bucket < BUCKETS; bucket++) starts[bucket + 1]! += starts[bucket]!;
  for (let i = 0; i < count; i++) {
    const place = starts[(fromKeys[i]! >>> bit) & (BUCKETS - 1)]!++;
    to[place] = from[i]!;
    toKeys[place] = fromKeys[i]!;
  }
}
