/** Bytes of a .cgs file to a scene. */

import { unpack, SectionNumber } from "./codec/container.ts";
import { SceneDecoder } from "./codec/scene_decoder.ts";
import { type DecodedScene, withSplats } from "./decoded_scene.ts";
import { ProgressiveDecoder } from "./progressive.ts";
import { type ByteStream, piecesOf } from "./sources.ts";

export interface DecodeOptions {
  /**
   * Decode the beginning of a file to a coarser scene: true for whatever is there, a number for the file's first
   * bytes alone.
   */
  prefix?: boolean | number;
}

export interface StreamOptions {
  /** Is called with each finer scene while bytes arrive. */
  onScene?: (scene: DecodedScene) => void;
}

/**
 * The scene in a .cgs file (docs/bitstream.md): the same integers as on every other machine. Of bytes at once, of a
 * stream, a response or a blob when all of it has arrived.
 *
 * Throws, or rejects with, NotACompGSFile, UnsupportedVersion, TruncatedSection or CorruptSection, and MissingDependency
 * where there is no WebAssembly.
 */
export function decode(data: ArrayBuffer | Uint8Array, options?: DecodeOptions): DecodedScene;
export function decode(stream: ByteStream, options?: StreamOptions): Promise<DecodedScene>;
export function decode(
  source: ArrayBuffer | Uint8Array | ByteStream,
  options: DecodeOptions & StreamOptions = {},
): DecodedScene | Promise<DecodedScene> {
  if (source instanceof Uint8Array) return decodeBytes(source, options);
  if (source instanceof ArrayBuffer) return decodeBytes(new Uint8Array(source), options);
  return decodeStream(source, options);
}

function decodeBytes(data: Uint8Array, { prefix = false }: DecodeOptions): DecodedScene {
  const bytes = typeof prefix === "number" ? data.subarray(0, Math.max(0, prefix)) : data;
  const isPrefix = prefix !== false;
  const { version, sections, hasAllLatents } = unpack(bytes, isPrefix);
  const decoder = new SceneDecoder(version, sections, bytes.length, !isPrefix);
  for (const section of sections) {
    if (section.number === SectionNumber.latents) decoder.addRange(section, bytes.length);
  }
  if (hasAllLatents) decoder.checkComplete();
  return withSplats(decoder.scene());
}

async function decodeStream(stream: ByteStream, options: StreamOptions): Promise<DecodedScene> {
  const decoder = new ProgressiveDecoder();
  for await (const piece of piecesOf(stream)) {
    if (decoder.push(piece)) options.onScene?.(withSplats(decoder.scene()));
  }
  decoder.finish();
  return withSplats(decoder.scene());
}
