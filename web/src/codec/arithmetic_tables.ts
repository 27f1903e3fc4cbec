/** Tables of the arithmetic code's models. BigInt is slow, and 4096 products of it take a millisecond. */

function makeSquash(): Int32Array {
  const one = 1n << 64n;
  const squash = new Int32Array(4096);
  let e = one;
  for (let x = 0; x <= 2048; x++) {
    const sum = one + e;
    const value = Number((65536n * e + sum / 2n) / sum);
    if (x <= 2048) squash[2048 - x] = value;
    if (x > 0 && x < 2048) squash[2048 + x] = 65536 - value;
    e = (18374827034086858296n * e) >> 64n;
  }
  return squash;
}

function makeStretch(): Int32Array {
  const stretch = new Int32Array(4096);
  let below = 0;
  for (let i = 0; i < 4096; i++) {
    while (below < 4096 && SQUASH[below]! < 16 * i + 8) below++;
    stretch[i] = Math.max(-2047, Math.min(2047, below - 2048));
  }
  return stretch;
}

/** SQUASH(x) is at x + 2048. */
export const SQUASH = makeSquash();
export const STRETCH = makeStretch();
export const RATE = Int32Array.from({ length: 1024 }, (_, n) => Math.floor(655360 / (10 * n + 16)));
export const CONFIDENCE = Int32Array.from({ length: 1024 }, (_, n) => Math.floor((256 * n) / (n + 3)));
