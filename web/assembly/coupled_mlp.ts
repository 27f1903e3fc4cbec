/**
 * Residual MLPs of coupled primitives, 16 columns at a time in 32-bit floats (docs/bitstream_prediction.md, "The residual
 * MLP"). src/prediction/coupled_mlp.ts prepares what they take.
 *
 * Widths are padded to a multiple of 16 by zeros, outputs to a multiple of 4.
 */

import { alloc } from "./memory";

const SLOPE: f32 = 1.0 / 64.0;

@inline
function leaky(x: v128): v128 {
  return f32x4.max(x, f32x4.mul(x, f32x4.splat(SLOPE)));
}

/** y [columns] = start [columns] + x [inputs] times weights [inputs, columns]; `columns` a multiple of 16. */
@inline
function product(x: usize, inputs: i32, weights: usize, columns: i32, start: usize, y: usize): void {
  const stride = <usize>columns << 2;
  for (let j: usize = 0; j < stride; j += 64) {
    let a = v128.load(start + j);
    let b = v128.load(start + j, 16);
    let c = v128.load(start + j, 32);
    let d = v128.load(start + j, 48);
    let w = weights + j;
    for (let i = 0; i < inputs; i++) {
      const value = v128.load32_splat(x + (<usize>i << 2));
      a = f32x4.add(a, f32x4.mul(value, v128.load(w)));
      b = f32x4.add(b, f32x4.mul(value, v128.load(w, 16)));
      c = f32x4.add(c, f32x4.mul(value, v128.load(w, 32)));
      d = f32x4.add(d, f32x4.mul(value, v128.load(w, 48)));
      w += stride;
    }
    v128.store(y + j, a);
    v128.store(y + j, b, 16);
    v128.store(y + j, c, 32);
    v128.store(y + j, d, 48);
  }
}

/** The same with `columns` a multiple of 4. */
@inline
function narrowProduct(x: usize, inputs: i32, weights: usize, columns: i32, start: usize, y: usize): void {
  const stride = <usize>columns << 2;
  for (let j: usize = 0; j < stride; j += 16) {
    let sum = v128.load(start + j);
    let w = weights + j;
    for (let i = 0; i < inputs; i++) {
      sum = f32x4.add(sum, f32x4.mul(v128.load32_splat(x + (<usize>i << 2)), v128.load(w)));
      w += stride;
    }
    v128.store(y + j, sum);
  }
}

/**
 * Outputs [primitives, outputs] of the coupled primitives of `anchors` anchors, at `out`.
 *
 * `entries` [anchors, width], `skips` [anchors, padded outputs]: the anchors' parts, the view's included.
 * `firstCoupled` [anchors + 1] i32, counted from the first of them. Of the residual embeddings either `slots`
 * [primitives] u8 name rows of `ownEntries` [K, width] and `ownSkips` [K, padded], or, without slots, `residuals`
 * [primitives, residualDim] are multiplied with `residualEntry` [residualDim, width], `residualSkip`
 * [residualDim, padded]. Of each block: `blocks` has weight1 [width, width], bias1, weight2, bias2.
 */
export function runCoupled(
  anchors: i32,
  width: i32,
  padded: i32,
  outputs: i32,
  blockCount: i32,
  entries: usize,
  skips: usize,
  firstCoupled: usize,
  slots: usize,
  ownEntries: usize,
  ownSkips: usize,
  residuals: usize,
  residualDim: i32,
  blocks: usize,
  outputWeight: usize,
  out: usize,
): void {
  const rowBytes = <usize>width << 2;
  const skipBytes = <usize>padded << 2;
  const state = alloc(rowBytes);
  const inner = alloc(rowBytes);
  const sum = alloc(skipBytes);
  const blockBytes: usize = 2 * (rowBytes * width + rowBytes);
  for (let n = 0; n < anchors; n++) {
    const entry = entries + <usize>n * rowBytes;
    const skip = skips + <usize>n * skipBytes;
    const end = load<i32>(firstCoupled + (<usize>n << 2), 4);
    for (let p = load<i32>(firstCoupled + (<usize>n << 2)); p < end; p++) {
      if (slots) {
        const slot = <usize>load<u8>(slots + p);
        for (let j: usize = 0; j < rowBytes; j += 16) {
          v128.store(state + j, f32x4.add(v128.load(entry + j), v128.load(ownEntries + slot * rowBytes + j)));
        }
        for (let j: usize = 0; j < skipBytes; j += 16) {
          v128.store(sum + j, f32x4.add(v128.load(skip + j), v128.load(ownSkips + slot * skipBytes + j)));
        }
      } else {
        const own = residuals + ((<usize>p * residualDim) << 2);
        product(own, residualDim, ownEntries, width, entry, state);
        narrowProduct(own, residualDim, ownSkips, padded, skip, sum);
      }
      for (let j: usize = 0; j < rowBytes; j += 16) v128.store(state + j, leaky(v128.load(state + j)));
      for (let b = 0; b < blockCount; b++) {
        const block = blocks + <usize>b * blockBytes;
        const second = block + rowBytes * width + rowBytes;
        product(state, width, block, width, block + rowBytes * width, inner);
        const bias2 = second + rowBytes * width;
        for (let j: usize = 0; j < rowBytes; j += 16) {
          v128.store(inner + j, leaky(v128.load(inner + j)));
          v128.store(state + j, f32x4.add(v128.load(state + j), v128.load(bias2 + j)));
        }
        product(inner, width, second, width, state, state);
      }
      narrowProduct(state, width, outputWeight, padded, sum, sum);
      for (let o = 0; o < outputs; o++) {
        store<f32>(out + ((<usize>p * outputs + o) << 2), load<f32>(sum + (<usize>o << 2)));
      }
    }
  }
}
