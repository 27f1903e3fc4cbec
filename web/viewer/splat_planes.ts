/** Numbers of the splats as the renderers hold them. */

import type { Appearance, Geometry } from "../src/prediction/predictor.ts";
import { PLANES, ROW } from "./splatting.ts";

export function rowsOf(primitives: number): number {
  return Math.max(1, Math.ceil(primitives / ROW));
}

/** Three planes of 4 floats: mean, moved by `shift`; covariance xx xy xz; covariance yy yz zz. */
export function geometryPlanes(
  { means, quaternions, scales }: Geometry,
  shift: readonly [number, number, number],
): Float32Array<ArrayBuffer> {
  const count = means.length / 3;
  const plane = 4 * ROW * rowsOf(count);
  const planes = new Float32Array(PLANES * plane);
  for (let p = 0; p < count; p++) {
    const covariance = covarianceOf(quaternions, scales, p);
    for (let i = 0; i < 3; i++) {
      planes[4 * p + i] = means[3 * p + i]! + shift[i]!;
      planes[plane + 4 * p + i] = covariance[i]!;
      planes[2 * plane + 4 * p + i] = covariance[3 + i]!;
    }
  }
  return planes;
}

/** xx, xy, xz, yy, yz, zz of R(q) diag(scales)^2 R(q)^T. */
export function covarianceOf(quaternions: Float32Array, scales: Float32Array, p: number): number[] {
  const [qw, qx, qy, qz] = quaternions.subarray(4 * p, 4 * p + 4) as unknown as [
    number,
    number,
    number,
    number,
  ];
  const unit = 1 / Math.hypot(qw, qx, qy, qz);
  const [w, x, y, z] = [qw * unit, qx * unit, qy * unit, qz * unit];
  const r = [
    1 - 2 * (y * y + z * z),
    2 * (x * y - w * z),
    2 * (x * z + w * y),
    2 * (x * y + w * z),
    1 - 2 * (x * x + z * z),
    2 * (y * z - w * x),
    2 * (x * z - w * y),
    2 * (y * z + w * x),
    1 - 2 * (x * x + y * y),
  ];
  const s = [scales[3 * p]! ** 2, scales[3 * p + 1]! ** 2, scales[3 * p + 2]! ** 2];
  const entry = (i: number, j: number): number =>
    r[3 * i]! * s[0]! * r[3 * j]! +
    r[3 * i + 1]! * s[1]! * r[3 * j + 1]! +
    r[3 * i + 2]! * s[2]! * r[3 * j + 2]!;
  return [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)];
}

/** Colors and opacities of whole rows that hold primitives first ... end - 1. */
export function appearanceRows(
  appearance: Appearance,
  first: number,
  end: number,
): { values: Float32Array<ArrayBuffer>; firstRow: number; rows: number } {
  const { opacities, colors } = appearance;
  const firstRow = Math.floor(first / ROW);
  const rows = Math.max(1, Math.ceil(end / ROW) - firstRow);
  const values = new Float32Array(4 * ROW * rows);
  const start = firstRow * ROW;
  for (let p = start; p < Math.min(start + rows * ROW, opacities.length); p++) {
    const at = 4 * (p - start);
    values[at] = colors[3 * p]!;
    values[at + 1] = colors[3 * p + 1]!;
    values[at + 2] = colors[3 * p + 2]!;
    values[at + 3] = opacities[p]!;
  }
  return { values, firstRow, rows };
}
