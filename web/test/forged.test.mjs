/** Files whose checksums are sound and whose sections are not. */

import assert from "node:assert/strict";
import { test } from "node:test";
import * as encoding from "./encoding.mjs";
import { compgs, goldenFiles, hashesOf } from "./fixtures.mjs";

const { Predictor, decode } = compgs;
const [SCENE, POSITIONS, GPCC, MASKS, HEADS, LATENTS] = [1, 2, 3, 4, 7, 8];
const [REFERENCE, RESIDUAL] = [1, 3];
/** Where the background of a scene section ends. The groups follow, from version 4 on after the angular dilation. */
const BACKGROUND_END = 65;
const [METADATA, PADDING, VIEWPOINTS, UNKNOWN] = [129, 130, 131, 200];
/** One lens of 4 x 3 pixels, one view, of which `rotation` is six bytes. */
const viewpoints = (rotation) => {
  const bytes = Buffer.alloc(3 + 16 + 1 + 12 + 1 + 1 + 6 + 6);
  bytes.writeInt8(127, 1);
  bytes.writeFloatLE(1, 15);
  bytes.writeUInt8(1, 19);
  bytes.writeUInt16LE(4, 20);
  bytes.writeUInt16LE(3, 22);
  bytes.writeFloatLE(5, 24);
  bytes.writeFloatLE(6, 28);
  bytes.writeUInt8(1, 32);
  bytes.writeUIntLE(rotation, 40, 6);
  return bytes;
};

const { sectionsOf } = encoding;
const fileOf = (sections, version = files[0].bytes[4]) => encoding.fileOf(sections, version);

/** Of each group that a scene section of version 2 or 3 describes, its role and where its context is. */
function groupsOf(scene) {
  let at = BACKGROUND_END + 1;
  return Array.from({ length: scene[BACKGROUND_END] }, () => {
    const [role, context, steps] = [scene[at], at + 2, scene[at + 3]];
    at += 4 + 4 * steps;
    return { role, context };
  });
}

const files = goldenFiles().filter(
  ({ bytes }) => sectionsOf(bytes).filter((s) => s.number === LATENTS).length > 1,
);
assert.ok(files.length > 0);
const original = sectionsOf(files[0].bytes);
// A file of version 2 with each role.
const { bytes: paperBytes, hashes: paperHashes } = goldenFiles().find(({ name }) => name === "paper");
const paper = sectionsOf(paperBytes);
// A file of version 4.
const { bytes: dilatedBytes, hashes: dilatedHashes } = goldenFiles().find(({ name }) => name === "dilated");
const dilated = sectionsOf(dilatedBytes);
// A file of version 5.
const { bytes: rowsBytes } = goldenFiles().find(({ name }) => name === "rows");
const without = (number) => original.filter((section) => section.number !== number);
const withOne = (number, payload) => [...without(number), { number, payload: Buffer.from(payload) }];
const refuses = (sections, name, message, options) =>
  assert.throws(
    () => decode(fileOf(sections), options),
    (thrown) => thrown.name === name && message.test(thrown.message),
  );

test("what was taken apart is put together as it was", () => {
  assert.deepEqual(fileOf(original), Buffer.from(files[0].bytes));
});

test("a file is of one of the versions 2 to 5", () => {
  for (const version of [2, 3]) {
    assert.deepEqual(hashesOf(decode(fileOf(paper, version))), paperHashes);
  }
  assert.deepEqual(hashesOf(decode(fileOf(dilated, 4))), dilatedHashes);
  assert.equal(rowsBytes[4], 5);
  for (const version of [0, 1, 6, 255]) {
    assert.throws(() => decode(fileOf(paper, version)), { name: "UnsupportedVersion" });
  }
});

test("neighbours are of version 3, and not of residuals", () => {
  const refusesContext = (role, version, message) => {
    const scene = Buffer.from(paper[0].payload);
    const index = groupsOf(scene).findIndex((group) => group.role === role);
    scene[groupsOf(scene)[index].context] |= 2 << index;
    const changed = [{ number: SCENE, payload: scene }, ...paper.slice(1)];
    assert.throws(
      () => decode(fileOf(changed, version)),
      (thrown) => thrown.name === "CorruptSection" && message.test(thrown.message),
    );
  };
  refusesContext(REFERENCE, 2, /^scene: context of group/);
  refusesContext(REFERENCE, 3, /^entropy networks/); // its network has too few weights
  refusesContext(RESIDUAL, 2, /^scene: context of group/);
  refusesContext(RESIDUAL, 3, /^scene: .* residuals/);
});

test("an angular dilation is of version 4, where it must be, and within its limits", () => {
  for (const { bytes } of goldenFiles()) assert.equal(decode(bytes).angularDilation === null, bytes[4] < 4);
  assert.equal(decode(dilatedBytes).angularDilation, Math.fround(0.3 / 500 ** 2));
  const withDilation = (value) => {
    const scene = Buffer.from(dilated[0].payload);
    scene.writeFloatLE(value, BACKGROUND_END);
    return fileOf([{ number: SCENE, payload: scene }, ...dilated.slice(1)], 4);
  };
  for (const value of [2 ** -40, 1]) assert.equal(decode(withDilation(value)).angularDilation, value);
  for (const value of [0, -1, 2 ** -41, 1.001, Infinity, NaN]) {
    assert.throws(
      () => decode(withDilation(value)),
      (thrown) => thrown.name === "CorruptSection" && /^scene: angular_dilation/.test(thrown.message),
    );
  }
  const refusesAs = (sections, version) =>
    assert.throws(
      () => decode(fileOf(sections, version)),
      (thrown) => thrown.name === "CorruptSection" && /^scene: /.test(thrown.message),
    );
  for (const version of [2, 3]) refusesAs(dilated, version);
  refusesAs(paper, 4);
});

