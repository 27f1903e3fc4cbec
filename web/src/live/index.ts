/** Scenes that are decoded in a worker while their bytes arrive, for renderers of any kind. */

export { type LiveSceneOptions, LiveScene, type Splats } from "./live_scene.ts";
export type { Layout, Layouts } from "./packing.ts";
export type { SceneInfo } from "../scene_info.ts";
export { type Source, MEDIA_TYPE, isCgs } from "../sources.ts";
export { splatBudget } from "../budget.ts";
