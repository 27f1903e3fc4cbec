/**
 * node build.mjs [FOLDER]: the library, the viewer, and one page that has everything within it, into FOLDER (dist).
 *
 * Needs only the packages of package-lock.json, and gives the same bytes wherever it runs.
 */

import { readFile, writeFile } from "node:fs/promises";
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

const worker = await bundled("viewer/worker.ts");
const embedWorker = {
  name: "worker",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^compgs:worker$/ }, () => ({ path: "worker", namespace: "embedded" }));
    onLoad({ filter: /.*/, namespace: "embedded" }, () => ({ contents: worker, loader: "text" }));
  },
};

await build({ ...shared, entryPoints: ["src/index.ts"], outfile: `${folder}/compgs.js` });
await build({
  ...shared,
  entryPoints: ["viewer/viewer.ts"],
  outfile: `${folder}/viewer.js`,
  plugins: [embedKernels, embedWorker],
});

const script = await bundled("viewer/page.ts", { plugins: [embedKernels, embedWorker] });
const template = await readFile("viewer/page.html", "utf8");
// A function, as replacement patterns in the script must stay what they are.
await writeFile(
  `${folder}/page.html`,
  template.replace("{{script}}", () => script.trim()),
);
