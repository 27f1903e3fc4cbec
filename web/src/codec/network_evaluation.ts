/** Evaluation of integer networks: all sums are integers below 2^53, so that doubles are exact. */

import { ACTIVATION_LIMIT, SLOPE_BITS } from "./constants.ts";
import type { IntegerLayer, IntegerNetwork } from "./networks.ts";

export const clampActivation = (x: number): number =>
  x < -ACTIVATION_LIMIT ? -ACTIVATION_LIMIT : x > ACTIVATION_LIMIT - 1 ? ACTIVATION_LIMIT - 1 : x;

/** Outputs [rows, outputs] for inputs [rows, inputs], Q12. */
export function evaluateNetwork(network: IntegerNetwork, inputs: Int32Array, rows: number): Int32Array {
  const outputs = new Int32Array(rows * network.outputs);
  const input = new Float64Array(network.inputs);
  const layers = network.layers.map((layer) => ({ layer, weight: Float64Array.from(layer.weight) }));
  for (let row = 0; row < rows; row++) {
    for (let i = 0; i < input.length; i++) input[i] = clampActivation(inputs[row * input.length + i]!);
    let taken: Float64Array = input;
    let current: Float64Array = input;
    layers.forEach(({ layer, weight }, i) => {
      const isLast = i === layers.length - 1;
      const next = apply(layer, weight, isLast && network.skip ? sideBySide(current, input) : current);
      if (layer.adds) for (let o = 0; o < next.length; o++) next[o] = clampActivation(next[o]! + taken[o]!);
      taken = current;
      current = next;
    });
    outputs.set(current, row * network.outputs);
  }
  return outputs;
}

function apply(layer: IntegerLayer, weight: Float64Array, x: Float64Array): Float64Array {
  const scale = 2 ** -layer.shift;
  const half = layer.shift > 0 ? 2 ** (layer.shift - 1) : 0;
  const result = new Float64Array(layer.outputs);
  for (let o = 0; o < layer.outputs; o++) {
    let y = 0;
    for (let i = 0; i < x.length; i++) y += weight[o * x.length + i]! * x[i]!;
    y = Math.floor((y + half) * scale) + layer.bias[o]!;
    if (layer.rectify && y < 0) y = Math.floor(y / 2 ** SLOPE_BITS);
    result[o] = clampActivation(y);
  }
  return result;
}

function sideBySide(a: Float64Array, b: Float64Array): Float64Array {
  const both = new Float64Array(a.length + b.length);
  both.set(a);
  both.set(b, a.length);
  return both;
}
