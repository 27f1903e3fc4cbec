/** Bounds on work and memory by the length of the file (docs/bitstream.md, "Limits"). */

import { CorruptSection } from "../errors.ts";
import {
  FLAGS_PER_BYTE,
  FREE_FLAGS,
  FREE_HEAD_PRODUCTS,
  FREE_NETWORK_PRODUCTS,
  FREE_NODES,
  FREE_SYMBOLS,
  HEAD_PRODUCTS_PER_BYTE,
  NETWORK_PRODUCTS_PER_BYTE,
  NODES_PER_BYTE,
  SYMBOLS_PER_BYTE,
} from "./constants.ts";
import type { GroupShape } from "./scene_section.ts";

export function checkSymbols(anchors: number, groups: GroupShape[], bytes: number): void {
  const width = groups.reduce((sum, group) => sum + group.width, 0);
  check("scene", "symbols", anchors * width, FREE_SYMBOLS + SYMBOLS_PER_BYTE * bytes);
}

export function checkFlags(anchors: number, slots: number, bytes: number): void {
  check("scene", "flags of masks", anchors * slots, FREE_FLAGS + FLAGS_PER_BYTE * bytes);
}

/** Nodes that the walk of the octree may code. */
export function mostNodes(bytes: number): number {
  return FREE_NODES + NODES_PER_BYTE * bytes;
}

export function checkNetworkProducts(anchors: number, weights: number, bytes: number): void {
  check(
    "entropy networks",
    "products",
    anchors * weights,
    FREE_NETWORK_PRODUCTS + NETWORK_PRODUCTS_PER_BYTE * bytes,
  );
}

export function checkHeadProducts(coupled: number, elements: number, bytes: number): void {
  check(
    "prediction heads",
    "products",
    coupled * elements,
    FREE_HEAD_PRODUCTS + HEAD_PRODUCTS_PER_BYTE * bytes,
  );
}

function check(section: string, what: string, found: number, most: number): void {
  if (found > most)
    throw new CorruptSection(`${section}: ${found} ${what}, at most ${most} for a file of this length`);
}
