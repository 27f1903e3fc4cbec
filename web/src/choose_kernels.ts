/** WebAssembly where the browser has it, else plain TypeScript. */

import type { Kernels } from "./codec/kernels.ts";
import { plainKernels } from "./codec/plain_kernels.ts";
import { wasmKernels } from "./wasm_kernels.ts";

export async function chooseKernels(): Promise<Kernels> {
  try {
    return await wasmKernels();
  } catch {
    // Without WebAssembly, without its vectors, or where a policy of the page forbids it.
    return plainKernels;
  }
}
