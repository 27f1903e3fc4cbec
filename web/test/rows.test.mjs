/** Rows: tables that shift with inertia, and chains, checked against the slow encoder of encoding.mjs. */

import assert from "node:assert/strict";
import { test } from "node:test";
import {
  GAUSSIAN,
  arraysOf,
  chunkOf,
  cumulated,
  fileOf,
  randomNumbers,
  readVarint,
  sectionsOf,
  shiftedTables,
  signedVarint,
  stepsOf,
  streamOf,
  varint,
} from "./encoding.mjs";
import { compgs, goldenFiles } from "./fixtures.mjs";

const { ProgressiveDecoder, decode, wasmKernels } = compgs;
const [SCENE, POSITIONS, MASKS, TABLES, NETWORKS, HEADS, LATENTS] = [1, 2, 4, 5, 6, 7, 8];
const [SIDE, REFERENCE, LOG_SCALES, RESIDUAL] = [0, 1, 2, 3];
const MAX_SYMBOL = 2 ** 18;
const ESCAPED = -(2 ** 31);

/** The Gaussian tables in the layout of kernels. */
function kernelTables() {
  const at = [];
  let size = 0;
  for (const { frequencies } of GAUSSIAN) {
    at.push(size);
    size += frequencies.length;
  }
  return {
    base: Int32Array.from(at),
    entries: Int32Array.from(GAUSSIAN, ({ frequencies }) => frequencies.length),
    lowest: Int32Array.from(GAUSSIAN, ({ radius }) => -radius),
    frequencies: Uint16Array.from(GAUSSIAN.flatMap(({ frequencies }) => frequencies)),
    cumulated: Uint16Array.from(GAUSSIAN.flatMap((_, t) => cumulated(t))),
    hints: new Uint16Array(128 * 256), // from the first entry on
  };
}

/** Symbols of rows that are smaller or larger than their tables say, some of them beyond all tables. */
function madeSymbols(given, channels, random) {
  let louder = 1;
  return given.map((table, i) => {
    if (i % channels === 0) louder = [0, 0.1, 0.5, 1, 1, 3, 20][random(7)];
    if (random(200) === 0) return random(2) ? 1000 : -1000;
    const spread = louder * 2 ** (table / 12 - 5);
    return Math.round(spread * (random(1000) / 250 - 2)) | 0; // never -0
  });
}

/** Names the first difference alone: all of a long stream would be no message. */
function assertSame(found, expected) {
  assert.equal(found.length, expected.length);
  const i = expected.findIndex((value, at) => value !== found[at]);
  assert.ok(i < 0, `place ${i}: ${found[i]}, expected ${expected[i]}`);
}

const madeTables = (count, random) => Array.from({ length: count }, () => random(128));

const decodes = (symbols, given, rows) => {
  const used = shiftedTables(symbols, given, rows?.channels, rows?.inertia ?? 0, rows?.first);
  const choices = Uint8Array.from(given);
  const found = new Int32Array(symbols.length);
  wasmKernels().decodeChunk(chunkOf(symbols, used), kernelTables(), choices, found, rows, "latents");
  const escaped = symbols.map((symbol, i) =>
    Math.abs(symbol) > GAUSSIAN[used[i]].radius ? ESCAPED : symbol,
  );
  assertSame(found, escaped);
  assertSame(choices, used);
  return used;
};

test("tables shift by what a row has shown, and choices become those that were used", () => {
  const random = randomNumbers(1);
  const shifts = new Set();
  for (const channels of [2, 3, 7, 32, 256]) {
    for (const inertia of [1, 2, 8, 63]) {
      const given = madeTables(600, random);
      const first = random(channels);
      const symbols = madeSymbols(given, channels, random);
      const used = decodes(symbols, given, { channels, inertia, first });
      used.forEach((table, i) => shifts.add(table - given[i]));
    }
  }
  assert.ok(Math.min(...shifts) === -36 && Math.max(...shifts) > 20, `${[...shifts]}`);
});

test("a chunk of two states shifts as one does", () => {
  const random = randomNumbers(2);
  const given = madeTables(2 ** 18 + 5, random);
  decodes(madeSymbols(given, 11, random), given, { channels: 11, inertia: 3, first: 9 });
});

test("without rows every symbol has the table that the network gives", () => {
  const random = randomNumbers(3);
  const given = madeTables(500, random);
  assertSame(decodes(madeSymbols(given, 5, random), given, null), given);
});

test("chains and inertia of each role give the latents of a slow decoder", () => {
  const made = madeFile(GROUPS);
  assertSame(latentsOf(decode(made.bytes)), made.latents.flat());
  const decoder = new ProgressiveDecoder();
  decoder.push(made.bytes);
  assertSame(latentsOf(decoder.scene()), made.latents.flat());
});

/** What `madeFile` makes groups of: their networks give the same means and scales everywhere. */
const GROUPS = [
  { role: SIDE, channels: 2, inertia: 5 },
  { role: REFERENCE, channels: 9, inertia: 2, isChained: true },
  { role: LOG_SCALES, channels: 6, isChained: true },
  { role: RESIDUAL, channels: 4, inertia: 63, isChained: true },
  { role: RESIDUAL, channels: 1, inertia: 7 },
];

