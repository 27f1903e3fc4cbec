/** From bytes to checksummed sections (docs/bitstream.md, "File" and "What a decoder must refuse"). */

import { CorruptSection, NotACompGSFile, TruncatedSection, UnsupportedVersion } from "../errors.ts";
import { MAGIC, MAX_RANGES, MAX_SECTIONS, OLDEST_VERSION, OPTIONAL, VERSION } from "./constants.ts";
import { crc32 } from "./crc32.ts";

export const SectionNumber = {
  scene: 1,
  positions: 2,
  gpccPositions: 3,
  masks: 4,
  tables: 5,
  networks: 6,
  heads: 7,
  latents: 8,
  metadata: 129,
  padding: 130,
  viewpoints: 131,
} as const;

const NAMES: Record<number, string> = {
  1: "scene",
  2: "positions",
  3: "positions (G-PCC)",
  4: "masks",
  5: "tables",
  6: "entropy networks",
  7: "prediction heads",
  8: "latents",
  129: "metadata",
  130: "padding",
  131: "viewpoints",
};

const START_BYTES = MAGIC.length + 3; // Magic, Version, Flags, Section_Count
const ENTRY_BYTES = 9;
const CRC_BYTES = 4;

export interface Section {
  number: number;
  name: string;
  payload: Uint8Array;
  /** Bytes of the file up to the end of this section. */
  end: number;
}

/** What the header promises of one section, before any of its bytes are there. */
export interface SectionEntry {
  number: number;
  name: string;
  start: number;
  length: number;
  crc: number;
}

export interface Header {
  version: number;
  entries: SectionEntry[];
}

/**
 * A file's version, its sections, their checksums verified, and whether all its latents are among them.
 *
 * With `prefix` the file may end early: the sections before the first that is not there to its end. The first section
 * of latents and all before it must be there.
 */
export function unpack(
  file: Uint8Array,
  prefix: boolean,
): { version: number; sections: Section[]; hasAllLatents: boolean } {
  const { version, entries } = readHeader(file);
  const isLatents = ({ number }: { number: number }): boolean => number === SectionNumber.latents;
  const sections: Section[] = [];
  for (const entry of entries) {
    const end = entry.start + entry.length;
    if (end > file.length) {
      if (prefix && sections.some(isLatents)) {
        return {
          version,
          sections,
          hasAllLatents: sections.filter(isLatents).length === entries.filter(isLatents).length,
        };
      }
      throw new TruncatedSection(
        `${entry.name}: header promises ${entry.length} bytes, file ends after ${Math.max(0, file.length - entry.start)}`,
      );
    }
    sections.push(unpackSection(file, entry));
  }
  const last = entries[entries.length - 1]!;
  const extra = file.length - (last.start + last.length);
  if (extra > 0) throw new CorruptSection(`file: ${extra} bytes after the last section`);
  return { version, sections, hasAllLatents: true };
}

/** A section whose bytes are all there. */
export function unpackSection(file: Uint8Array, { number, name, start, length, crc }: SectionEntry): Section {
  const payload = file.subarray(start, start + length);
  if (crc32(payload) !== crc) throw new CorruptSection(`${name}: checksum does not match`);
  return { number, name, payload, end: start + length };
}

/** The header of a file in which it is whole: checks 1 to 9. */
export function readHeader(file: Uint8Array): Header {
  const isMagic = MAGIC.slice(0, file.length).every((byte, i) => file[i] === byte);
  if (!isMagic)
    throw new NotACompGSFile(`file: expected to begin with 93 43 47 53, found ${hex(file.subarray(0, 4))}`);
  if (file.length < START_BYTES) throw new TruncatedSection(`header: file ends after ${file.length} bytes`);
  const [version, flags, count] = [file[4]!, file[5]!, file[6]!];
  if (version < OLDEST_VERSION || version > VERSION) {
    throw new UnsupportedVersion(
      `file: version ${version}, this decoder reads versions ${OLDEST_VERSION} to ${VERSION}`,
    );
  }
  const size = START_BYTES + count * ENTRY_BYTES + CRC_BYTES;
  if (file.length < size)
    throw new TruncatedSection(`header: needs ${size} bytes, file ends after ${file.length}`);
  const view = new DataView(file.buffer, file.byteOffset, size);
  if (crc32(file.subarray(0, size - CRC_BYTES)) !== view.getUint32(size - CRC_BYTES, true)) {
    throw new CorruptSection("header: checksum does not match");
  }
  if (flags !== 0) throw new CorruptSection(`header: flags are ${flags}, expected 0`);
  if (count > MAX_SECTIONS)
    throw new CorruptSection(`header: ${count} sections, at most ${MAX_SECTIONS} are allowed`);
  const entries: SectionEntry[] = [];
  let start = size;
  for (let i = 0; i < count; i++) {
    const at = START_BYTES + i * ENTRY_BYTES;
    const number = view.getUint8(at);
    const length = view.getUint32(at + 1, true);
    entries.push({
      number,
      name: NAMES[number] ?? `section ${number}`,
      start,
      length,
      crc: view.getUint32(at + 5, true),
    });
    start += length;
  }
  checkNumbers(entries.map((entry) => entry.number));
  return { version, entries };
}

function checkNumbers(numbers: number[]): void {
  const unknown = numbers.find((n) => n < OPTIONAL && !(n in NAMES));
  if (unknown !== undefined) {
    throw new UnsupportedVersion(
      `header: section ${unknown} is unknown to this decoder and must not be skipped`,
    );
  }
  checkOrder(numbers);
  const { scene, masks, tables, networks, heads, latents, positions, gpccPositions } = SectionNumber;
  for (const required of [scene, masks, tables, networks, heads, latents]) {
    if (!numbers.includes(required))
      throw new CorruptSection(`header: section ${required}, ${NAMES[required]}, is missing`);
  }
  const kinds = [positions, gpccPositions].filter((n) => numbers.includes(n)).length;
  if (kinds !== 1) throw new CorruptSection(`header: ${kinds} kinds of positions, expected one`);
  const ranges = numbers.filter((n) => n === latents).length;
  if (ranges > MAX_RANGES) {
    throw new CorruptSection(`header: ${ranges} sections of latents, at most ${MAX_RANGES} are allowed`);
  }
}

function checkOrder(numbers: number[]): void {
  const known = numbers.filter((n) => n < OPTIONAL);
  for (let i = 1; i < known.length; i++) {
    const repeats = known[i] === SectionNumber.latents && known[i - 1] === SectionNumber.latents;
    if (known[i]! <= known[i - 1]! && !repeats)
      throw new CorruptSection(`header: section ${known[i]} is out of order`);
  }
  const optional = numbers.filter((n) => n >= OPTIONAL);
  const twice = optional.find((n, i) => optional.indexOf(n) !== i);
  if (twice !== undefined) throw new CorruptSection(`header: section ${twice} is there twice`);
}

function hex(bytes: Uint8Array): string {
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join(" ");
}
