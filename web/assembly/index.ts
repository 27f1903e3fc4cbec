/**
 * The kernels of src/codec/kernels.ts and src/prediction in WebAssembly; the plain TypeScript is what they must equal.
 */

export { alloc, mark, release } from "./memory";
export { setTables } from "./mixing";
export { setGrid, walkOctree } from "./octree";
export { decodeMasks } from "./masks";
export { decodeChunk } from "./rans";
export { setRowTables } from "./rows";
export { applyLayer } from "./networks";
export { runCoupled } from "./coupled_mlp";
