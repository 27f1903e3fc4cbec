/** The entropy networks section: integer networks that predict means and scales (docs/bitstream.md, "Networks"). */

import {
  ACCUMULATOR_LIMIT,
  ACTIVATION_LIMIT,
  BIAS_LIMIT,
  CHAIN_LIMIT,
  FIRST_WITH_ROWS,
  FOLLOW_LIMIT,
  MAX_INERTIA,
  MAX_LAYERS,
  MAX_LAYER_WIDTH,
  MAX_SHIFT,
  MAX_WEIGHTS,
} from "./constants.ts";
import { FieldReader } from "./fields.ts";
import { readArrays } from "./integer_arrays.ts";
import type { Kernels } from "./kernels.ts";
import type { GroupShape } from "./scene_section.ts";

/** Flags of a network. */
const SKIP = 1;
const CHAIN = 2;
/** Flags of a layer. */
const RESERVED_BIT = 0x20;
const ADDS = 0x40;
const RECTIFY = 0x80;

export interface IntegerLayer {
  inputs: number;
  outputs: number;
  /** [outputs, inputs] */
  weight: Int32Array;
  /** [outputs], Q12 */
  bias: Int32Array;
  shift: number;
  rectify: boolean;
  adds: boolean;
}

/** How the means that a network gives follow what neighbours have. */
export interface Follow {
  /** [channels] */
  weight: Int32Array;
  shift: number;
}

export interface IntegerNetwork {
  inputs: number;
  outputs: number;
  layers: IntegerLayer[];
  /** Whether the last layer takes the network's inputs, too. */
  skip: boolean;
  /** Null but for a group that sees neighbours. */
  follow: Follow | null;
  /** For how many symbols of a row what the network expects of their size counts; 0: tables never shift. */
  inertia: number;
  /** [channels (channels - 1) / 2] How steps follow those before in their row, in units of 2^-6; or null. */
  chain: Int32Array | null;
}

type LayerHead = Omit<IntegerLayer, "weight" | "bias">;
interface NetworkHead extends Omit<IntegerNetwork, "layers" | "follow" | "chain"> {
  layers: LayerHead[];
  followShift: number | null;
  hasChain: boolean;
  /** Of the network's group. */
  channels: number;
}

/** An activation within its limits: all sums of them are integers that doubles hold. */
export function clampActivation(x: number): number {
  return Math.max(-ACTIVATION_LIMIT, Math.min(ACTIVATION_LIMIT - 1, x));
}

/** For each group its network, or null; and the number of all elements of their weights. */
export function readNetworks(
  payload: Uint8Array,
  groups: GroupShape[],
  name: string,
  version: number,
  kernels: Kernels,
): { networks: Array<IntegerNetwork | null>; weights: number } {
  const reader = new FieldReader(payload, name);
  const heads = groups.map((group) => (group.hasNetwork ? readHead(reader, group, version) : null));
  const layers = heads.flatMap((head) => head?.layers ?? []);
  const sizes = heads.flatMap((head) => (head ? arraySizes(head) : []));
  const elements = sizes.reduce((a, b) => a + b, 0);
  if (elements > MAX_WEIGHTS)
    reader.refuse(
      `${elements} weights, biases and elements of follow and chain, at most ${MAX_WEIGHTS} are allowed`,
    );
  const arrays = layers.length ? readArrays(reader, sizes, kernels) : [];
  reader.end();
  let next = 0;
  const networks = heads.map((head) => {
    if (!head) return null;
    const whole = head.layers.map((layer) => {
      const weight = joined(arrays[next]!, arrays[next + 1]!);
      const bias = joined(arrays[next + 2]!, arrays[next + 3]!);
      next += 4;
      return checked({ ...layer, weight, bias }, reader);
    });
    const { inputs, outputs, skip, inertia, followShift: shift } = head;
    const follow = shift === null ? null : checkedFollow({ weight: arrays[next++]!, shift }, reader);
    const chain = head.hasChain ? checkedChain(arrays[next++]!, reader) : null;
    return { inputs, outputs, layers: whole, skip, follow, inertia, chain };
  });
  return { networks, weights: layers.reduce((sum, layer) => sum + layer.inputs * layer.outputs, 0) };
}

