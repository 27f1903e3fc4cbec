/** The prediction heads by their layout (docs/bitstream_prediction.md, "Networks of the prediction"). */

import type { Scene } from "../codec/scene_decoder.ts";
import { Role, channelsOf } from "../codec/scene_section.ts";
import { CorruptSection } from "../errors.ts";

/** Numbers of the view embedding: a direction and a distance. */
export const VIEW = 4;
export const SHARED_RESIDUALS = "residuals";

interface Layout {
  seesView: boolean;
  outputs: number;
  blocks: number;
}

const LAYOUTS: Record<Scene["heads"], Record<string, Layout>> = {
  separate: {
    translation: { seesView: false, outputs: 3, blocks: 1 },
    covariance: { seesView: false, outputs: 7, blocks: 1 },
    opacity: { seesView: true, outputs: 1, blocks: 1 },
    color: { seesView: true, outputs: 3, blocks: 2 },
  },
  paired: {
    geometry: { seesView: false, outputs: 10, blocks: 1 },
    appearance: { seesView: true, outputs: 4, blocks: 1 },
  },
};

export interface Block {
  weight1: Float32Array;
  bias1: Float32Array;
  weight2: Float32Array;
  bias2: Float32Array;
}

/** A residual MLP. Weights are [inputs, outputs], row by row. */
export interface HeadNetwork {
  inputs: number;
  width: number;
  outputs: number;
  inputWeight: Float32Array;
  inputBias: Float32Array;
  blocks: Block[];
  outputWeight: Float32Array;
  outputBias: Float32Array;
  skipWeight: Float32Array;
}

export interface Heads {
  /** By name: translation, covariance, opacity, color; or geometry, appearance. */
  networks: Record<string, HeadNetwork>;
  /** [K, residualDim] if all anchors share their residual embeddings. */
  sharedResiduals: Float32Array | null;
}

/** Throws CorruptSection if a tensor is missing, has another shape, or is none of the layout's. */
export function readHeadNetworks(scene: Scene): Heads {
  const taken = new Set<string>();
  const tensor = (name: string, shape: number[]): Float32Array => {
    const found = scene.tensors.get(name);
    if (!found) throw new CorruptSection(`prediction heads: tensor ${name} is missing`);
    if (found.shape.length !== shape.length || found.shape.some((side, i) => side !== shape[i])) {
      throw new CorruptSection(`prediction heads: ${name} has shape [${found.shape}], expected [${shape}]`);
    }
    taken.add(name);
    const unit = 2 ** -found.exponent;
    return Float32Array.from(found.values, (value) => value * unit);
  };
  const networks: Record<string, HeadNetwork> = {};
  for (const [name, layout] of Object.entries(LAYOUTS[scene.heads])) {
    networks[name] = readNetwork(name, layout, scene, tensor);
  }
  const isShared = channelsOf(scene.groups, Role.residual) === 0;
  const shape = [scene.coupledPrimitives, scene.residualDim];
  const sharedResiduals = isShared ? tensor(SHARED_RESIDUALS, shape) : null;
  const unknown = [...scene.tensors.keys()].find((name) => !taken.has(name));
  if (unknown !== undefined)
    throw new CorruptSection(`prediction heads: tensor ${unknown} is not of this layout`);
  return { networks, sharedResiduals };
}

function readNetwork(
  name: string,
  { seesView, outputs, blocks }: Layout,
  scene: Scene,
  tensor: (name: string, shape: number[]) => Float32Array,
): HeadNetwork {
  const { width } = scene;
  const inputs = scene.referenceDim + (seesView ? VIEW : 0) + scene.residualDim;
  return {
    inputs,
    width,
    outputs,
    inputWeight: tensor(`${name}.input_weight`, [inputs, width]),
    inputBias: tensor(`${name}.input_bias`, [width]),
    blocks: Array.from({ length: blocks }, (_, b) => ({
      weight1: tensor(`${name}.blocks.${b}.weight1`, [width, width]),
      bias1: tensor(`${name}.blocks.${b}.bias1`, [width]),
      weight2: tensor(`${name}.blocks.${b}.weight2`, [width, width]),
      bias2: tensor(`${name}.blocks.${b}.bias2`, [width]),
    })),
    outputWeight: tensor(`${name}.output_weight`, [width, outputs]),
    outputBias: tensor(`${name}.output_bias`, [outputs]),
    skipWeight: tensor(`${name}.skip_weight`, [inputs, outputs]),
  };
}
