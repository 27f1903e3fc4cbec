/** Adaptive states and mixed decisions (docs/bitstream.md, "Arithmetic code"). */

import type { ArithmeticDecoder } from "./arithmetic_decoder.ts";
import { CONFIDENCE, RATE, SQUASH, STRETCH } from "./arithmetic_tables.ts";

const clampLogit = (x: number): number => (x < -2047 ? -2047 : x > 2047 ? 2047 : x);
const clampP1 = (p: number): number => (p < 20 ? 20 : p > 65516 ? 65516 : p);

/** Probabilities of 22 bits with counts, one pair for each context. */
export class AdaptiveStates {
  readonly p: Int32Array;
  readonly n: Int32Array;

  constructor(
    size: number,
    private readonly limit: number,
  ) {
    this.p = new Int32Array(size).fill(2 ** 21);
    this.n = new Int32Array(size);
  }

  decide(decoder: ArithmeticDecoder, state: number): number {
    const bit = decoder.decide(clampP1(this.p[state]! >> 6));
    this.learn(state, bit);
    return bit;
  }

  learn(state: number, bit: number): void {
    const p = this.p[state]!;
    const n = this.n[state]!;
    this.p[state] = p + Math.floor(((bit ? 4194304 - p : -p) * RATE[n]!) / 65536);
    if (n < this.limit) this.n[state] = n + 1;
  }
}

export interface MixerShape {
  /** Contexts of each input. */
  contexts: number[];
  weightSets: number;
  refinements: number;
  initialWeight: number;
  limit: number;
  rate: number;
}

/** One decision from several contexts. Name the contexts in `at` first, counted within their input. */
export class Mixer {
  /** Context of each input for the next decision. */
  readonly at: Int32Array;
  private readonly states: AdaptiveStates;
  private readonly bases: number[] = [];
  private readonly inputs: number;
  private readonly weights: Float64Array;
  private readonly refinements: Int32Array;
  private readonly logits: Int32Array;
  private readonly rate: number;

  constructor(shape: MixerShape) {
    this.inputs = shape.contexts.length;
    this.at = new Int32Array(this.inputs);
    let size = 0;
    for (const contexts of shape.contexts) {
      this.bases.push(size);
      size += contexts;
    }
    this.states = new AdaptiveStates(size, shape.limit);
    this.rate = shape.rate;
    const row = this.inputs + 1;
    this.weights = new Float64Array(shape.weightSets * row).fill(shape.initialWeight);
    for (let set = 0; set < shape.weightSets; set++) this.weights[set * row + this.inputs] = 0;
    this.refinements = new Int32Array(shape.refinements * 33);
    for (let i = 0; i < this.refinements.length; i++) {
      this.refinements[i] = SQUASH[Math.min(128 * (i % 33), 4095)]!;
    }
    this.logits = new Int32Array(row);
    this.logits[this.inputs] = 256;
  }

  decide(decoder: ArithmeticDecoder, setA: number, setB: number, refinement: number): number {
    const { inputs, weights, logits, states, at, bases, refinements } = this;
    const a = setA * (inputs + 1);
    const b = setB * (inputs + 1);
    let sumA = weights[a + inputs]! * 256;
    let sumB = weights[b + inputs]! * 256;
    for (let k = 0; k < inputs; k++) {
      const state = bases[k]! + at[k]!;
      const logit = (STRETCH[states.p[state]! >> 10]! * CONFIDENCE[states.n[state]!]!) >> 8;
      logits[k] = logit;
      sumA += weights[a + k]! * logit;
      sumB += weights[b + k]! * logit;
    }
    const logitA = clampLogit(Math.floor(sumA / 65536));
    const logitB = clampLogit(Math.floor(sumB / 65536));
    const logit = (logitA + logitB) >> 1;
    const place = 32 * (logit + 2048);
    const r = refinement * 33 + (place >> 12);
    const s = place & 4095;
    // Below 2^16 2^12: no more than 28 bits.
    const refined = (refinements[r]! * (4096 - s) + refinements[r + 1]! * s) >> 12;
    const bit = decoder.decide(clampP1((SQUASH[logit + 2048]! + refined) >> 1));

    const target = bit ? 65535 : 0;
    const errorA = (target - SQUASH[logitA + 2048]!) * this.rate;
    const errorB = (target - SQUASH[logitB + 2048]!) * this.rate;
    for (let k = 0; k <= inputs; k++) {
      weights[a + k] = weights[a + k]! + ((logits[k]! * errorA + 32768) >> 16);
      weights[b + k] = weights[b + k]! + ((logits[k]! * errorB + 32768) >> 16);
      if (k < inputs) states.learn(bases[k]! + at[k]!, bit);
    }
    refinements[r] = refinements[r]! + (((target - refinements[r]!) * (4096 - s)) >> 18);
    refinements[r + 1] = refinements[r + 1]! + (((target - refinements[r + 1]!) * s) >> 18);
    return bit;
  }
}