function readHead(reader: FieldReader, group: GroupShape, version: number): NetworkHead {
  const count = reader.varint("layers", 1, MAX_LAYERS);
  const flags = reader.u8("flags of a network");
  const hasRows = version >= FIRST_WITH_ROWS;
  const legal = (count > 1 ? SKIP : 0) | (hasRows && group.channels > 1 ? CHAIN : 0);
  if (flags & ~legal) {
    reader.refuse(`flags of a network of ${count} layers for ${group.channels} channels are ${flags}`);
  }
  const skip = (flags & SKIP) !== 0;
  const outputs = 2 * group.width;
  const layers: LayerHead[] = [];
  for (let i = 0; i < count; i++) {
    const isLast = i === count - 1;
    const width = reader.varint("width of a layer", 1, MAX_LAYER_WIDTH);
    if (isLast && width !== outputs) reader.refuse(`a network has ${width} outputs, expected ${outputs}`);
    const bits = reader.u8("flags of a layer");
    const shift = bits & 0x1f;
    const adds = (bits & ADDS) !== 0;
    if (bits & RESERVED_BIT || shift > MAX_SHIFT) reader.refuse(`flags of a layer are ${bits}`);
    const before = layers[i - 1];
    const inputs = (before ? before.outputs : group.inputs) + (isLast && skip ? group.inputs : 0);
    if (adds && (!before || isLast || width !== before.inputs)) {
      reader.refuse("a layer adds what it cannot: it is the first or the last, or of another width");
    }
    layers.push({ inputs, outputs: width, shift, rectify: (bits & RECTIFY) !== 0, adds });
  }
  const followShift = group.seesNeighbours ? reader.u8("follow_shift") : null;
  if (followShift !== null && followShift > MAX_SHIFT)
    reader.refuse(`follow_shift is ${followShift}, expected 0 to ${MAX_SHIFT}`);
  const inertia = hasRows ? reader.u8("inertia") : 0;
  if (inertia > MAX_INERTIA) reader.refuse(`inertia is ${inertia}, expected 0 to ${MAX_INERTIA}`);
  const { inputs, channels } = group;
  return { inputs, outputs, layers, skip, followShift, inertia, hasChain: (flags & CHAIN) !== 0, channels };
}

/** Of a network's arrays, in the order of the file. */
function arraySizes({ layers, followShift, hasChain, channels }: NetworkHead): number[] {
  const sizes = layers.flatMap((layer) => {
    const half = Math.ceil(layer.outputs / 2);
    const rest = layer.outputs - half;
    return [half * layer.inputs, rest * layer.inputs, half, rest];
  });
  if (followShift !== null) sizes.push(channels);
  if (hasChain) sizes.push((channels * (channels - 1)) / 2);
  return sizes;
}

function joined(a: Int32Array, b: Int32Array): Int32Array {
  const all = new Int32Array(a.length + b.length);
  all.set(a);
  all.set(b, a.length);
  return all;
}

/** The bounds within which every sum is exact in 64-bit floats. */
function checked(layer: IntegerLayer, reader: FieldReader): IntegerLayer {
  let largest = 0;
  for (const weight of layer.weight) largest = Math.max(largest, Math.abs(weight));
  if (layer.inputs * largest * ACTIVATION_LIMIT >= ACCUMULATOR_LIMIT) {
    reader.refuse(
      `a layer of ${layer.inputs} inputs has a weight of ${largest}: its sums could leave 52 bits`,
    );
  }
  for (const bias of layer.bias) if (Math.abs(bias) >= BIAS_LIMIT) reader.refuse(`a bias is ${bias}`);
  return layer;
}

/** The bound within which its products are exact, too. */
function checkedFollow(follow: Follow, reader: FieldReader): Follow {
  for (const weight of follow.weight) {
    if (Math.abs(weight) >= FOLLOW_LIMIT) reader.refuse(`an element of follow is ${weight}`);
  }
  return follow;
}

/** The bound within which the sums of a row are exact. */
function checkedChain(chain: Int32Array, reader: FieldReader): Int32Array {
  for (const element of chain) {
    if (Math.abs(element) >= CHAIN_LIMIT) reader.refuse(`an element of chain is ${element}`);
  }
  return chain;
}