// Positions, masks and ranges of 800 anchors.
const source = sectionsOf(goldenFiles().find(({ name }) => name === "default").bytes);
const payloadOf = (number) => source.find((section) => section.number === number).payload;

/** A file of version 5, and the latents of its groups. `changed` may name other fields than the legal ones. */
function madeFile(groups, changed = {}) {
  const random = randomNumbers(4);
  const full = groups.map((group) => ({ inertia: 0, ...group, ...priorOf(group, random) }));
  const ranges = source.filter(({ number }) => number === LATENTS).map(({ payload }) => rangeOf(payload));
  const latents = groups.map(() => []);
  const sections = [
    { number: SCENE, payload: sceneOf(full, changed) },
    { number: POSITIONS, payload: payloadOf(POSITIONS) },
    { number: MASKS, payload: payloadOf(MASKS) },
    { number: TABLES, payload: Buffer.alloc(0) },
    { number: NETWORKS, payload: networksOf(full, changed) },
    { number: HEADS, payload: changed.heads ?? headsOf(full, changed) },
    ...ranges.map((range) => ({ number: LATENTS, payload: latentsSection(range, full, random, latents) })),
  ];
  return { bytes: fileOf(sections, changed.version ?? 5), latents };
}

/** Means, scales and chain of a group, for which a change of the group may stand. */
function priorOf({ channels, isChained, chain, scales }, random) {
  const drawn = Array.from({ length: (channels * (channels - 1)) / 2 }, () => random(49) - 24);
  return {
    means: Array.from({ length: channels }, () => random(2 ** 20) - 2 ** 19),
    scales: scales ?? Array.from({ length: channels }, () => 2 ** 12 * random(128)),
    chain: chain ?? (isChained ? drawn : null),
  };
}

function rangeOf(payload) {
  let at = 0;
  const next = () => {
    const [value, behind] = readVarint(payload, at);
    at = behind;
    return value;
  };
  const [level, anchors, coupled] = [next(), next(), next()];
  return { anchors, coupled, head: Buffer.concat([level, anchors, coupled].map(varint)) };
}

const COUPLED_PRIMITIVES = 5;
const residualDim = (groups) => channelsOf(groups, RESIDUAL) || 3;
const channelsOf = (groups, role) =>
  groups.reduce((sum, group) => sum + (group.role === role ? group.channels : 0), 0);

function sceneOf(groups, { width = 4, layout = 1, version = 5 }) {
  const start = Buffer.from(payloadOf(SCENE).subarray(0, 65)); // up to the background
  start[8] = COUPLED_PRIMITIVES;
  start[9] = residualDim(groups);
  start[10] = layout;
  start.writeUInt16LE(width, 11);
  const dilation = Buffer.alloc(version < 4 ? 0 : 4);
  if (dilation.length) dilation.writeFloatLE(2 ** -18);
  const one = [0, 0, 0x80, 0x3f];
  const described = groups.map(({ role, channels }) => [
    role,
    channels,
    1, // the coordinates, to have a network
    ...(role === SIDE ? [0] : [1, ...one]),
  ]);
  return Buffer.concat([start, dilation, Buffer.from([groups.length, ...described.flat()])]);
}

/** Single layers of zero weights: their biases are the outputs. */
function networksOf(groups, { version = 5, flags }) {
  const widths = groups.map(({ role, channels }) =>
    role === RESIDUAL ? COUPLED_PRIMITIVES * channels : channels,
  );
  const heads = groups.map(({ chain, inertia }, i) => [
    1,
    flags ?? (chain ? 2 : 0),
    ...varint(2 * widths[i]),
    0,
    ...(version < 5 ? [] : [inertia]),
  ]);
  const arrays = groups.flatMap(({ channels, means, scales, chain }, i) => {
    const width = widths[i];
    const weights = new Array(3 * width).fill(0);
    const repeated = (values) => Array.from({ length: width }, (_, c) => values[c % channels]);
    return [weights, weights, repeated(means), repeated(scales), ...(chain ? [chain] : [])];
  });
  return Buffer.concat([Buffer.from(heads.flat()), arraysOf(arrays)]);
}

/** Elements of each tensor, and its name, in the order of docs/bitstream_prediction.md. */
function tensorsOf(groups, { width = 4 }) {
  const [D, G] = [channelsOf(groups, REFERENCE), residualDim(groups)];
  const network = (name, inputs, outputs) => [
    [`${name}.input_weight`, [inputs, width]],
    [`${name}.input_bias`, [width]],
    [`${name}.output_weight`, [width, outputs]],
    [`${name}.output_bias`, [outputs]],
    [`${name}.skip_weight`, [inputs, outputs]],
    [`${name}.blocks.0.weight1`, [width, width]],
    [`${name}.blocks.0.bias1`, [width]],
    [`${name}.blocks.0.weight2`, [width, width]],
    [`${name}.blocks.0.bias2`, [width]],
  ];
  const shared = channelsOf(groups, RESIDUAL) ? [] : [["residuals", [COUPLED_PRIMITIVES, G]]];
  return [...network("geometry", D + G, 10), ...network("appearance", D + 4 + G, 4), ...shared];
}

