/** Gaussians within the tolerance of docs/bitstream_prediction.md from those of the Python package. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { compgs, fixtures, goldenGaussians } from "./fixtures.mjs";

const { Predictor, decode, gaussians } = compgs;

const FIELDS = { means: 3, quaternions: 4, scales: 3, opacities: 1, colors: 3 };

for (const { name, bytes, expected, arrays } of fixtures()) {
  test(`Gaussians of ${name} are those of the Python package`, () => {
    const found = gaussians(decode(bytes), { worldToCamera: expected.world_to_camera });
    assert.equal(found.opacities.length, expected.gaussians);
    let at = arrays.byteOffset;
    const next = (columns) => {
      const size = 4 * columns * expected.gaussians;
      return new Float32Array(arrays.buffer.slice(at, (at += size)));
    };
    const truth = Object.entries(FIELDS).map(([field, columns]) => [field, columns, next(columns)]);
    const sizes = next(3);
    for (const [field, columns, values] of truth) assertClose(field, found[field], values, columns, sizes);
  });
}

const PINNED = {
  mean: "means",
  quaternion: "quaternions",
  scales: "scales",
  opacity: "opacities",
  color: "colors",
};

for (const { name, bytes, pinned } of goldenGaussians()) {
  test(`Gaussians of golden file ${name} are the pinned ones`, () => {
    const scene = decode(bytes);
    const centre = pinned.camera_center.map((x, axis) => x + scene.worldOffset[axis]);
    const worldToCamera = [1, 0, 0, -centre[0], 0, 1, 0, -centre[1], 0, 0, 1, -centre[2], 0, 0, 0, 1];
    const found = gaussians(scene, { worldToCamera });
    assert.equal(found.opacities.length, pinned.count);
    for (const [number, field] of Object.entries(PINNED)) {
      const columns = FIELDS[field];
      const truth = pinned.first.flatMap((gaussian) => gaussian[number]);
      truth.forEach((x, i) => {
        const row = [pinned.first[Math.floor(i / columns)][number]].flat();
        const largest = Math.max(1, ...row.map(Math.abs));
        assert.ok(
          Math.abs(found[field][i] - x) <= 1e-4 * largest,
          `${field} ${i}: ${found[field][i]}, not ${x}`,
        );
      });
      const sums = new Array(columns).fill(0);
      found[field].forEach((x, i) => (sums[i % columns] += x));
      const scale = 1 + found[field].reduce((sum, x) => sum + Math.abs(x), 0);
      [pinned.sums[number]]
        .flat()
        .forEach((x, i) => assert.ok(Math.abs(sums[i] - x) <= 1e-4 * scale, `sum of ${field}`));
    }
  });
}

/** Twice the tolerance of one, as both may drift; of means, relative to the largest. */
function assertClose(field, found, truth, columns, sizes) {
  assert.equal(found.length, truth.length);
  const largest = truth.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
  for (let i = 0; i < truth.length; i++) {
    const row = truth.subarray(
      columns * Math.floor(i / columns),
      columns * Math.floor(i / columns) + columns,
    );
    const allowed =
      {
        means: 2e-5 * largest,
        scales: 2e-4 * truth[i] + 2e-6 * sizes[i],
      }[field] ?? 2e-4 * Math.max(1, Math.hypot(...row));
    assert.ok(Math.abs(found[i] - truth[i]) <= allowed, `${field} ${i}: ${found[i]}, expected ${truth[i]}`);
  }
}

test("appearance of some anchors alone is that of all", () => {
  for (const { bytes, name } of fixtures()) {
    if (name !== "paper" && name !== "shared") continue;
    const predictor = new Predictor(decode(bytes));
    const [whole, part] = [predictor.newAppearance(), predictor.newAppearance()];
    predictor.predictAppearance([1, 2, 3], whole);
    const { anchors, firstCoupled } = predictor.primitives;
    for (let first = 0; first < anchors; first += 100) {
      predictor.predictAppearance([1, 2, 3], part, first, Math.min(anchors, first + 100));
    }
    assert.equal(firstCoupled[anchors], whole.opacities.length);
    assert.deepEqual(part, whole);
  }
});
