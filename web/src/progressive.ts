/** A scene from the bytes of a file as they arrive: coarse first, finer with each range that is complete. */

import {
  type Header,
  type Section,
  type SectionEntry,
  SectionNumber,
  readHeader,
  unpackSection,
} from "./codec/container.ts";
import { FieldReader } from "./codec/fields.ts";
import { readRangeHead } from "./codec/latents.ts";
import { type Scene, SceneDecoder } from "./codec/scene_decoder.ts";
import { CorruptSection, TruncatedSection } from "./errors.ts";

const MAX_HEADER_BYTES = 7 + 255 * 9 + 4;
const MAX_RANGE_HEAD_BYTES = 3 * 9;

export class ProgressiveDecoder {
  private bytes = new Uint8Array(1 << 16);
  private length = 0;
  private header: Header | null = null;
  /** Sections whose bytes are there, their checksums verified, that no decoder has seen yet. */
  private waiting: Section[] = [];
  private next = 0;
  private decoder: SceneDecoder | null = null;

  /** A finer scene would have more primitives than are wanted: nothing that is still to come is needed. */
  isFull = false;

  /** `most`: coupled primitives that are wanted. The coarsest scene of a file is there even if it has more. */
  constructor(private readonly most = Infinity) {}

  /** Bytes of the whole file as its header has it, or null before the header is there. */
  get expectedBytes(): number | null {
    const last = this.header?.entries[this.header.entries.length - 1];
    return last ? last.start + last.length : null;
  }

  /** Takes more of the file. True if a finer scene can be had. Throws as `decode` does. */
  push(chunk: Uint8Array): boolean {
    if (this.isFull) return false;
    this.append(chunk);
    if (!this.header && !this.tryHeader(false)) return false;
    const { entries } = this.header!;
    let isFiner = false;
    for (; this.next < entries.length; this.next++) {
      const entry = entries[this.next]!;
      this.isFull = this.isTooMuch(entry);
      if (this.isFull) break;
      if (entry.start + entry.length > this.length) break;
      isFiner = this.take(unpackSection(this.bytes.subarray(0, this.length), entry)) || isFiner;
    }
    return isFiner;
  }

  /** Says that all bytes are there; throws if they are not the whole of a file. */
  finish(): void {
    if (this.isFull) return;
    if (!this.header) this.tryHeader(true);
    const missing = this.header!.entries[this.next];
    if (missing) {
      throw new TruncatedSection(
        `${missing.name}: header promises ${missing.length} bytes, file ends after ${this.length - missing.start}`,
      );
    }
    const extra = this.length - this.expectedBytes!;
    if (extra > 0) throw new CorruptSection(`file: ${extra} bytes after the last section`);
    this.decoder!.checkComplete();
  }

  /** The scene of all ranges that are there. */
  scene(): Scene {
    return this.decoder!.scene();
  }

  /** Whether a range is known to have more primitives than are wanted. Its first bytes say how many it has. */
  private isTooMuch({ number, name, start, length }: SectionEntry): boolean {
    if (number !== SectionNumber.latents || !this.decoder) return false;
    const head = this.bytes.subarray(
      start,
      Math.min(start + MAX_RANGE_HEAD_BYTES, start + length, this.length),
    );
    if (head.length < Math.min(MAX_RANGE_HEAD_BYTES, length)) return false;
    try {
      return this.decoder.coupled + readRangeHead(new FieldReader(head, name)).coupled > this.most;
    } catch {
      return false; // a damaged range is refused when all of it is there
    }
  }

  private append(chunk: Uint8Array): void {
    if (this.length + chunk.length > this.bytes.length) {
      const larger = new Uint8Array(Math.max(2 * this.bytes.length, this.length + chunk.length));
      larger.set(this.bytes.subarray(0, this.length));
      this.bytes = larger;
    }
    this.bytes.set(chunk, this.length);
    this.length += chunk.length;
  }

  /** Whether the header is there. One that is only not there yet is no error before the end. */
  private tryHeader(isEnd: boolean): boolean {
    try {
      this.header = readHeader(this.bytes.subarray(0, this.length));
      return true;
    } catch (error) {
      const mayCome = error instanceof TruncatedSection && !isEnd && this.length < MAX_HEADER_BYTES;
      if (!mayCome) throw error;
      return false;
    }
  }

  private take(section: Section): boolean {
    if (section.number !== SectionNumber.latents) {
      if (this.decoder) this.decoder.addOptional([section]);
      else this.waiting.push(section);
      return false;
    }
    this.decoder ??= new SceneDecoder(this.header!.version, this.waiting, this.length, false);
    this.decoder.addRange(section, this.length);
    return true;
  }
}
