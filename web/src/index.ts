/** Decoder of .cgs files: 3D Gaussian scenes in a few kilobytes. */

export { decode, type DecodeOptions } from "./decode.ts";
export type { Scene, SceneGroup } from "./codec/scene_decoder.ts";
export type { Kernels } from "./codec/kernels.ts";
export { plainKernels } from "./codec/plain_kernels.ts";
export { wasmKernels } from "./wasm_kernels.ts";
export type { Viewpoint, Viewpoints } from "./codec/viewpoints.ts";
export * from "./errors.ts";
export { gaussians, type Gaussians } from "./gaussians.ts";
export { Predictor, type Appearance, type Geometry } from "./prediction/predictor.ts";
export { type Camera, cameraCentre, poseOf } from "./cameras.ts";
export { ProgressiveDecoder } from "./progressive.ts";
