/** Builds dist/: the library as one module. Needs only the packages of package-lock.json. */

import { build } from "esbuild";

const shared = {
  bundle: true,
  format: "esm",
  target: "es2022",
  loader: { ".bin": "binary", ".wasm": "binary" },
  minify: true,
  legalComments: "none",
  logLevel: "warning",
};

await build({ ...shared, entryPoints: ["src/index.ts"], outfile: "dist/compgs.js" });
