/** WebAssembly where the browser has it, else plain TypeScript. */

import type { Kernels } from "../src/codec/kernels.ts";
import { plainKernels } from "../src/codec/plain_kernels.ts";
import { wasmKernels } from "../src/wasm_kernels.ts";

export async function chooseKernels(): Promise<Kernels> {
  try {
    return await wasmKernels();
  } catch {
    // Without WebAssembly, without its vectors, or where a policy of the page forbids it.
    return plainKernels;
  }
}
