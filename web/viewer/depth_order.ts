/** Which primitives are drawn, from back to front: a radix sort of depths in two passes of 11 bits. */

const BITS = 11;
const BUCKETS = 1 << BITS;
const STEPS = 2 ** (2 * BITS) - 1;

export class DepthOrder {
  private keys = new Uint32Array(0);
  private chosen = new Uint32Array(0);
  private spare = new Uint32Array(0);

  /**
   * Indices of primitives that are in front of the camera and have an opacity above `cutoff`, the farthest first.
   *
   * `axis`: third row of the camera's rotation, `shift`: third component of its translation.
   */
  sort(
    means: Float32Array,
    opacities: Float32Array,
    sound: Uint8Array,
    axis: readonly [number, number, number],
    shift: number,
    cutoff: number,
    near: number,
  ): Uint32Array<ArrayBuffer> {
    const total = opacities.length;
    if (this.keys.length < total) {
      this.keys = new Uint32Array(total);
      this.chosen = new Uint32Array(total);
      this.spare = new Uint32Array(total);
    }
    const { keys, chosen, spare } = this;
    const [x, y, z] = axis;
    const depthOf = (p: number): number =>
      x * means[3 * p]! + y * means[3 * p + 1]! + z * means[3 * p + 2]! + shift;
    let count = 0;
    let [nearest, farthest] = [Infinity, near];
    for (let p = 0; p < total; p++) {
      if (!(opacities[p]! > cutoff) || !sound[p]) continue;
      const depth = depthOf(p);
      if (depth < near) continue;
      if (depth < nearest) nearest = depth;
      if (depth > farthest) farthest = depth;
      chosen[count++] = p;
    }
    const scale = STEPS / Math.max(farthest - nearest, 1e-30);
    for (let i = 0; i < count; i++) keys[chosen[i]!] = (farthest - depthOf(chosen[i]!)) * scale;
    pass(chosen, spare, keys, count, 0);
    pass(spare, chosen, keys, count, BITS);
    return chosen.slice(0, count);
  }
}

function pass(from: Uint32Array, to: Uint32Array, keys: Uint32Array, count: number, bit: number): void {
  const starts = new Uint32Array(BUCKETS + 1);
  for (let i = 0; i < count; i++) starts[((keys[from[i]!]! >>> bit) & (BUCKETS - 1)) + 1]!++;
  for (let bucket = 0; bucket < BUCKETS; bucket++) starts[bucket + 1]! += starts[bucket]!;
  for (let i = 0; i < count; i++) {
    const p = from[i]!;
    to[starts[(keys[p]! >>> bit) & (BUCKETS - 1)]!++] = p;
  }
}