test("ranges that leave anchors out are refused, as a whole file and as a beginning that has all its ranges", () => {
  const short = original.slice(
    0,
    original.findLastIndex((section) => section.number === LATENTS),
  );
  for (const prefix of [false, true]) refuses(short, "CorruptSection", /^latents: level/, { prefix });
});

test("ranges twice, or out of order, are refused", () => {
  const ranges = original.filter((section) => section.number === LATENTS);
  const others = without(LATENTS).filter((section) => section.number < 128);
  refuses([...others, ranges[0], ...ranges], "CorruptSection", /^latents: level/);
  refuses(
    [...others, ...(ranges.toReversed?.() ?? [...ranges].reverse())],
    "CorruptSection",
    /^latents: range_anchors/,
  );
});

test("of a beginning, what is found first in the order of the file decides", () => {
  const damaged = Buffer.from(files[0].bytes);
  const start = 11 + 9 * original.length;
  damaged[start] ^= 1; // the first section, the scene
  for (const prefix of [false, true]) {
    const decodeIt = (length) => () => decode(damaged.subarray(0, length), { prefix });
    assert.throws(decodeIt(start + original[0].payload.length), {
      name: "CorruptSection",
      message: /^scene/,
    });
    assert.throws(decodeIt(start + original[0].payload.length - 1), { name: "TruncatedSection" });
  }
});

test("a missing section is named, and so is one that is unknown and must not be skipped", () => {
  refuses(without(MASKS), "CorruptSection", /section 4, masks, is missing/);
  refuses(without(POSITIONS), "CorruptSection", /0 kinds of positions/);
  refuses(
    [...original.filter((s) => s.number < 128), { number: 9, payload: Buffer.alloc(0) }],
    "UnsupportedVersion",
    /9/,
  );
});

test("positions by G-PCC are refused as something that a browser does not have", () => {
  const sections = original.map((s) =>
    s.number === POSITIONS ? { number: GPCC, payload: Buffer.alloc(20) } : s,
  );
  refuses(sections, "MissingDependency", /^positions \(G-PCC\)/);
});

test("an optional section that is unknown is skipped, and padding is zeros", () => {
  assert.equal(decode(fileOf(withOne(UNKNOWN, [1, 2, 3]))).anchors, decode(files[0].bytes).anchors);
  assert.equal(decode(fileOf(withOne(PADDING, [0, 0]))).anchors, decode(files[0].bytes).anchors);
  refuses(withOne(PADDING, [0, 1]), "CorruptSection", /^padding/);
});

test("metadata are in order, in UTF-8, and end with their section", () => {
  const found = decode(fileOf(withOne(METADATA, [2, 1, 97, 1, 98, 1, 99, 0]))).metadata;
  assert.deepEqual(
    [...found],
    [
      ["a", "b"],
      ["c", ""],
    ],
  );
  refuses(withOne(METADATA, [2, 1, 99, 0, 1, 97, 0]), "CorruptSection", /^metadata: keys/);
  refuses(withOne(METADATA, [1, 1, 0xff, 0]), "CorruptSection", /^metadata: a text/);
  refuses(withOne(METADATA, [0, 0]), "CorruptSection", /^metadata: 1 bytes/);
});

test("rotations are those of unit quaternions whose largest component is left out", () => {
  const packed = (largest, stored) =>
    stored.reduce((sum, x, i) => sum + ((x + 32768) % 32768) * 2 ** (2 + 15 * i), largest);
  const read = (rotation) =>
    decode(fileOf(withOne(VIEWPOINTS, viewpoints(rotation)))).viewpoints.views[0].rotation;
  const half = Math.round(16383 * Math.SQRT1_2);
  read(packed(2, [-half, half, half])).forEach((x, i) =>
    assert.ok(Math.abs(x - [-0.5, 0.5, 0.5, 0.5][i]) < 1e-4),
  );
  assert.deepEqual(read(packed(0, [0, 0, 0])), [1, 0, 0, 0]);
  for (const stored of [
    [-16384, 0, 0],
    [16383, 16383, 16383],
  ]) {
    refuses(withOne(VIEWPOINTS, viewpoints(packed(1, stored))), "CorruptSection", /^viewpoints: a rotation/);
  }
  refuses(withOne(VIEWPOINTS, viewpoints(2 ** 47)), "CorruptSection", /^viewpoints: bit 47/);
});

test("heads of another layout are refused when Gaussians are wanted", () => {
  const scene = decode(files[0].bytes);
  const tensors = new Map(scene.tensors);
  const [name, tensor] = [...tensors][0];
  const predict = (changed) => () => new Predictor({ ...scene, tensors: changed });
  assert.throws(predict(new Map([...tensors].slice(1))), { name: "CorruptSection", message: /is missing/ });
  assert.throws(predict(new Map([...tensors, ["more", tensor]])), {
    name: "CorruptSection",
    message: /more/,
  });
  const other = { ...tensor, shape: [1, ...tensor.shape] };
  assert.throws(predict(new Map([...tensors, [name, other]])), {
    name: "CorruptSection",
    message: /has shape/,
  });
  assert.ok(original.some((section) => section.number === HEADS));
});