/** Values count on from tensor to tensor, and exponents from 3 on. */
function headsOf(groups, { exponent }) {
  let next = 0;
  const sizes = tensorsOf(groups, {}).map(([, shape]) => shape.reduce((a, b) => a * b));
  const exponents = sizes.map((_, i) => signedVarint(exponent ?? i + 3));
  const values = sizes.map((size) => Array.from({ length: size }, () => next++));
  return Buffer.concat([...exponents, arraysOf(values)]);
}

/** A section of latents; adds what it holds to the `latents` of each group. */
function latentsSection({ anchors, coupled, head }, groups, random, latents) {
  const streams = groups.map(({ role, channels, means, scales, chain, inertia, row }, i) => {
    const count = channels * (role === RESIDUAL ? coupled : anchors);
    const given = Array.from({ length: count }, (_, at) => scales[at % channels] / 2 ** 12);
    const made = madeSymbols(given, channels, random);
    const symbols = row ? made.map((_, at) => row[at % channels]) : made;
    const steps = chain ? stepsOf(symbols, channels, chain) : symbols;
    steps.forEach((step, at) => latents[i].push(4096 * step + means[at % channels]));
    return streamOf(symbols, given, channels, inertia);
  });
  return Buffer.concat([head, ...streams]);
}

const latentsOf = (scene) => scene.groups.flatMap((group) => [...group.latents]);

function refuses(groups, message, changed) {
  assert.throws(
    () => decode(madeFile(groups, changed).bytes),
    (thrown) => thrown.name === "CorruptSection" && message.test(thrown.message),
    `${message}`,
  );
}

const withReference = (changed) => [{ role: REFERENCE, channels: 3, ...changed }, GROUPS[2]];

test("heads have no names: they are those of the scene, in the order of the document", () => {
  for (const groups of [GROUPS, withReference({})]) {
    const { tensors } = decode(madeFile(groups).bytes);
    const expected = tensorsOf(groups, {});
    assert.deepEqual(
      [...tensors].map(([name, { shape }]) => [name, shape]),
      expected,
    );
    let next = 0;
    [...tensors.values()].forEach(({ exponent, values }, i) => {
      assert.equal(exponent, i + 3);
      for (const value of values) assert.equal(value, next++);
    });
  }
});

test("heads with names, of too many elements or of an exponent beyond 62 are refused", () => {
  refuses(withReference({}), /^prediction heads/, { heads: payloadOf(HEADS) });
  refuses(withReference({}), /^prediction heads: exponent/, { exponent: 63 });
  refuses(withReference({}), /^prediction heads: exponent/, { exponent: -63 });
  refuses(withReference({}), /^prediction heads: more than 4194304/, { width: 1024, layout: 0 });
  decode(madeFile(withReference({}), { exponent: -62 }).bytes);
});

test("inertia is at most 63", () => {
  decode(madeFile(withReference({ inertia: 63 })).bytes);
  refuses(withReference({ inertia: 64 }), /^entropy networks: inertia is 64/);
  refuses(withReference({ inertia: 255 }), /^entropy networks: inertia is 255/);
});

test("a chain is of version 5 and of several channels; no other flag is legal in a single layer", () => {
  const message = /^entropy networks: flags of a network/;
  refuses(withReference({ isChained: true }), message, { version: 4 });
  refuses([{ role: REFERENCE, channels: 1 }, GROUPS[2]], message, { flags: 2 });
  for (const flags of [1, 3, 4, 128]) refuses(withReference({ isChained: true }), message, { flags });
});

test("a chain has the elements that it must have, below 2^12", () => {
  decode(madeFile(withReference({ chain: [4095, -4095, 0] })).bytes);
  for (const element of [4096, -4096]) {
    refuses(withReference({ chain: [0, element, 0] }), /^entropy networks: an element of chain/);
  }
  refuses(withReference({}), /^entropy networks/, { flags: 2 });
  refuses(withReference({ isChained: true }), /^entropy networks/, { flags: 0 });
});

test("steps are at most MAX_SYMBOL, as symbols are", () => {
  const scales = [0, 0, 0];
  const withRow = (row, chain) => withReference({ row, chain, scales });
  for (const sign of [1, -1]) {
    const made = madeFile(withRow([sign * (MAX_SYMBOL - 1), sign, 0], [64, 0, 0]));
    assertSame(decode(made.bytes).groups[0].latents, made.latents[0]);
    refuses(withRow([sign * MAX_SYMBOL, sign, 0], [64, 0, 0]), /^latents: a step is -?262145/);
    refuses(withRow([0, 0, sign * (MAX_SYMBOL + 1)], [0, 0, 0]), /^latents: a symbol is -?262145/);
  }
  const beyond = withRow([-MAX_SYMBOL, MAX_SYMBOL + 1, 0], [64, 0, 0]); // a symbol that is none, of a step that is one
  refuses(beyond, /^latents: a symbol is 262145/);
});
