/** Constants of docs/bitstream_prediction.md, "Rendering", for the shaders of both renderers. */

import type { FrameCamera } from "./renderer.ts";

/** Primitives in a row of what the renderers hold. */
export const ROW = 2048;
/** Float32s of a primitive: mean, upper and lower part of its covariance, each filled up to 4. */
export const PLANES = 3;
/** Least depth that is drawn, world units. */
export const NEAR = 0.01;
/** Added to the variances in the picture where the file has no angular dilation, pixels^2. */
const DILATION = 0.3;
/** The least that is added where it has one, pixels^2. */
const LEAST_DILATION = 0.02;
/** Alphas below it contribute nothing. */
export const CUTOFF = 1 / 255;
export const MOST_ALPHA = 0.999;
/** Share of the picture's sides by which directions may lie outside of it before they are clamped. */
export const MARGIN = 0.15;

/** What is added to the variances in a camera's picture, in its pixels^2. */
export function dilationOf(
  angularDilation: number | null,
  { fx, fy }: Pick<FrameCamera, "fx" | "fy">,
): number {
  return angularDilation === null ? DILATION : Math.max(LEAST_DILATION, angularDilation * fx * fy);
}
