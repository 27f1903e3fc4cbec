/**
 * Builds dist/: the library, the viewer, and one page that has everything within it. Needs only the packages of
 * package-lock.json, and gives the same bytes wherever it runs.
 */

import { mkdir, readFile, writeFile } from "node:fs/promises";
import { build } from "esbuild";

const PAGE = "../src/compgs/viewer/page.html";

const shared = {
  bundle: true,
  format: "esm",
  target: "es2022",
  loader: { ".bin": "binary", ".wasm": "binary" },
  minify: true,
  legalComments: "none",
  charset: "ascii",
  logLevel: "warning",
};

/** The bundled text of a program that is embedded in another. */
async function bundled(entry, options = {}) {
  const { outputFiles } = await build({ ...shared, entryPoints: [entry], format: "iife", write: false, ...options });
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

await build({ ...shared, entryPoints: ["src/index.ts"], outfile: "dist/compgs.js" });
await build({ ...shared, entryPoints: ["viewer/viewer.ts"], outfile: "dist/viewer.js", plugins: [embedWorker] });

const script = await bundled("viewer/page.ts", { plugins: [embedWorker] });
const template = await readFile("viewer/page.html", "utf8");
// A function, as replacement patterns in the script must stay what they are.
const page = template.replace("{{script}}", () => script.trim());
await writeFile("dist/page.html", page);
await mkdir(new URL("../src/compgs/viewer/", import.meta.url), { recursive: true });
await writeFile(new URL(PAGE, import.meta.url), page);
