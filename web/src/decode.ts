/** Bytes of a .cgs file to a scene. */

import { unpack, SectionNumber } from "./codec/container.ts";
import type { Kernels } from "./codec/kernels.ts";
import { plainKernels } from "./codec/plain_kernels.ts";
import { type Scene, SceneDecoder } from "./codec/scene_decoder.ts";

export interface DecodeOptions {
  /**
   * Decode the beginning of a file to a coarser scene: true for whatever is there, a number for the file's first
   * bytes alone.
   */
  prefix?: boolean | number;
  /** The loops that take the time; plain TypeScript unless given (see `wasmKernels`). */
  kernels?: Kernels;
}

/**
 * The scene in a .cgs file (docs/bitstream.md): the same integers as on every other machine.
 *
 * Throws NotACompGSFile, UnsupportedVersion, TruncatedSection or CorruptSection.
 */
export function decode(data: ArrayBuffer | Uint8Array, options: DecodeOptions = {}): Scene {
  const { prefix = false, kernels = plainKernels } = options;
  let bytes = data instanceof Uint8Array ? data : new Uint8Array(data);
  if (typeof prefix === "number") bytes = bytes.subarray(0, Math.max(0, prefix));
  const isPrefix = prefix !== false;
  const { version, sections, hasAllLatents } = unpack(bytes, isPrefix);
  const decoder = new SceneDecoder(version, sections, kernels, bytes.length, !isPrefix);
  for (const section of sections) {
    if (section.number === SectionNumber.latents) decoder.addRange(section, bytes.length);
  }
  if (hasAllLatents) decoder.checkComplete();
  return decoder.scene();
}
