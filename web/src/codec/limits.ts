/** Bounds on work and memory by the length of the file (docs/bitstream.md, "Limits"). */

import { CorruptSection } from "../errors.ts";
import {
  FREE_HEAD_PRODUCTS,
  FREE_NETWORK_PRODUCTS,
  FREE_SYMBOLS,
  HEAD_PRODUCTS_PER_BYTE,
  NETWORK_PRODUCTS_PER_BYTE,
  SYMBOLS_PER_BYTE,
} from "./constants.ts";
import type { GroupShape } from "./scene_section.ts";

export function checkSymbols(anchors: number, groups: GroupShape[], bytes: number): void {
  const width = groups.reduce((sum, group) => sum + group.width, 0);
  check("scene", "symbols", anchors * width, FREE_SYMBOLS + SYMBOLS_PER_BYTE * bytes);
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
