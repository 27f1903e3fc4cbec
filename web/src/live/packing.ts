/** Splats in the layouts that engines hold them in. */

import { type Appearance, type Geometry, OPACITY_CUTOFF } from "../prediction/predictor.ts";
import { toHalf } from "./halves.ts";

/** Geometry of each layout; `colors` of all of them are those of `packColors`. */
export interface Layouts {
  /** Float32 of the coupled primitives, as they are. */
  arrays: {
    /** [P, 3] local frame */
    means: Float32Array<ArrayBuffer>;
    /** [P, 4] w, x, y, z; of length 1 */
    quaternions: Float32Array<ArrayBuffer>;
    /** [P, 3] standard deviations */
    scales: Float32Array<ArrayBuffer>;
  };
  /** Two times four words a splat, as `ExtSplats` of Spark has them. */
  spark: { words: [Uint32Array<ArrayBuffer>, Uint32Array<ArrayBuffer>] };
  /** Texels of four numbers for a `GSplatContainer` of PlayCanvas, and its bounds. */
  playcanvas: {
    means: Float32Array<ArrayBuffer>;
    /** [P, 3] once more: the engine sorts by them. */
    centers: Float32Array<ArrayBuffer>;
    /** [P, 4] halves: natural logarithms of the standard deviations, and 0 */
    logScales: Uint16Array<ArrayBuffer>;
    /** [P, 4] halves: w, x, y, z; of length 1 */
    quaternions: Uint16Array<ArrayBuffer>;
    least: [number, number, number];
    most: [number, number, number];
  };
}

export type Layout = keyof Layouts;

export const PACKERS: { [L in Layout]: (geometry: Geometry) => Layouts[L] } = {
  arrays: packArrays,
  spark: packForSpark,
  playcanvas: packForPlayCanvas,
};

/** [P, 4] bytes: red, green, blue, opacity; opacity 0 for what the camera does not see. */
export function packColors({ opacities, colors }: Appearance, sound: Uint8Array): Uint8Array<ArrayBuffer> {
  const count = opacities.length;
  const packed = new Uint8Array(4 * count);
  for (let p = 0; p < count; p++) {
    // Numbers that are not a number are above nothing.
    if (!sound[p] || !(opacities[p]! > OPACITY_CUTOFF)) continue;
    for (let c = 0; c < 3; c++) packed[4 * p + c] = toByte(colors[3 * p + c]!);
    packed[4 * p + 3] = toByte(opacities[p]!);
  }
  return packed;
}

function toByte(x: number): number {
  return Math.round(255 * Math.max(0, Math.min(1, x)));
}

/** [P, 4] w, x, y, z of length 1; no rotation where a primitive is not sound. */
function unitQuaternions(
  { quaternions, sound }: Geometry,
  put: (at: number, q: [number, number, number, number]) => void,
): void {
  for (let p = 0; p < sound.length; p++) {
    if (!sound[p]) {
      put(p, [1, 0, 0, 0]);
      continue;
    }
    const at = 4 * p;
    const [w, x, y, z] = [
      quaternions[at]!,
      quaternions[at + 1]!,
      quaternions[at + 2]!,
      quaternions[at + 3]!,
    ] as const;
    const unit = 1 / Math.hypot(w, x, y, z);
    put(p, [w * unit, x * unit, y * unit, z * unit]);
  }
}

/** [P, 3] with zeros where a primitive is not sound. */
function soundOnes(values: Float32Array, sound: Uint8Array): Float32Array<ArrayBuffer> {
  const result = new Float32Array(values);
  for (let p = 0; p < sound.length; p++) if (!sound[p]) result.fill(0, 3 * p, 3 * p + 3);
  return result;
}

function packArrays(geometry: Geometry): Layouts["arrays"] {
  const { means, scales, sound } = geometry;
  const quaternions = new Float32Array(4 * sound.length);
  unitQuaternions(geometry, (p, q) => quaternions.set(q, 4 * p));
  return { means: soundOnes(means, sound), quaternions, scales: soundOnes(scales, sound) };
}

/**
 * Mean as three float32 and opacity as a half; colors and natural logarithms of the scales as halves; the rotation as
 * axis and angle. Colors and opacities are 1: those of the camera lie above them.
 */
function packForSpark(geometry: Geometry): Layouts["spark"] {
  const { means, scales, sound } = geometry;
  const count = sound.length;
  const [first, second] = [new Uint32Array(4 * count), new Uint32Array(4 * count)];
  const floats = new Float32Array(first.buffer);
  const one = toHalf(1);
  for (let p = 0; p < count; p++) {
    const logScale = (axis: number): number => toHalf(sound[p] ? Math.log(scales[3 * p + axis]!) : -Infinity);
    for (let axis = 0; axis < 3; axis++) floats[4 * p + axis] = sound[p] ? means[3 * p + axis]! : 0;
    first[4 * p + 3] = one;
    second[4 * p] = one | (one << 16);
    second[4 * p + 1] = one | (logScale(0) << 16);
    second[4 * p + 2] = logScale(1) | (logScale(2) << 16);
  }
  unitQuaternions(geometry, (p, q) => (second[4 * p + 3] = axisAndAngle(q)));
  return { words: [first, second] };
}

/** A rotation in 32 bits: its axis folded onto a square, 10 bits a side, and its angle of 0 to pi in 12 bits. */
function axisAndAngle([w, x, y, z]: [number, number, number, number]): number {
  const sign = w < 0 ? -1 : 1;
  const sine = Math.hypot(x, y, z);
  const angle = 2 * Math.atan2(sine, sign * w);
  const sum = sign * (Math.abs(x) + Math.abs(y) + Math.abs(z));
  // Without a rotation any axis will do.
  let [u, v] = sine > 1e-9 ? [x / sum, y / sum] : [1, 0];
  if (sign * z < 0) {
    [u, v] = [(1 - Math.abs(v)) * (u < 0 ? -1 : 1), (1 - Math.abs(u)) * (v < 0 ? -1 : 1)];
  }
  const side = (position: number): number => Math.round((0.5 * position + 0.5) * 1023);
  return (Math.round((angle * 4095) / Math.PI) << 20) | (side(v) << 10) | side(u);
}

function packForPlayCanvas(geometry: Geometry): Layouts["playcanvas"] {
  const { scales, sound } = geometry;
  const count = sound.length;
  const centers = soundOnes(geometry.means, sound);
  const means = new Float32Array(4 * count);
  const logScales = new Uint16Array(4 * count);
  const quaternions = new Uint16Array(4 * count);
  const [least, most] = [new Array<number>(3).fill(Infinity), new Array<number>(3).fill(-Infinity)];
  for (let p = 0; p < count; p++) {
    const reach = 3 * Math.max(scales[3 * p]!, scales[3 * p + 1]!, scales[3 * p + 2]!);
    for (let axis = 0; axis < 3; axis++) {
      const mean = centers[3 * p + axis]!;
      means[4 * p + axis] = mean;
      logScales[4 * p + axis] = toHalf(sound[p] ? Math.log(scales[3 * p + axis]!) : -Infinity);
      if (!sound[p]) continue;
      least[axis] = Math.min(least[axis]!, mean - reach);
      most[axis] = Math.max(most[axis]!, mean + reach);
    }
  }
  unitQuaternions(geometry, (p, q) => {
    for (let i = 0; i < 4; i++) quaternions[4 * p + i] = toHalf(q[i]!);
  });
  const corner = (values: number[]): [number, number, number] =>
    Number.isFinite(values[0]!) ? (values as [number, number, number]) : [0, 0, 0];
  return { means, centers, logScales, quaternions, least: corner(least), most: corner(most) };
}
