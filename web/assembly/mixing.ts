/** The binary arithmetic code, adaptive states and mixed decisions (docs/bitstream.md, "Arithmetic code"). */

import { alloc } from "./memory";

/** Tables of 16-bit and 32-bit numbers, put there by `setTables`. */
let SQUASH: usize = 0;
let STRETCH: usize = 0;
let RATE: usize = 0;
let CONFIDENCE: usize = 0;

/** Addresses of four tables of i32, of 4096, 4096, 1024 and 1024 entries. */
export function setTables(squash: usize, stretch: usize, rate: usize, confidence: usize): void {
  SQUASH = squash;
  STRETCH = stretch;
  RATE = rate;
  CONFIDENCE = confidence;
}

@inline
function at32(table: usize, index: i32): i32 {
  return load<i32>(table + (<usize>index << 2));
}

let low: u64 = 0;
let high: u64 = 0;
let code: u64 = 0;
let next: usize = 0;
let end: usize = 0;
let begin: usize = 0;

/** Bytes behind the end count as 0. */
@inline
function nextByte(): u64 {
  const value: u64 = next < end ? load<u8>(next) : 0;
  next++;
  return value;
}

export function startDecoder(payload: usize, start: usize, length: usize): void {
  begin = payload;
  next = payload + start;
  end = payload + length;
  low = 0;
  high = (1 << 48) - 1;
  code = 0;
  for (let i = 0; i < 6; i++) code = (code << 8) | nextByte();
}

/** Place behind the code's last byte, or -1 if the code does not end as an encoder ends it. */
export function endDecoder(): i32 {
  if (code !== ((low >> 40) + 1) << 40) return -1;
  return <i32>(next - 5 - begin);
}

@inline
export function decide(p1: i32): i32 {
  const split = low + ((high - low) >> 16) * <u64>p1;
  let bit = 0;
  if (code <= split) {
    bit = 1;
    high = split;
  } else low = split + 1;
  while (low >> 40 === high >> 40) {
    low = (low << 8) & 0xffffffffffff;
    high = ((high << 8) & 0xffffffffffff) | 255;
    code = ((code << 8) & 0xffffffffffff) | nextByte();
  }
  return bit;
}

@inline
function clamp(x: i32, least: i32, most: i32): i32 {
  return min(max(x, least), most);
}

/** A state is its probability of 22 bits, above its count of 10. */
export const FIRST_STATE: u32 = (1 << 21) << 10;

@inline
function learn(state: usize, bit: i32, limit: i32): void {
  const packed = load<u32>(state);
  let p = <i32>(packed >> 10);
  let n = <i32>(packed & 1023);
  p += <i32>((<i64>((bit << 22) - p) * <i64>at32(RATE, n)) >> 16);
  if (n < limit) n++;
  store<u32>(state, (<u32>p << 10) | <u32>n);
}

@inline
export function decideByState(state: usize, limit: i32): i32 {
  const bit = decide(clamp(<i32>(load<u32>(state) >> 16), 20, 65516));
  learn(state, bit, limit);
  return bit;
}

export function newStates(count: i32): usize {
  const states = alloc(<usize>count << 2);
  for (let i = 0; i < count; i++) store<u32>(states + (<usize>i << 2), FIRST_STATE);
  return states;
}

@unmanaged
export class Mixer {
  inputs: i32 = 0;
  limit: i32 = 0;
  rate: i32 = 0;
  /** [inputs] address of the chosen state of each input */
  at: usize = 0;
  states: usize = 0;
  /** [sets, inputs + 1] i64 */
  weights: usize = 0;
  refinements: usize = 0;
  /** [inputs + 1] i64 */
  logits: usize = 0;
}

export function newMixer(
  inputs: i32,
  contexts: i32,
  sets: i32,
  refinements: i32,
  weight: i64,
  limit: i32,
  rate: i32,
): Mixer {
  const mixer = changetype<Mixer>(alloc(offsetof<Mixer>()));
  mixer.inputs = inputs;
  mixer.limit = limit;
  mixer.rate = rate;
  mixer.at = alloc(<usize>inputs << 2);
  mixer.states = newStates(contexts);
  mixer.weights = alloc((<usize>sets * (inputs + 1)) << 3);
  for (let i = 0; i < sets * (inputs + 1); i++) {
    store<i64>(mixer.weights + (<usize>i << 3), i % (inputs + 1) === inputs ? 0 : weight);
  }
  mixer.refinements = alloc(<usize>refinements * 33 * 4);
  for (let i = 0; i < refinements * 33; i++) {
    store<i32>(mixer.refinements + (<usize>i << 2), at32(SQUASH, min(128 * (i % 33), 4095)));
  }
  mixer.logits = alloc(<usize>(inputs + 1) << 3);
  store<i64>(mixer.logits + (<usize>inputs << 3), 256);
  return mixer;
}

/** Names the context of an input, counted over all inputs. */
@inline
export function choose(mixer: Mixer, input: i32, context: i32): void {
  store<usize>(mixer.at + (<usize>input << 2), mixer.states + (<usize>context << 2));
}

export function mix(mixer: Mixer, setA: i32, setB: i32, refinement: i32): i32 {
  const inputs = mixer.inputs;
  const logits = mixer.logits;
  const a = mixer.weights + (<usize>(setA * (inputs + 1)) << 3);
  const b = mixer.weights + (<usize>(setB * (inputs + 1)) << 3);
  let sumA: i64 = load<i64>(a + (<usize>inputs << 3)) << 8;
  let sumB: i64 = load<i64>(b + (<usize>inputs << 3)) << 8;
  for (let k = 0; k < inputs; k++) {
    const packed = load<u32>(load<usize>(mixer.at + (<usize>k << 2)));
    const logit: i64 = (at32(STRETCH, <i32>(packed >> 20)) * at32(CONFIDENCE, <i32>(packed & 1023))) >> 8;
    const place = <usize>k << 3;
    store<i64>(logits + place, logit);
    sumA += load<i64>(a + place) * logit;
    sumB += load<i64>(b + place) * logit;
  }
  const logitA = <i32>min<i64>(max<i64>(sumA >> 16, -2047), 2047);
  const logitB = <i32>min<i64>(max<i64>(sumB >> 16, -2047), 2047);
  const logit = (logitA + logitB) >> 1;
  const place = 32 * (logit + 2048);
  const r = mixer.refinements + (<usize>(refinement * 33 + (place >> 12)) << 2);
  const s = place & 4095;
  const r0 = load<i32>(r);
  const r1 = load<i32>(r, 4);
  const refined = (r0 * (4096 - s) + r1 * s) >> 12;
  const bit = decide(clamp((at32(SQUASH, logit + 2048) + refined) >> 1, 20, 65516));

  const target = bit ? 65535 : 0;
  const errorA: i64 = (target - at32(SQUASH, logitA + 2048)) * mixer.rate;
  const errorB: i64 = (target - at32(SQUASH, logitB + 2048)) * mixer.rate;
  for (let k = 0; k <= inputs; k++) {
    const at = <usize>k << 3;
    const l = load<i64>(logits + at);
    store<i64>(a + at, load<i64>(a + at) + ((l * errorA + 32768) >> 16));
    store<i64>(b + at, load<i64>(b + at) + ((l * errorB + 32768) >> 16));
    if (k < inputs) learn(load<usize>(mixer.at + (<usize>k << 2)), bit, mixer.limit);
  }
  store<i32>(r, r0 + (((target - r0) * (4096 - s)) >> 18));
  store<i32>(r, r1 + (((target - r1) * s) >> 18), 4);
  return bit;
}
