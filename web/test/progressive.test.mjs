/** Files that arrive in pieces are the same scenes, and are refused for the same reasons. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { compgs, goldenFiles, hashesOf, refusedFiles } from "./fixtures.mjs";

const { ProgressiveDecoder, decode } = compgs;

function pieces(bytes, size) {
  const all = [];
  for (let at = 0; at < bytes.length; at += size) all.push(bytes.subarray(at, at + size));
  return all;
}

for (const { name, bytes, hashes } of goldenFiles()) {
  test(`${name}: whatever the pieces, each finer scene is that of the prefix, and the last one the file's`, () => {
    for (const size of [1, 97, bytes.length]) {
      const decoder = new ProgressiveDecoder();
      let arrived = 0;
      for (const piece of pieces(bytes, size)) {
        arrived += piece.length;
        if (!decoder.push(piece)) continue;
        const expected = decode(bytes, { prefix: arrived });
        assert.deepEqual(hashesOf(decoder.scene()), hashesOf(expected));
        assert.deepEqual(decoder.scene().standsFor, expected.standsFor);
        assert.equal(decoder.scene().angularDilation, expected.angularDilation);
      }
      decoder.finish();
      assert.equal(decoder.expectedBytes, bytes.length);
      assert.deepEqual(hashesOf(decoder.scene()), hashes);
    }
  });

  test(`${name}: a file that ends early is refused at its end, and not before`, () => {
    for (const length of [0, 3, 6, 20, bytes.length - 1]) {
      const decoder = new ProgressiveDecoder();
      decoder.push(bytes.subarray(0, length));
      assert.throws(() => decoder.finish(), { name: "TruncatedSection" });
    }
  });

  test(`${name}: bytes behind the last section are refused`, () => {
    const decoder = new ProgressiveDecoder();
    decoder.push(bytes);
    decoder.push(new Uint8Array(1));
    assert.throws(() => decoder.finish(), { name: "CorruptSection" });
  });
}

test("damaged files are refused in pieces, too", () => {
  for (const { data, prefix, error } of refusedFiles()) {
    if (prefix) continue;
    const refuse = () => {
      const decoder = new ProgressiveDecoder();
      for (const piece of pieces(Buffer.from(data, "base64"), 1000)) decoder.push(piece);
      decoder.finish();
    };
    // Which of several faults is found first may differ: a damaged section may come before the end that is missing.
    if (error === null) refuse();
    else assert.throws(refuse, (thrown) => thrown instanceof compgs.BitstreamError);
  }
});

test("of a file with more primitives than are wanted, its last range that is not too much is decoded", () => {
  const { bytes, hashes } = goldenFiles().find(({ name }) => name === "default");
  const [coarse, middle, whole] = decode(bytes).ranges.map(({ coupled }) => coupled);
  for (const [most, expected] of [
    [1, coarse],
    [coarse + middle - 1, coarse],
    [coarse + middle, coarse + middle],
    [coarse + middle + whole - 1, coarse + middle],
  ]) {
    const decoder = new ProgressiveDecoder(most);
    let [needed, used] = [0, 0];
    for (const piece of pieces(bytes, 50)) {
      if (decoder.isFull) break;
      needed += piece.length;
      if (decoder.push(piece)) used = needed;
    }
    decoder.finish();
    assert.equal(decoder.scene().coupled, expected);
    assert.ok(needed - used <= 50); // of the range that is too much only its beginning is read
    assert.deepEqual(hashesOf(decoder.scene()), hashesOf(decode(bytes, { prefix: used })));
    assert.equal(decoder.push(bytes.subarray(needed)), false);
  }
  const decoder = new ProgressiveDecoder(coarse + middle + whole);
  decoder.push(bytes);
  decoder.finish();
  assert.deepEqual(hashesOf(decoder.scene()), hashes);
});
