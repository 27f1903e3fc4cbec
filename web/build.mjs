/**
 * node build.mjs [FOLDER]: the library, the viewer, and one page that has everything within it, into FOLDER (dist).
 *
 * Needs only the packages of package-lock.json, and gives the same bytes wherever it runs.
 */

import { readFile, rm, writeFile } from "node:fs/promises";
import { resolve } from "node:path";
import { fileURLToPath } from "node:url";
import asc from "assemblyscript/asc";
import { build } from "esbuild";

const folder = resolve(process.argv[2] ?? "dist");
process.chdir(fileURLToPath(new URL(".", import.meta.url)));

/** assembly/ as a WebAssembly module. */
async function compiledKernels() {
  const flags = ["-O3", "--noAssert", "--runtime", "stub", "--enable", "simd", "--outFile", "kernels.wasm"];
  let binary;
  const { error, stderr } = await asc.main(["assembly/index.ts", ...flags], {
    writeFile(_, contents) {
      binary = contents;
    },
  });
  if (error) throw new Error(`${error.message}: ${stderr}`);
  return binary;
}

const kernels = await compiledKernels();
const embedKernels = {
  name: "kernels",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^compgs:kernels$/ }, () => ({ path: "kernels", namespace: "kernels" }));
    onLoad({ filter: /.*/, namespace: "kernels" }, () => ({ contents: kernels, loader: "binary" }));
  },
};

const shared = {
  bundle: true,
  format: "esm",
  target: "es2022",
  loader: { ".bin": "binary" },
  plugins: [embedKernels],
  minify: true,
  legalComments: "none",
  charset: "ascii",
  logLevel: "warning",
};

/** The bundled text of a program that is embedded in another. */
async function bundled(entry, options = {}) {
  const { outputFiles } = await build({
    ...shared,
    entryPoints: [entry],
    format: "iife",
    write: false,
    ...options,
  });
  return outputFiles[0].text;
}

/** Makes the bundled text of a program a module of the name that it is imported by. */
async function embedded(name, entry) {
  const contents = await bundled(entry);
  return {
    name,
    setup({ onResolve, onLoad }) {
      onResolve({ filter: new RegExp(`^${name}$`) }, () => ({ path: name, namespace: name }));
      onLoad({ filter: /.*/, namespace: name }, () => ({ contents, loader: "text" }));
    },
  };
}

const embedWorker = await embedded("compgs:worker", "viewer/worker.ts");
const embedLiveWorker = await embedded("compgs:live-worker", "src/live/worker.ts");
const embedSorter = await embedded("compgs:sorter", "engines/three_sorter.ts");

// Modules of one package: what several of them have is in a file that they share. Those of earlier builds have other names.
await rm(`${folder}/parts`, { recursive: true, force: true });
await build({
  ...shared,
  entryPoints: {
    compgs: "src/index.ts",
    viewer: "viewer/viewer.ts",
    live: "src/live/index.ts",
    spark: "engines/spark.ts",
    three: "engines/three.ts",
    playcanvas: "engines/playcanvas.ts",
  },
  outdir: folder,
  splitting: true,
  chunkNames: "parts/[hash]",
  plugins: [embedKernels, embedWorker, embedLiveWorker, embedSorter],
  external: ["three", "@sparkjsdev/spark", "playcanvas"],
});
await build({
  ...shared,
  entryPoints: { worker: "src/live/worker.ts", sorter: "engines/three_sorter.ts" },
  outdir: folder,
  format: "iife",
});

const script = await bundled("viewer/page.ts", { plugins: [embedKernels, embedWorker] });
const template = await readFile("viewer/page.html", "utf8");
// A function, as replacement patterns in the script must stay what they are.
await writeFile(
  `${folder}/page.html`,
  template.replace("{{script}}", () => script.trim()),
);
