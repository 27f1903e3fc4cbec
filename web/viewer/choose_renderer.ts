/** WebGPU where the browser and its device have it, else WebGL2. */

import { CannotDraw, type Renderer, type RendererName } from "./renderer.ts";
import { WebGL2Renderer } from "./webgl2_renderer.ts";
import { WebGPURenderer } from "./webgpu_renderer.ts";

/** A browser that has not come up with WebGPU by then, in ms, draws with WebGL2. */
const PATIENCE = 2000;

/** `only`: the one that is to be had, or none. Throws CannotDraw. */
export async function chooseRenderer(only?: RendererName): Promise<Renderer> {
  if (only) {
    return create(only).catch((error: Error) => {
      throw new CannotDraw(`The viewer was asked to draw with ${only}, but ${error.message}.`);
    });
  }
  const coming = create("webgpu");
  const first = await within(PATIENCE, coming).catch((error: Error) => error);
  if (!(first instanceof Error)) return first;
  // It may still come, too late.
  coming.then(
    (renderer) => renderer.dispose(),
    () => {},
  );
  const second = await create("webgl2").catch((error: Error) => error);
  if (second instanceof Error)
    throw new CannotDraw(`The viewer draws with WebGPU or WebGL2: ${first.message}, and ${second.message}.`);
  console.info(`Drawing with WebGL2: ${first.message}.`);
  return second;
}

async function create(name: RendererName): Promise<Renderer> {
  return name === "webgpu" ? WebGPURenderer.create() : new WebGL2Renderer();
}

function within<T>(milliseconds: number, coming: Promise<T>): Promise<T> {
  const late = new Promise<never>((_, reject) => {
    setTimeout(() => reject(new Error("WebGPU takes too long to start")), milliseconds);
  });
  return Promise.race([coming, late]);
}
