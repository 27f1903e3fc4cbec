/** Dequantized numbers of a scene, and which coupled primitive belongs to which anchor. */

import { FRACTION_BITS } from "../codec/constants.ts";
import type { Scene } from "../codec/scene_decoder.ts";
import { Role } from "../codec/scene_section.ts";

/** With fewer than all anchors, each stands for others: it is drawn as large as all of them together. */
const COARSE_GROWTH = 1 / 3;

export interface CoupledPrimitives {
  anchors: number;
  coupled: number;
  referenceDim: number;
  residualDim: number;
  /** [N, referenceDim] */
  references: Float32Array;
  /** [P, residualDim], or null if they are shared. */
  residuals: Float32Array | null;
  /** [K, residualDim], or null if each coupled primitive has its own. */
  sharedResiduals: Float32Array | null;
  /** [N + 1] where the coupled primitives of each anchor begin, and where the last one's end. */
  firstCoupled: Int32Array;
  /** [P] */
  slots: Uint8Array;
  /** [P] */
  anchorOf: Int32Array;
}

/** Latents of all groups of a role side by side, times their steps: [rows, channels of the role]. */
export function dequantize(scene: Scene, role: number): Float32Array {
  const groups = scene.groups.filter((group) => group.role === role);
  const columns = groups.reduce((sum, group) => sum + group.channels, 0);
  const rows = role === Role.residual ? scene.coupled : scene.anchors;
  const values = new Float32Array(rows * columns);
  let column = 0;
  for (const { channels, steps, latents } of groups) {
    for (let c = 0; c < channels; c++) {
      const unit = (steps.length === 1 ? steps[0]! : steps[c]!) * 2 ** -FRACTION_BITS;
      for (let row = 0; row < rows; row++)
        values[row * columns + column + c] = latents[row * channels + c]! * unit;
    }
    column += channels;
  }
  return values;
}

/** [N, 6]: exp of the log scales, times the voxel size: `reach` and `size` of an anchor, world units. */
export function anchorLengths(scene: Scene): Float32Array {
  const lengths = dequantize(scene, Role.logScales).map((log) => Math.exp(log) * scene.voxelSize);
  if (!scene.standsFor) return lengths;
  for (let n = 0; n < scene.anchors; n++) {
    const growth = scene.standsFor[n]! ** COARSE_GROWTH;
    for (let axis = 3; axis < 6; axis++) lengths[6 * n + axis]! *= growth;
  }
  return lengths;
}

export function coupledPrimitives(scene: Scene, sharedResiduals: Float32Array | null): CoupledPrimitives {
  const { anchors, coupled, coupledPrimitives: K, mask } = scene;
  const firstCoupled = new Int32Array(anchors + 1);
  const slots = new Uint8Array(coupled);
  const anchorOf = new Int32Array(coupled);
  let p = 0;
  for (let n = 0; n < anchors; n++) {
    for (let k = 0; k < K; k++) {
      if (!mask[n * K + k]) continue;
      slots[p] = k;
      anchorOf[p++] = n;
    }
    firstCoupled[n + 1] = p;
  }
  return {
    anchors,
    coupled,
    referenceDim: scene.referenceDim,
    residualDim: scene.residualDim,
    references: dequantize(scene, Role.reference),
    residuals: sharedResiduals ? null : dequantize(scene, Role.residual),
    sharedResiduals,
    firstCoupled,
    slots,
    anchorOf,
  };
}
