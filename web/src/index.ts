/** Decoder of .cgs files: 3D Gaussian scenes in a few kilobytes. */

export { decode, type DecodeOptions, type StreamOptions } from "./decode.ts";
export type { DecodedScene } from "./decoded_scene.ts";
export { type ByteStream, MEDIA_TYPE, type Source, isCgs } from "./sources.ts";
export type { Scene, SceneGroup } from "./codec/scene_decoder.ts";
export type { Kernels } from "./codec/kernels.ts";
export { wasmKernels } from "./wasm_kernels.ts";
export type { Viewpoint, Viewpoints } from "./codec/viewpoints.ts";
export * from "./errors.ts";
export { gaussians, type Gaussians } from "./gaussians.ts";
export { Predictor, type Appearance, type Geometry } from "./prediction/predictor.ts";
export { type Camera, cameraCentre, poseOf } from "./cameras.ts";
export { ProgressiveDecoder } from "./progressive.ts";
export { type SceneInfo, sceneInfo } from "./scene_info.ts";
export { splatBudget } from "./budget.ts";
export { type Plan, type Sight, type Step, planDetail, sizeOf } from "./tiles/detail.ts";
export { TileLoader, type TileLoaderOptions } from "./tiles/loader.ts";
export { type Manifest, type TileEntry, type TileLevel, isManifest, readManifest } from "./tiles/manifest.ts";
