/** The kernels of src/codec/kernels.ts in WebAssembly. Tests hold them to golden files and to what the Python package makes. */

export { alloc, mark, release } from "./memory";
export { setTables } from "./mixing";
export { setGrid, walkOctree } from "./octree";
export { decodeMasks } from "./masks";
export { decodeChunk } from "./rans";
export { setRowTables } from "./rows";
export { applyLayer } from "./networks";
export { runCoupled } from "./coupled_mlp";
