/** 16-bit floats, as graphics memory has them. */

const FLOAT = new Float32Array(1);
const BITS = new Uint32Array(FLOAT.buffer);
/** Bits of float32: 2^16, where halves end; 2^-14, below which they are subnormal; infinity. */
const BEYOND = 0x47800000;
const NORMAL = 0x38800000;
const INFINITE = 0x7f800000;
/** Between the exponents of both. */
const REBIAS = 0x38000000;

/** Bits of the half that is nearest to a number; of two equally near the even one. */
export function toHalf(x: number): number {
  FLOAT[0] = x;
  const sign = (BITS[0]! >>> 16) & 0x8000;
  const size = BITS[0]! & 0x7fffffff;
  if (size > INFINITE) return 0x7e00;
  if (size >= BEYOND) return sign | 0x7c00;
  if (size < NORMAL) {
    // A float32 of 1/2 has the steps of subnormal halves: the addition rounds.
    FLOAT[0] = Math.abs(x) + 0.5;
    return sign | (BITS[0]! - 0x3f000000);
  }
  return sign | ((size - REBIAS + 0xfff + ((size >>> 13) & 1)) >>> 13);
}
