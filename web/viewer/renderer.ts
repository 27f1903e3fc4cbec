/** What a renderer does, with WebGPU (webgpu_renderer.ts) or WebGL2 (webgl2_renderer.ts); the picture is the same. */

export type RendererName = "webgpu" | "webgl2";

/** A camera in the local frame of the scene, for a picture in pixels. */
export interface FrameCamera {
  /** 9 numbers, row by row: x_camera = R x + t */
  rotation: ArrayLike<number>;
  translation: ArrayLike<number>;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
}

/** Keeps splats on the graphics device and draws them on a canvas of its own, of whatever size that has. */
export interface Renderer {
  readonly name: RendererName;
  readonly canvas: HTMLCanvasElement;
  /** Why nothing can be drawn any more, once that is so. */
  readonly lost: Promise<string>;
  /** Red, green, blue; display values 0 to 1 */
  background: [number, number, number];
  /** As the scene has it. */
  angularDilation: number | null;
  /** Room for so many rows of 2048 primitives, of which none is drawn yet. */
  reserve(rows: number): void;
  /** Of some rows, one after the other: means, then upper and lower parts of covariances, 4 floats each. */
  setGeometry(planes: Float32Array<ArrayBuffer>, rows: readonly number[]): void;
  /** Colors and opacities of some rows, one after the other. */
  setAppearance(values: Float32Array<ArrayBuffer>, rows: readonly number[]): void;
  /** Which primitives are drawn, the farthest first. */
  setOrder(order: Uint32Array<ArrayBuffer>): void;
  draw(camera: FrameCamera): void;
  /** Gives back what it holds; `lost` may tell of that. */
  dispose(): void;
}

/** Rows that lie one after the other, as one: the first of them, how many, and where they begin in the list. */
export function* runsOf(rows: readonly number[]): Generator<{ first: number; count: number; at: number }> {
  for (let at = 0; at < rows.length;) {
    let count = 1;
    while (rows[at + count] === rows[at]! + count) count++;
    yield { first: rows[at]!, count, at };
    at += count;
  }
}

/** The browser or its device cannot draw. */
export class CannotDraw extends Error {
  override name = "CannotDraw";
}

export function tooManySplats(most: number): Error {
  const splats = most.toLocaleString("en");
  return new Error(`The scene has more splats than the ${splats} that this device's graphics can hold.`);
}
