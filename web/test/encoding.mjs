/**
 * An encoder of what the tests need, from docs/bitstream.md alone: slow, in integers of any size, and without anything
 * of src/.
 */

import { readFileSync } from "node:fs";
import { fileURLToPath } from "node:url";
import { crc32 } from "node:zlib";

const TABLES = fileURLToPath(new URL("../../src/compgs/codec/gaussian_tables.bin", import.meta.url));
const CHUNK_SYMBOLS = 2 ** 20;
const SINGLE_STATE_SYMBOLS = 2 ** 18;
const LARGEST_TABLE_SHIFT = 36;

/** {number, payload} of each section of a file. */
export function sectionsOf(bytes) {
  const count = bytes[6];
  let at = 11 + 9 * count;
  return Array.from({ length: count }, (_, i) => {
    const length = bytes.readUInt32LE(8 + 9 * i);
    at += length;
    return { number: bytes[7 + 9 * i], payload: bytes.subarray(at - length, at) };
  });
}

/** The file that has these sections, with checksums that match. */
export function fileOf(sections, version) {
  const head = Buffer.alloc(7 + 9 * sections.length);
  head.set([0x93, 0x43, 0x47, 0x53, version, 0, sections.length]);
  sections.forEach(({ number, payload }, i) => {
    head[7 + 9 * i] = number;
    head.writeUInt32LE(payload.length, 8 + 9 * i);
    head.writeUInt32LE(crc32(payload), 12 + 9 * i);
  });
  const check = Buffer.alloc(4);
  check.writeUInt32LE(crc32(head));
  return Buffer.concat([head, check, ...sections.map(({ payload }) => payload)]);
}

export function varint(value) {
  const bytes = [];
  for (; value >= 128; value = Math.floor(value / 128)) bytes.push((value % 128) + 128);
  return Buffer.from([...bytes, value]);
}

/** [value, place behind it] */
export function readVarint(bytes, at) {
  let value = 0;
  for (let scale = 1; ; scale *= 128) {
    const byte = bytes[at++];
    value += (byte & 127) * scale;
    if (byte < 128) return [value, at];
  }
}

export const signedVarint = (value) => varint(value < 0 ? -2 * value - 1 : 2 * value);

/** The Gaussian tables: radius r, and frequencies of -r ... r and of the escape. */
export const GAUSSIAN = readGaussian();

function readGaussian() {
  const bytes = readFileSync(TABLES);
  let at = -2;
  const next = () => bytes.readUInt16LE((at += 2));
  return Array.from({ length: 128 }, () => {
    const radius = next();
    const half = Array.from({ length: radius + 1 }, next);
    return { radius, frequencies: [...half.slice(1).reverse(), ...half, next()] };
  });
}

/** E(t), Q12. */
const SIZES = GAUSSIAN.map(({ radius, frequencies }) => {
  let sum = 0n;
  for (let q = 1; q <= radius; q++) sum += BigInt(q * frequencies[radius + q]);
  return sum / 8n;
});

/** M(d) = floor(2^(15 + (2 d - 1) / 24)), from the lowest d on: the largest m with m^24 <= 2^(360 + 2 d - 1). */
const RATIOS = Array.from({ length: 2 * LARGEST_TABLE_SHIFT + 1 }, (_, i) => {
  const power = 1n << BigInt(360 + 2 * (i - LARGEST_TABLE_SHIFT) - 1);
  let m = 0n;
  for (let bit = 1n << 20n; bit; bit >>= 1n) if ((m + bit) ** 24n <= power) m += bit;
  return m;
});

/**
 * The tables with which the symbols of a stream are coded, for those that the network gives. `first`: place in its row
 * of the first symbol.
 */
export function shiftedTables(symbols, given, channels, inertia, first = 0) {
  if (!inertia) return [...given];
  let [seen, expected, shift] = [0n, 0n, 0];
  return symbols.map((symbol, i) => {
    if (i % CHUNK_SYMBOLS === 0 || (first + i) % channels === 0) {
      [seen, expected, shift] = [4096n * BigInt(inertia), 4096n * BigInt(inertia), 0];
    }
    const table = Math.max(0, Math.min(127, given[i] + shift));
    const size = SIZES[given[i]];
    const isEscape = Math.abs(symbol) > GAUSSIAN[table].radius;
    const whole = 4096n * BigInt(Math.abs(symbol));
    const counted = isEscape || whole > 4n * size ? 4n * size : whole;
    seen += (4096n * counted) / (size + 1229n);
    expected += (4096n * size) / (size + 1229n);
    shift = -LARGEST_TABLE_SHIFT;
    RATIOS.forEach((ratio, d) => {
      if (32768n * seen >= expected * ratio) shift = d - LARGEST_TABLE_SHIFT;
    });
    return table;
  });
}

