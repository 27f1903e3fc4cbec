/** How far away what one sees along a ray is: where half of the light has met something. */

import type { Vector } from "./pose.ts";

export interface Splats {
  /** Of each splat 3 numbers, 4 (w, x, y, z), 3. */
  means: ArrayLike<number>;
  quaternions: ArrayLike<number>;
  scales: ArrayLike<number>;
  sound: ArrayLike<number>;
}

/** Standard deviations, beyond which a splat is not met. */
const REACH = 3;
const HALF = 0.5;
/** Share of the light that must have met something for there to be anything at all. */
const LEAST = 0.2;

/**
 * World units along the ray, null where there is nothing.
 *
 * `direction` has length one; `pixel`: angle of a pixel, radians, by which splats are wider than they are.
 */
export function distanceAlong(
  origin: Vector,
  direction: Vector,
  pixel: number,
  { means, quaternions, scales, sound }: Splats,
  opacities: ArrayLike<number>,
  near: number,
): number | null {
  return halfOf(meetings(origin, direction, pixel, { means, quaternions, scales, sound }, opacities, near));
}

/** Distance and alpha of each splat that the ray meets, in no order. */
export function meetings(
  origin: Vector,
  direction: Vector,
  pixel: number,
  { means, quaternions, scales, sound }: Splats,
  opacities: ArrayLike<number>,
  near: number,
): Array<[number, number]> {
  const met: Array<[number, number]> = [];
  for (let p = 0; p < opacities.length; p++) {
    if (!sound[p] || !(opacities[p]! > 1 / 255)) continue;
    const v = [0, 1, 2].map((axis) => means[3 * p + axis]! - origin[axis]!) as Vector;
    const along = v[0] * direction[0] + v[1] * direction[1] + v[2] * direction[2];
    if (along < near) continue;
    const wider = pixel * along;
    const largest = Math.max(scales[3 * p]!, scales[3 * p + 1]!, scales[3 * p + 2]!) + wider;
    const beside = v[0] ** 2 + v[1] ** 2 + v[2] ** 2 - along ** 2;
    if (beside > (REACH * largest) ** 2) continue;
    const q = [0, 1, 2, 3].map((i) => quaternions[4 * p + i]!);
    // Middle and ray in the splat's axes, in standard deviations.
    const [a, b] = [inverselyTurned(q, v), inverselyTurned(q, direction)];
    let [aa, ab, bb] = [0, 0, 0];
    for (let axis = 0; axis < 3; axis++) {
      const deviation = Math.hypot(scales[3 * p + axis]!, wider);
      const [x, y] = [a[axis]! / deviation, b[axis]! / deviation];
      [aa, ab, bb] = [aa + x * x, ab + x * y, bb + y * y];
    }
    const alpha = Math.min(0.999, opacities[p]! * Math.exp(-0.5 * Math.max(0, aa - (ab * ab) / bb)));
    if (alpha > 1 / 255) met.push([along, alpha]);
  }
  return met;
}

/** Where half of the light has met something; null where too little of it has. */
export function halfOf(met: Array<[number, number]>): number | null {
  met.sort((one, other) => one[0] - other[0]);
  let left = 1;
  for (const [distance, alpha] of met) {
    left *= 1 - alpha;
    if (left < HALF) return distance;
  }
  return left < 1 - LEAST ? met[met.length >> 1]![0] : null;
}

/** `v` turned back by a quaternion w, x, y, z of any length. */
function inverselyTurned(q: number[], v: Vector): Vector {
  const length = Math.hypot(...q);
  const [w, x, y, z] = [q[0]! / length, -q[1]! / length, -q[2]! / length, -q[3]! / length];
  const [tx, ty, tz] = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
  return [
    v[0] + w * tx + (y * tz - z * ty),
    v[1] + w * ty + (z * tx - x * tz),
    v[2] + w * tz + (x * ty - y * tx),
  ];
}
