/** Flags of the slots, each predicted from its anchor's and the anchors before (docs/bitstream.md, "Masks"). */

import type { ArithmeticDecoder } from "./arithmetic_decoder.ts";
import { MAX_COUPLED_PRIMITIVES } from "./constants.ts";
import { Mixer } from "./mixer.ts";

/** [anchors, slots] */
export function decodeMaskFlags(decoder: ArithmeticDecoder, anchors: number, slots: number): Uint8Array {
  const mixer = new Mixer({
    contexts: [4160, 16384, 16640],
    weightSets: MAX_COUPLED_PRIMITIVES + 4,
    refinements: MAX_COUPLED_PRIMITIVES,
    initialWeight: 24576,
    limit: 1000,
    rate: 2,
  });
  const mask = new Uint8Array(anchors * slots);
  let before = 0;
  for (let anchor = 0; anchor < anchors; anchor++) {
    const row = anchor * slots;
    let taken = 0;
    let recent = 0;
    for (let k = 0; k < slots; k++) {
      const one = anchor > 0 ? mask[row - slots + k]! : 0;
      const two = anchor > 1 ? mask[row - 2 * slots + k]! : 0;
      const pair = 2 * one + two;
      mixer.at[0] = 65 * k + taken;
      mixer.at[1] = 256 * k + recent;
      mixer.at[2] = (4 * k + pair) * 65 + before;
      const flag = mixer.decide(decoder, k, MAX_COUPLED_PRIMITIVES + pair, k);
      mask[row + k] = flag;
      taken += flag;
      recent = ((recent << 1) | flag) & 255;
    }
    before = taken;
  }
  return mask;
}
