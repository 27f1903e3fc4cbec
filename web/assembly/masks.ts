/** Flags of the slots, each predicted from its anchor's and the anchors before (docs/bitstream.md, "Masks"). */

import { choose, endDecoder, mix, newMixer, startDecoder } from "./mixing";

const SLOTS = 64;

/** Flags [anchors, slots] at `out`. Returns the place behind the code, or -1 if it does not end well. */
export function decodeMasks(payload: usize, length: i32, anchors: i32, slots: i32, out: usize): i32 {
  startDecoder(payload, 0, length);
  const mixer = newMixer(3, 4160 + 16384 + 16640, SLOTS + 4, SLOTS, 24576, 1000, 2);
  let before = 0;
  for (let anchor = 0; anchor < anchors; anchor++) {
    const row = out + <usize>anchor * slots;
    let taken = 0;
    let recent = 0;
    for (let k = 0; k < slots; k++) {
      const one: i32 = anchor > 0 ? load<u8>(row + k - slots) : 0;
      const two: i32 = anchor > 1 ? load<u8>(row + k - 2 * slots) : 0;
      const pair = 2 * one + two;
      choose(mixer, 0, 65 * k + taken);
      choose(mixer, 1, 4160 + 256 * k + recent);
      choose(mixer, 2, 4160 + 16384 + (4 * k + pair) * 65 + before);
      const flag = mix(mixer, k, SLOTS + pair, k);
      store<u8>(row + k, flag);
      taken += flag;
      recent = ((recent << 1) | flag) & 255;
    }
    before = taken;
  }
  return endDecoder();
}
