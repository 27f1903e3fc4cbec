/** WebAssembly where the browser has it, else plain TypeScript. */

import type { Kernels } from "../src/codec/kernels.ts";
import { plainKernels } from "../src/codec/plain_kernels.ts";

export async function chooseKernels(): Promise<Kernels> {
  return plainKernels;
}
