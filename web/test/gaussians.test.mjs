/** Gaussians within the tolerance of docs/bitstream_prediction.md from those of the Python package. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { compgs, fixtures } from "./fixtures.mjs";

const { Predictor, decode, gaussians, plainKernels, wasmKernels } = compgs;
const KINDS = { "plain TypeScript": plainKernels, WebAssembly: await wasmKernels() };

const FIELDS = { means: 3, quaternions: 4, scales: 3, opacities: 1, colors: 3 };

for (const { name, bytes, expected, arrays } of fixtures()) {
  const scene = decode(bytes, { kernels: KINDS.WebAssembly });
  for (const [kind, kernels] of Object.entries(KINDS)) {
    test(`${kind}: Gaussians of ${name} are those of the Python package`, () => {
      const found = gaussians(scene, { worldToCamera: expected.world_to_camera }, kernels);
      assert.equal(found.opacities.length, expected.gaussians);
      let at = 0;
      for (const [field, columns] of Object.entries(FIELDS)) {
        const size = 4 * columns * expected.gaussians;
        const truth = new Float32Array(arrays.buffer.slice(arrays.byteOffset + at, arrays.byteOffset + at + size));
        at += size;
        assertClose(field, found[field], truth, columns);
      }
    });
  }
}

/** Twice the tolerance of one, as both may drift; of means, relative to the largest. */
function assertClose(field, found, truth, columns) {
  assert.equal(found.length, truth.length);
  const largest = truth.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
  for (let i = 0; i < truth.length; i++) {
    const row = truth.subarray(columns * Math.floor(i / columns), columns * Math.floor(i / columns) + columns);
    const size = Math.hypot(...row);
    const allowed =
      field === "means" ? 2e-5 * largest : field === "scales" ? 2e-4 * truth[i] + 1e-6 : 2e-4 * Math.max(1, size);
    assert.ok(Math.abs(found[i] - truth[i]) <= allowed, `${field} ${i}: ${found[i]}, expected ${truth[i]}`);
  }
}

test("appearance of some anchors alone is that of all", () => {
  for (const { bytes, name } of fixtures()) {
    if (name !== "paper" && name !== "shared") continue;
    const predictor = new Predictor(decode(bytes), KINDS.WebAssembly);
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
