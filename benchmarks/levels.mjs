/**
 * What a page does with a scene of tiles but draw it: node levels.mjs MANIFEST_ADDRESS MOST [plan] < cameras.json
 *
 * Fetches, decodes, predicts and sorts for one camera after the other, as the worker of the viewer does, then moves about
 * the last one. With `plan` nothing is fetched or decoded: bytes and splats alone are counted. Prints JSON; benchmarks/levels.py makes a table of it.
 */

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { fileURLToPath } from "node:url";

const web = fileURLToPath(new URL("../web/", import.meta.url));
const { build } = createRequire(`${web}package.json`)("esbuild");
/** The kernels are those that `make web` has built. */
function setup({ onResolve }) {
  const path = new URL("../web/dist/compgs.js", import.meta.url).href;
  onResolve({ filter: /\/wasm_kernels\.ts$/ }, () => ({ path, external: true }));
}
const modules = ["src/tiles/manifest", "src/tiles/loader", "src/tiles/detail", "src/prediction/predictor"];
const { outputFiles } = await build({
  stdin: {
    contents: [
      ...modules.map((name) => `export * from "./${name}.ts";`),
      'export * from "./viewer/splat_store.ts";',
      'export { rowsOf } from "./viewer/splat_planes.ts";',
    ].join("\n"),
    resolveDir: web,
    loader: "ts",
  },
  bundle: true,
  loader: { ".bin": "binary" },
  format: "esm",
  target: "es2022",
  minify: true,
  write: false,
  plugins: [{ name: "kernels", setup }],
});
const source = Buffer.from(outputFiles[0].text).toString("base64");
const { TileLoader, Predictor, SplatStore, isInView, planDetail, readManifest, rowsOf, sizeOf } = await import(
  `data:text/javascript;base64,${source}`
);

const MOVING = 60; // pictures
const [address, most, plan] = process.argv.slice(2);
const cameras = JSON.parse(readFileSync(0, "utf8"));

const processor = () => {
  const { user, system } = process.cpuUsage();
  return (user + system) / 1e6;
};

let onFrame = () => {};
let sorted = 0;
const began = [performance.now(), processor()];
const text = await (await fetch(address)).text();
const manifest = readManifest(text);
if (plan) {
  console.log(JSON.stringify({ stops: planned() }));
  process.exit(0);
}
const store = new SplatStore(
  (message) => {
    if (message.kind !== "frame") return;
    sorted = message.order.length;
    onFrame(message);
  },
  () => loader.isSharp,
  (tile) => isInView(manifest.tiles[tile], sight),
);
const loader = new TileLoader(manifest, address, {
  most: Number(most),
  onTile(tile, scene, shift) {
    if (scene) store.set(tile, new Predictor(scene), shift);
    else store.delete(tile);
  },
  onSharp: () => store.touch(),
  onError(error) {
    throw error;
  },
});
const whole = manifest.tiles.map(({ levels }) => levels.at(-1).coupled);
const all = whole.reduce((sum, splats) => sum + splats, 0);
store.reserve(rowsOf(Math.min(Number(most), all)) + whole.length + 2 * rowsOf(Math.max(...whole)));

let id = 0;
let sight = cameras[0];
/** Resolves with the first frame of a camera; `isSharp`: with the first that has all it needs. */
function look(next, isSharp) {
  sight = next;
  const eye = { id: ++id, centre: next.centre, axis: next.rotation.slice(6), sight: next };
  return new Promise((resolve) => {
    onFrame = (frame) => {
      if (frame.id === eye.id && (frame.sharp || !isSharp)) resolve();
    };
    loader.look(next);
    store.look(eye);
  });
}

const stops = [];
let [time, used] = began;
for (const camera of cameras) {
  await look(camera, true);
  const [now, spent] = [performance.now(), processor()];
  stops.push({
    seconds: (now - time) / 1000,
    processor: spent - used,
    bytes: text.length + loader.loaded,
    splats: loader.splats,
    sorted,
  });
  [time, used] = [performance.now(), processor()];
}
const last = cameras.at(-1);
for (let i = 0; i < MOVING; i++) {
  const step = 1e-3 * Math.cos(i / 5);
  await look({ ...last, centre: last.centre.map((x, axis) => x + step * last.rotation[axis]) }, false);
}
const moving = { seconds: (performance.now() - time) / 1000, processor: processor() - used, pictures: MOVING };
console.log(JSON.stringify({ stops, moving, memory: process.memoryUsage().rss }));
process.exit(0);

/** Bytes and splats after each camera. */
function planned() {
  const { tiles } = manifest;
  const sizes = tiles.map(sizeOf);
  const loaded = tiles.map(() => 0);
  let kept = new Int32Array(tiles.length);
  return cameras.map((camera) => {
    kept = planDetail(tiles, sizes, camera, Number(most), kept).levels;
    let splats = 0;
    tiles.forEach(({ levels }, i) => {
      if (!kept[i]) return;
      splats += levels[kept[i] - 1].coupled;
      loaded[i] = Math.max(loaded[i], levels[kept[i] - 1].bytes);
    });
    const inView = tiles.filter((tile) => isInView(tile, camera)).length;
    return { bytes: text.length + loaded.reduce((sum, bytes) => sum + bytes, 0), splats, inView };
  });
}
