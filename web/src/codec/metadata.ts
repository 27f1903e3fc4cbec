/** Metadata for people, and padding. */

import { CorruptSection } from "../errors.ts";
import { MAX_METADATA_BYTES } from "./constants.ts";
import { FieldReader } from "./fields.ts";
import { decodeText } from "./heads.ts";

export function readMetadata(payload: Uint8Array, name: string): Map<string, string> {
  const reader = new FieldReader(payload, name);
  if (payload.length > MAX_METADATA_BYTES)
    reader.refuse(`${payload.length} bytes, at most ${MAX_METADATA_BYTES}`);
  const count = reader.varint("entries", 0, MAX_METADATA_BYTES);
  const metadata = new Map<string, string>();
  let previous: Uint8Array | undefined;
  for (let i = 0; i < count; i++) {
    const key = reader.slice(reader.varint("length of a key", 0, reader.left), "a key");
    const value = reader.slice(reader.varint("length of a value", 0, reader.left), "a value");
    if (previous && compareBytes(previous, key) >= 0) reader.refuse("keys are not in ascending order");
    metadata.set(decodeText(key, reader), decodeText(value, reader));
    previous = key;
  }
  reader.end();
  return metadata;
}

function compareBytes(a: Uint8Array, b: Uint8Array): number {
  for (let i = 0; i < Math.min(a.length, b.length); i++) if (a[i] !== b[i]) return a[i]! - b[i]!;
  return a.length - b.length;
}

export function checkPadding(payload: Uint8Array, name: string): void {
  if (payload.some((byte) => byte !== 0)) throw new CorruptSection(`${name}: bytes other than zero`);
}
