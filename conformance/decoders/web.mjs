/**
 * The decoder for the web in Node, as conformance/run.py asks it: what `npm run build` in web/ makes, or CGS_BUILD names.
 *
 *     python conformance/run.py node conformance/decoders/web.mjs
 */

import { readFileSync, writeFileSync } from "node:fs";
import { join, resolve } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath, pathToFileURL } from "node:url";

const build = process.env.CGS_BUILD ?? fileURLToPath(new URL("../../web/dist", import.meta.url));
const compgs = await import(pathToFileURL(resolve(build, "compgs.js")));
const REFUSALS = ["NotACompGSFile", "UnsupportedVersion", "TruncatedSection", "CorruptSection", "MissingDependency"];
const RESIDUAL = 3;
/** Networks of each layout of the heads, and their blocks. */
const NETWORKS = {
  separate: { translation: 1, covariance: 1, opacity: 1, color: 2 },
  paired: { geometry: 1, appearance: 1 },
  shallow: { geometry: 0, appearance: 0 },
};

const ACTIONS = {
  decode(file, folder, size) {
    const options = size === undefined ? {} : { prefix: Number(size) };
    const scene = compgs.decode(readFileSync(file), options);
    new compgs.Predictor(scene); // refuses heads of another layout
    const write = (name, array) =>
      writeFileSync(join(folder, name), new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
    write("coordinates", scene.coordinates);
    write("mask", scene.mask);
    write("heads", headIntegers(scene));
    scene.groups.forEach((group, i) => {
      write(`symbols${i}`, group.role === RESIDUAL ? scattered(scene, group) : group.symbols);
      write(`latents${i}`, group.latents);
    });
    return "ok";
  },

  predict(file, folder, ...center) {
    const scene = compgs.decode(readFileSync(file));
    const world = center.map((x, axis) => Number(x) + scene.worldOffset[axis]);
    const worldToCamera = [1, 0, 0, -world[0], 0, 1, 0, -world[1], 0, 0, 1, -world[2], 0, 0, 0, 1];
    const found = compgs.gaussians(scene, { worldToCamera });
    const columns = { means: 3, scales: 3, quaternions: 4, opacities: 1, colors: 3 };
    const rows = Float32Array.from({ length: 14 * found.opacities.length });
    let place = 0;
    for (let i = 0; i < found.opacities.length; i++) {
      for (const [field, count] of Object.entries(columns)) {
        rows.set(found[field].subarray(count * i, count * (i + 1)), place);
        place += count;
      }
    }
    writeFileSync(join(folder, "gaussians"), new Uint8Array(rows.buffer));
    return "ok";
  },
};

/** The exponent and the integers of each tensor, in the order of version 5. */
function headIntegers({ heads, tensors }) {
  const names = Object.entries(NETWORKS[heads]).flatMap(([network, blocks]) => [
    ...["input_weight", "input_bias", "output_weight", "output_bias", "skip_weight"].map((t) => `${network}.${t}`),
    ...Array.from({ length: blocks }, (_, b) =>
      ["weight1", "bias1", "weight2", "bias2"].map((t) => `${network}.blocks.${b}.${t}`),
    ).flat(),
  ]);
  const stored = [...names, "residuals"].flatMap((name) => tensors.get(name) ?? []);
  return Int32Array.from(stored.flatMap(({ exponent, values }) => [exponent, ...values]));
}

/** Symbols [N, K, channels], 0 where nothing exists. */
function scattered({ mask }, { symbols, channels }) {
  const all = new Int32Array(mask.length * channels);
  let at = 0;
  mask.forEach((exists, slot) => {
    if (!exists) return;
    all.set(symbols.subarray(at, at + channels), slot * channels);
    at += channels;
  });
  return all;
}

for await (const line of createInterface({ input: process.stdin })) {
  const [action, ...fields] = line.split("\t");
  let answer = "not offered";
  try {
    if (action in ACTIONS) answer = ACTIONS[action](...fields);
  } catch (error) {
    if (!REFUSALS.includes(error.name)) throw error;
    answer = error.name;
  }
  console.log(answer);
}
