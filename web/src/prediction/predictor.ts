/** From a scene to the Gaussians that a camera sees (docs/bitstream_prediction.md). */

import type { Scene } from "../codec/scene_decoder.ts";
import { wasmKernels } from "../wasm_kernels.ts";
import { CoupledMLP } from "./coupled_mlp.ts";
import { readHeadNetworks } from "./head_networks.ts";
import { type CoupledPrimitives, anchorLengths, coupledPrimitives } from "./scene_values.ts";

/** Opacities at or below it touch no pixel. */
export const OPACITY_CUTOFF = 1 / 255;
/** Where float32 ends, for every number of a Gaussian. */
const LARGEST = 2 ** 127;
const SMALLEST_NORM = 2 ** -60;

/** Of all coupled primitives, in the local frame; they do not depend on the camera. */
export interface Geometry {
  /** [P, 3] world units from `worldOffset` */
  means: Float32Array;
  /** [P, 4] w, x, y, z; not normalized */
  quaternions: Float32Array;
  /** [P, 3] standard deviations, world units */
  scales: Float32Array;
  /** [P] 0 where a number is beyond float32 or a quaternion is zero: never drawn */
  sound: Uint8Array;
}

/** Of all coupled primitives, for one camera. */
export interface Appearance {
  /** [P] -1 to 1; above OPACITY_CUTOFF what is drawn */
  opacities: Float32Array;
  /** [P, 3] red, green, blue; display values 0 to 1 */
  colors: Float32Array;
}

/** Geometry once, then opacity and color for any camera and any share of the anchors. */
export class Predictor {
  readonly primitives: CoupledPrimitives;
  readonly geometry: Geometry;
  /** [N, 3] positions of the anchors, local frame */
  readonly positions: Float32Array;
  private readonly appearanceParts: CoupledMLP[];
  private readonly views: Float32Array;
  private readonly raw: Float32Array[];

  constructor(private readonly scene: Scene) {
    const kernels = wasmKernels();
    const { networks, sharedResiduals } = readHeadNetworks(scene);
    this.primitives = coupledPrimitives(scene, sharedResiduals);
    this.positions = Float32Array.from(scene.coordinates, (c) => c * scene.voxelSize);
    const names = scene.heads === "separate" ? ["translation", "covariance"] : ["geometry"];
    const geometryParts = names.map((name) => new CoupledMLP(networks[name]!, this.primitives, kernels));
    this.geometry = predictGeometry(scene, this.primitives, this.positions, geometryParts);
    const seen = scene.heads === "separate" ? ["opacity", "color"] : ["appearance"];
    this.appearanceParts = seen.map((name) => new CoupledMLP(networks[name]!, this.primitives, kernels));
    this.views = new Float32Array(4 * scene.anchors);
    this.raw = this.appearanceParts.map((part) => new Float32Array(scene.coupled * part.network.outputs));
  }

  newAppearance(): Appearance {
    const { coupled } = this.primitives;
    return { opacities: new Float32Array(coupled), colors: new Float32Array(3 * coupled) };
  }

  /**
   * Opacity and color of the coupled primitives of anchors first ... end - 1, for a camera at `centre` (local frame,
   * world units), into `appearance`.
   */
  predictAppearance(
    centre: ArrayLike<number>,
    appearance: Appearance,
    first = 0,
    end = this.primitives.anchors,
  ): void {
    this.embedViews(centre, first, end);
    this.appearanceParts.forEach((part, i) => part.run(first, end, this.views, this.raw[i]!));
    const { firstCoupled } = this.primitives;
    const paired = this.raw.length === 1;
    const [opacity, color] = paired ? [this.raw[0]!, this.raw[0]!] : [this.raw[0]!, this.raw[1]!];
    for (let p = firstCoupled[first]!; p < firstCoupled[end]!; p++) {
      appearance.opacities[p] = Math.tanh(opacity[paired ? 4 * p : p]!);
      const at = paired ? 4 * p + 1 : 3 * p;
      for (let c = 0; c < 3; c++) appearance.colors[3 * p + c] = sigmoid(color[at + c]!);
    }
  }

  /** View embeddings of anchors: unit direction from the camera, distance. */
  private embedViews(centre: ArrayLike<number>, first: number, end: number): void {
    const { positions, views } = this;
    for (let n = first; n < end; n++) {
      const x = positions[3 * n]! - centre[0]!;
      const y = positions[3 * n + 1]! - centre[1]!;
      const z = positions[3 * n + 2]! - centre[2]!;
      const distance = Math.sqrt(x * x + y * y + z * z);
      const unit = 1 / Math.max(distance, 1e-12);
      views[4 * n] = x * unit;
      views[4 * n + 1] = y * unit;
      views[4 * n + 2] = z * unit;
      views[4 * n + 3] = distance / this.scene.viewDistanceScale;
    }
  }
}

function predictGeometry(
  scene: Scene,
  primitives: CoupledPrimitives,
  positions: Float32Array,
  parts: CoupledMLP[],
): Geometry {
  const { coupled, anchors, anchorOf } = primitives;
  const lengths = anchorLengths(scene);
  const raw = parts.map((part) => new Float32Array(coupled * part.network.outputs));
  parts.forEach((part, i) => part.run(0, anchors, null, raw[i]!));
  const paired = parts.length === 1;
  const [move, shape] = paired ? [raw[0]!, raw[0]!] : [raw[0]!, raw[1]!];
  const means = new Float32Array(3 * coupled);
  const scales = new Float32Array(3 * coupled);
  const quaternions = new Float32Array(4 * coupled);
  const sound = new Uint8Array(coupled);
  for (let p = 0; p < coupled; p++) {
    const n = anchorOf[p]!;
    const moveAt = paired ? 10 * p : 3 * p;
    const shapeAt = paired ? 10 * p + 3 : 7 * p;
    for (let axis = 0; axis < 3; axis++) {
      means[3 * p + axis] = positions[3 * n + axis]! + move[moveAt + axis]! * lengths[6 * n + axis]!;
      scales[3 * p + axis] = sigmoid(shape[shapeAt + axis]!) * lengths[6 * n + 3 + axis]!;
    }
    for (let i = 0; i < 4; i++) quaternions[4 * p + i] = shape[shapeAt + 3 + i]! + (i === 0 ? 1 : 0);
    sound[p] = isSound(means, scales, quaternions, p) ? 1 : 0;
  }
  return { means, quaternions, scales, sound };
}

function isSound(means: Float32Array, scales: Float32Array, quaternions: Float32Array, p: number): boolean {
  for (let i = 0; i < 3; i++) {
    // False for numbers that are not a number, too.
    if (!(Math.abs(means[3 * p + i]!) < LARGEST && Math.abs(scales[3 * p + i]!) < LARGEST)) return false;
  }
  let norm = 0;
  for (let i = 0; i < 4; i++) {
    const component = Math.abs(quaternions[4 * p + i]!);
    if (!(component < LARGEST)) return false;
    norm = Math.hypot(norm, component);
  }
  return norm >= SMALLEST_NORM;
}

function sigmoid(x: number): number {
  return 1 / (1 + Math.exp(-x));
}
