/** The kernels in plain TypeScript: the readable truth, and what runs where WebAssembly is not at hand. */

import { CorruptSection } from "../errors.ts";
import { ArithmeticDecoder } from "./arithmetic_decoder.ts";
import type { Kernels } from "./kernels.ts";
import { decodeMaskFlags } from "./mask_coder.ts";
import { evaluateNetwork } from "./network_evaluation.ts";
import { OctreeWalk } from "./octree.ts";
import { decodeChunk } from "./rans.ts";

export const plainKernels: Kernels = {
  walkOctree(payload, start, anchors, depth, mostNodes, section) {
    const decoder = new ArithmeticDecoder(payload, start);
    const offsets = new OctreeWalk(decoder, anchors, depth, mostNodes, section).run();
    checkEnd(decoder, section);
    return { offsets, end: decoder.end };
  },
  decodeMasks(payload, anchors, slots, section) {
    const decoder = new ArithmeticDecoder(payload, 0);
    const mask = decodeMaskFlags(decoder, anchors, slots);
    checkEnd(decoder, section);
    return { mask, end: decoder.end };
  },
  decodeChunk,
  evaluate: evaluateNetwork,
};

function checkEnd(decoder: ArithmeticDecoder, section: string): void {
  if (!decoder.endsWell())
    throw new CorruptSection(`${section}: the code does not end as an encoder ends it`);
}
