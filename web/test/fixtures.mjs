/** Files to decode, and what the Python package decodes of them. */

import { createHash } from "node:crypto";
import { existsSync, readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath, pathToFileURL } from "node:url";

/** The library as it was built: into CGS_BUILD, or dist. */
const built = process.env.CGS_BUILD ?? fileURLToPath(new URL("../dist", import.meta.url));
export const library = pathToFileURL(join(built, "compgs.js"));
export const compgs = await import(library);

const GOLDEN = fileURLToPath(new URL("../../tests/golden", import.meta.url));
/** Made by make_fixtures.py; without it only the golden files are looked at. */
export const FIXTURES = process.env.CGS_FIXTURES ?? "";
const VERSIONS = [2, 3, 4, 5];
const ROLES = ["side", "reference", "log scales", "residual"];

/** Networks of the prediction heads, and how many blocks each has. */
const HEADS = {
  separate: [
    ["translation", 1],
    ["covariance", 1],
    ["opacity", 1],
    ["color", 2],
  ],
  paired: [
    ["geometry", 1],
    ["appearance", 1],
  ],
  shallow: [
    ["geometry", 0],
    ["appearance", 0],
  ],
};
const OUTER = ["input_weight", "input_bias", "output_weight", "output_bias", "skip_weight"];

/** [name, bytes, hashes] of the golden files of the versions that are read. */
export function goldenFiles() {
  const pinned = JSON.parse(readFileSync(join(GOLDEN, "hashes.json"), "utf8"));
  return Object.entries(pinned)
    .map(([name, hashes]) => {
      const { file: _, ...arrays } = hashes;
      return { name, bytes: readFileSync(join(GOLDEN, `${name}.cgs`)), hashes: arrays };
    })
    .filter(({ bytes }) => VERSIONS.includes(bytes[4]));
}

/** {name, bytes, hashes} of beginnings of golden files. */
export function goldenPrefixes() {
  const pinned = JSON.parse(readFileSync(join(GOLDEN, "prefixes.json"), "utf8"));
  return Object.entries(pinned).flatMap(([name, sizes]) => {
    const file = readFileSync(join(GOLDEN, `${name}.cgs`));
    return Object.entries(sizes).map(([size, hashes]) => ({
      name: `${name}, ${size} bytes`,
      bytes: file.subarray(0, Number(size)),
      hashes,
    }));
  });
}

/** [name, bytes, pinned] of what a camera sees of the golden files. */
export function goldenGaussians() {
  const path = join(GOLDEN, "gaussians.json");
  if (!existsSync(path)) return [];
  const pinned = JSON.parse(readFileSync(path, "utf8"));
  return goldenFiles()
    .filter(({ name }) => name in pinned)
    .map(({ name, bytes }) => ({ name, bytes, pinned: pinned[name] }));
}

export function fixtures() {
  if (!FIXTURES) return [];
  return readdirSync(FIXTURES)
    .filter((file) => file.endsWith(".cgs"))
    .map((file) => {
      const path = join(FIXTURES, file.slice(0, -4));
      return {
        name: file.slice(0, -4),
        bytes: readFileSync(`${path}.cgs`),
        expected: JSON.parse(readFileSync(`${path}.json`, "utf8")),
        arrays: readFileSync(`${path}.bin`),
      };
    });
}

export function refusedFiles() {
  const path = join(FIXTURES, "refused.json");
  return FIXTURES && existsSync(path) ? JSON.parse(readFileSync(path, "utf8")) : [];
}

/** SHA-256 of each array, under the names of tests/golden/hashes.json. */
export function hashesOf(scene) {
  const hashes = {
    coordinates: sha256(scene.coordinates),
    mask: sha256(scene.mask),
    heads: sha256(headIntegers(scene)),
  };
  scene.groups.forEach((group, i) => {
    const name = `group ${i}, ${ROLES[group.role]}`;
    hashes[`${name}: symbols`] = sha256(group.role === 3 ? scattered(scene, group) : group.symbols);
    hashes[`${name}: latents`] = sha256(group.latents);
  });
  return hashes;
}

/** The exponent and the integers of each tensor, in the order of version 5. */
function headIntegers({ heads, tensors }) {
  const names = HEADS[heads].flatMap(([network, blocks]) => {
    const inner = Array.from({ length: blocks }, (_, b) =>
      ["weight1", "bias1", "weight2", "bias2"].map((tensor) => `blocks.${b}.${tensor}`),
    ).flat();
    return [...OUTER, ...inner].map((tensor) => `${network}.${tensor}`);
  });
  const stored = [...names, "residuals"].flatMap((name) => tensors.get(name) ?? []);
  return Int32Array.from(stored.flatMap(({ exponent, values }) => [exponent, ...values]));
}

function sha256(array) {
  return createHash("sha256")
    .update(new Uint8Array(array.buffer, array.byteOffset, array.byteLength))
    .digest("hex");
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
