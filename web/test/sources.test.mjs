/** Files from streams, what cameras see of them, and how files are known by their names. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { compgs, goldenFiles, hashesOf } from "./fixtures.mjs";

const { decode, gaussians, isCgs, poseOf } = compgs;
const camera = { worldToCamera: poseOf([1, 0, 0, 0], [0.5, -1, -8]) };

function streamOf(bytes, size) {
  let at = 0;
  return new ReadableStream({
    pull(controller) {
      if (at >= bytes.length) controller.close();
      else controller.enqueue(bytes.subarray(at, (at += size)));
    },
  });
}

for (const { name, bytes, hashes } of goldenFiles()) {
  test(`${name}: a stream, a response and a blob are the same scene as the bytes`, async () => {
    for (const source of [streamOf(bytes, 1000), new Response(bytes), new Blob([bytes])]) {
      const anchors = [];
      const scene = await decode(source, { onScene: (coarse) => anchors.push(coarse.anchors) });
      assert.deepEqual(hashesOf(scene), hashes);
      assert.equal(anchors.at(-1), scene.anchors);
      assert.deepEqual(
        anchors,
        anchors.toSorted((a, b) => a - b),
      );
    }
  });

  test(`${name}: a scene has the splats that a camera sees, with each call`, () => {
    const scene = decode(bytes);
    const expected = gaussians(scene, camera);
    for (let i = 0; i < 2; i++) assert.deepEqual(scene.splatsFor(camera), expected);
  });
}

test("what is wrong with a stream rejects the promise, with the error of the bytes", async () => {
  const { bytes } = goldenFiles()[0];
  await assert.rejects(decode(streamOf(bytes.subarray(0, 500), 100)), { name: "TruncatedSection" });
  await assert.rejects(decode(new Blob(["a text that is no file"])), { name: "NotACompGSFile" });
  await assert.rejects(decode(new Response("", { status: 404 })), /404/);
});

test("a stream whose bytes are damaged is not read further", async () => {
  let isCancelled = false;
  const endless = new ReadableStream({
    pull: (controller) => controller.enqueue(new Uint8Array(100)),
    cancel: () => (isCancelled = true),
  });
  await assert.rejects(decode(endless), { name: "NotACompGSFile" });
  assert.ok(isCancelled);
});

test("files are known by their ending or their media type", () => {
  for (const name of ["a.cgs", "https://x.org/a.CGS?b=c.ply", "a.cgs#1", "data:model/vnd.compgs;base64,"]) {
    assert.ok(isCgs(name), name);
  }
  for (const name of ["a.cgsx", "cgs", "a.cgs.ply", "data:model/gltf-binary;base64,"])
    assert.ok(!isCgs(name), name);
  assert.ok(isCgs("blob:x", "model/vnd.compgs; charset=binary"));
  assert.ok(!isCgs("blob:x", "application/octet-stream"));
});