/** Words of a chunk, four bytes each; `tables` are those with which the symbols are coded. */
export function chunkOf(symbols, tables) {
  const states = symbols.length < SINGLE_STATE_SYMBOLS ? [1n << 31n] : [1n << 31n, 1n << 31n];
  const words = []; // the last one first
  for (let i = symbols.length - 1; i >= 0; i--) {
    const { radius, frequencies } = GAUSSIAN[tables[i]];
    const entry = Math.abs(symbols[i]) > radius ? 2 * radius + 1 : symbols[i] + radius;
    const f = BigInt(frequencies[entry]);
    const c = BigInt(cumulated(tables[i])[entry]);
    let state = states[i % states.length];
    if (state >= f << 47n) {
      words.push(Number(state & 0xffffffffn));
      state >>= 32n;
    }
    states[i % states.length] = 65536n * (state / f) + c + (state % f);
  }
  for (const state of states.reverse()) words.push(Number(state >> 32n), Number(state & 0xffffffffn));
  const bytes = Buffer.alloc(4 * words.length);
  words.reverse().forEach((word, i) => bytes.writeUInt32LE(word, 4 * i));
  return bytes;
}

const sums = [];

/** Sum of the frequencies before each entry. */
export function cumulated(table) {
  let sum = 0;
  return (sums[table] ??= GAUSSIAN[table].frequencies.map((f) => (sum += f) - f));
}

export function streamOf(symbols, given, channels = 1, inertia = 0) {
  if (!symbols.length) return Buffer.alloc(0);
  const tables = shiftedTables(symbols, given, channels, inertia);
  const chunks = [];
  for (let start = 0; start < symbols.length; start += CHUNK_SYMBOLS) {
    const end = start + CHUNK_SYMBOLS;
    chunks.push(chunkOf(symbols.slice(start, end), tables.slice(start, end)));
  }
  const escapes = symbols.map((symbol, i) => {
    const { radius } = GAUSSIAN[tables[i]];
    if (Math.abs(symbol) <= radius) return Buffer.alloc(0);
    return varint(symbol > 0 ? 2 * (symbol - radius - 1) : 2 * (-radius - 1 - symbol) + 1);
  });
  const escaped = Buffer.concat(escapes);
  const words = chunks.map((chunk) => varint(chunk.length / 4));
  return Buffer.concat([...words, varint(escaped.length), ...chunks, escaped]);
}

/** Arrays of integers, each with 20 low bits. */
export function arraysOf(arrays) {
  const [table, lowBits] = [12, 20];
  const half = 2 ** (lowBits - 1);
  const all = arrays.flat();
  const high = all.map((value) => Math.floor((value + half) / 2 ** lowBits));
  const low = all.map((value, i) => value + half - high[i] * 2 ** lowBits);
  const stream = streamOf(high, new Array(all.length).fill(table));
  const bits = low.map((value) => value.toString(2).padStart(lowBits, "0")).join("");
  const lowParts = bits.match(/.{1,8}/g) ?? [];
  return Buffer.concat([
    Buffer.from(arrays.flatMap(() => [table, lowBits])),
    varint(stream.length),
    stream,
    Buffer.from(lowParts.map((byte) => parseInt(byte.padEnd(8, "0"), 2))),
  ]);
}

/** A chain's steps, of symbols row by row. */
export function stepsOf(symbols, channels, chain) {
  const steps = [];
  symbols.forEach((symbol, i) => {
    const c = i % channels;
    let sum = 32n;
    for (let j = 0; j < c; j++) sum += BigInt(chain[(c * (c - 1)) / 2 + j]) * BigInt(steps[i - c + j]);
    steps.push(symbol + Number(sum >> 6n));
  });
  return steps;
}

/** Numbers below `count`, the same in every run. */
export function randomNumbers(seed) {
  let state = BigInt(seed);
  return (count) => {
    state = (state * 6364136223846793005n + 1442695040888963407n) % (1n << 64n);
    return Number(state >> 33n) % count;
  };
}
