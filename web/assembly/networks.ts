/** Integer networks, two outputs at a time: all sums are integers below 2^53, so that 64-bit floats are exact. */

const LEAST: f64 = -8388608;
const MOST: f64 = 8388607;

/**
 * One layer for `rows` rows. `weights`: [inputs, padded outputs] f64, outputs padded to a multiple of 2 by zeros;
 * `bias`: [padded outputs] f64. `x`, `y`: f64 with `xStride`, `yStride` numbers a row. `added`: what the layer before
 * took, or 0.
 */
export function applyLayer(
  weights: usize,
  bias: usize,
  inputs: i32,
  padded: i32,
  shift: i32,
  rectify: bool,
  x: usize,
  xStride: i32,
  y: usize,
  yStride: i32,
  added: usize,
  addedStride: i32,
  rows: i32,
): void {
  const half = f64x2.splat(shift > 0 ? <f64>(<u64>1 << (shift - 1)) : 0);
  const scale = f64x2.splat(1.0 / <f64>(<u64>1 << shift));
  const least = f64x2.splat(LEAST);
  const most = f64x2.splat(MOST);
  const slope = f64x2.splat(1.0 / 64.0);
  for (let row = 0; row < rows; row++) {
    const input = x + ((<usize>row * xStride) << 3);
    const output = y + ((<usize>row * yStride) << 3);
    const skipped = added + ((<usize>row * addedStride) << 3);
    for (let o = 0; o < padded; o += 2) {
      let sum = f64x2.splat(0);
      let w = weights + (<usize>o << 3);
      for (let i = 0; i < inputs; i++) {
        sum = f64x2.add(sum, f64x2.mul(v128.load64_splat(input + (<usize>i << 3)), v128.load(w)));
        w += <usize>padded << 3;
      }
      sum = f64x2.floor(f64x2.mul(f64x2.add(sum, half), scale));
      sum = f64x2.add(sum, v128.load(bias + (<usize>o << 3)));
      if (rectify) sum = f64x2.max(sum, f64x2.floor(f64x2.mul(sum, slope)));
      sum = f64x2.min(f64x2.max(sum, least), most);
      if (added) {
        sum = f64x2.add(sum, v128.load(skipped + (<usize>o << 3)));
        sum = f64x2.min(f64x2.max(sum, least), most);
      }
      v128.store(output + (<usize>o << 3), sum);
    }
  }
}
