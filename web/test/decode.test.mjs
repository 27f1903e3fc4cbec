/** The same integers as the Python package's, of golden files and of those that make_fixtures.py writes. */

import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { test } from "node:test";
import {
  compgs,
  fixtures,
  goldenFiles,
  goldenPrefixes,
  hashesOf,
  library,
  refusedFiles,
} from "./fixtures.mjs";

const { decode } = compgs;

for (const { name, bytes, hashes } of goldenFiles()) {
  test(`golden file ${name} decodes to its pinned integers`, () => {
    assert.deepEqual(hashesOf(decode(bytes)), hashes);
  });
}

for (const { name, bytes, hashes } of goldenPrefixes()) {
  test(`the beginning of golden file ${name} decodes to its pinned integers`, () => {
    assert.deepEqual(hashesOf(decode(bytes, { prefix: true })), hashes);
  });
}

for (const { name, bytes, expected } of fixtures()) {
  test(`symbols and latents of ${name} are those of the Python package`, () => {
    assert.deepEqual(hashesOf(decode(bytes)), expected.hashes);
  });
}

test("damaged files are refused as the Python package refuses them", () => {
  const wrong = [];
  refusedFiles().forEach(({ data, prefix, error, anchors }, i) => {
    let found = null;
    let count = 0;
    try {
      count = decode(Buffer.from(data, "base64"), { prefix }).anchors;
    } catch (thrown) {
      found = thrown.name;
    }
    if (found !== error) wrong.push(`case ${i}: ${found}, expected ${error}`);
    else if (count !== anchors) wrong.push(`case ${i}: ${count} anchors, expected ${anchors}`);
  });
  assert.deepEqual(wrong, []);
});

for (const { name, bytes, expected } of fixtures()) {
  test(`${name}: each prefix is the scene that the Python package decodes of it`, () => {
    for (const [length, { stands_for: standsFor, ...hashes }] of Object.entries(expected.prefixes)) {
      const scene = decode(bytes, { prefix: Number(length) });
      assert.deepEqual(hashesOf(scene), hashes);
      assert.deepEqual([...scene.standsFor], standsFor);
      assert.equal(decode(bytes.subarray(0, Number(length)), { prefix: true }).anchors, scene.anchors);
    }
  });

  test(`${name}: numbers of the scene and viewpoints are those of the Python package`, () => {
    const scene = decode(bytes);
    assert.equal(scene.anchors, expected.anchors);
    assert.equal(scene.coupled, expected.coupled);
    assert.equal(scene.voxelSize, expected.voxel_size);
    assert.deepEqual(scene.worldOffset, expected.world_offset);
    assert.deepEqual(scene.background, expected.background);
    assert.equal(scene.angularDilation, expected.angular_dilation);
    assert.deepEqual(Object.fromEntries(scene.metadata), expected.metadata);
    assert.equal(scene.standsFor, null);
    assertViewpoints(scene.viewpoints, expected.viewpoints);
  });
}

test("without WebAssembly a file is refused, with what the page may do about it", () => {
  const program = `delete globalThis.WebAssembly;
    const { decode } = await import("${library}");
    const { readFileSync } = await import("node:fs");
    try { decode(readFileSync(0)); } catch ({ name, message }) { console.log(name, message); }`;
  const { bytes } = goldenFiles()[0];
  const { stdout } = spawnSync(process.execPath, ["--input-type=module", "-e", program], { input: bytes });
  assert.match(`${stdout}`, /^MissingDependency kernels: .*WebAssembly.*'wasm-unsafe-eval'/);
});

function assertViewpoints(found, expected) {
  if (expected === null) return assert.equal(found, null);
  close(found.up, expected.up, 1e-12);
  assert.equal(found.views.length, expected.views.length);
  found.views.forEach((view, i) => {
    close(view.rotation, expected.views[i].rotation, 1e-12);
    close(view.position, expected.views[i].center, 1e-9);
    assert.deepEqual([view.width, view.height, view.fx, view.fy], expected.views[i].lens);
  });
}

function close(found, expected, tolerance) {
  assert.equal(found.length, expected.length);
  expected.forEach((x, i) =>
    assert.ok(Math.abs(found[i] - x) <= tolerance, `${found} is not near ${expected}`),
  );
}
