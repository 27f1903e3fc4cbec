/** The prediction heads by their layout (docs/bitstream_prediction.md, "Networks of the prediction"). */

import {
  HEAD_LAYOUTS,
  type HeadLayout,
  SHARED_RESIDUALS,
  headInputs,
  headTensors,
} from "../codec/head_tensors.ts";
import type { Tensor } from "../codec/heads.ts";
import type { Scene } from "../codec/scene_decoder.ts";
import { CorruptSection } from "../errors.ts";

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
  const values = new Map<string, Float32Array>();
  for (const { name, shape } of headTensors(scene)) {
    values.set(name, parametersOf(name, scene.tensors.get(name), shape));
  }
  const unknown = [...scene.tensors.keys()].find((name) => !values.has(name));
  if (unknown !== undefined)
    throw new CorruptSection(`prediction heads: tensor ${unknown} is not of this layout`);
  const networks: Record<string, HeadNetwork> = {};
  for (const [name, layout] of Object.entries(HEAD_LAYOUTS[scene.heads])) {
    networks[name] = networkOf(layout, scene, (tensor) => values.get(`${name}.${tensor}`)!);
  }
  return { networks, sharedResiduals: values.get(SHARED_RESIDUALS) ?? null };
}

function parametersOf(name: string, tensor: Tensor | undefined, shape: number[]): Float32Array {
  if (!tensor) throw new CorruptSection(`prediction heads: tensor ${name} is missing`);
  if (tensor.shape.length !== shape.length || tensor.shape.some((side, i) => side !== shape[i])) {
    throw new CorruptSection(`prediction heads: ${name} has shape [${tensor.shape}], expected [${shape}]`);
  }
  const unit = 2 ** -tensor.exponent;
  return Float32Array.from(tensor.values, (value) => value * unit);
}

function networkOf(layout: HeadLayout, scene: Scene, tensor: (name: string) => Float32Array): HeadNetwork {
  return {
    inputs: headInputs(layout, scene),
    width: scene.width,
    outputs: layout.outputs,
    inputWeight: tensor("input_weight"),
    inputBias: tensor("input_bias"),
    blocks: Array.from({ length: layout.blocks }, (_, b) => ({
      weight1: tensor(`blocks.${b}.weight1`),
      bias1: tensor(`blocks.${b}.bias1`),
      weight2: tensor(`blocks.${b}.weight2`),
      bias2: tensor(`blocks.${b}.bias2`),
    })),
    outputWeight: tensor("output_weight"),
    outputBias: tensor("output_bias"),
    skipWeight: tensor("skip_weight"),
  };
}
