/** A scene in an element of a page: decodes in a worker, draws with WebGPU or WebGL2, follows mouse, touch and keys. */

import type { Camera } from "../src/cameras.ts";
import { chooseRenderer } from "./choose_renderer.ts";
import { Controls } from "./controls.ts";
import type { FromWorker, SceneInfo, ToWorker } from "./messages.ts";
import { Pose, type Vector, add, dot } from "./pose.ts";
import type { FrameCamera, Renderer, RendererName } from "./renderer.ts";
import workerSource from "compgs:worker";

export interface ViewerOptions {
  /** What must draw; else WebGPU where the browser and its device have it, and WebGL2 elsewhere. */
  renderer?: RendererName;
  /** Bytes of the file so far and of all, the latter if it is known. */
  onProgress?: (loaded: number, total: number | null) => void;
  /** A scene is there, or a finer version of it. */
  onScene?: (info: SceneInfo) => void;
  /** All bytes are there and sound. */
  onComplete?: (bytes: number) => void;
  /** The file is damaged, or cannot be had: what has been shown of it stays. Or nothing can be drawn (CannotDraw). */
  onError?: (name: string, message: string) => void;
}

const MOST_PIXELS_PER_CSS_PIXEL = 2;
const FIELD_OF_VIEW = 0.9; // radians, of the smaller side, for files without viewpoints

export class Viewer {
  readonly controls: Controls;
  /** Holds the canvas, which a lost device takes with it. */
  private readonly stage: HTMLElement;
  private renderer: Renderer | null = null;
  /** The renderer has splats that frames may speak of. */
  private hasSplats = false;
  private readonly worker: Worker;
  private readonly observer: ResizeObserver;
  private info: SceneInfo | null = null;
  private view = 0;
  private eyeId = 0;
  private settledId = -1;
  private waitingToSettle: Array<() => void> = [];
  private isDrawing = false;
  /** A camera that stays until the controls move: its picture has exactly its size. */
  private fixed: Camera | null = null;
  private isTouched = false;
  private isDisposed = false;

  constructor(
    container: HTMLElement,
    private readonly options: ViewerOptions = {},
  ) {
    this.stage = document.createElement("div");
    this.stage.style.cssText = "width:100%;height:100%;outline:none";
    container.append(this.stage);
    this.controls = new Controls(this.stage, () => this.move());
    this.worker = new Worker(URL.createObjectURL(new Blob([workerSource], { type: "text/javascript" })));
    // The file is decoded in the meantime.
    const isReady = this.equip(options.renderer);
    this.worker.onmessage = async ({ data }: MessageEvent<FromWorker>) => {
      if (await isReady) this.receive(data);
    };
    this.worker.onerror = (event) => options.onError?.("Error", event.message);
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(container);
  }

  /** Where the scene is drawn, as soon as it is known what draws; another one after a device was lost. */
  get canvas(): HTMLCanvasElement | null {
    return this.renderer?.canvas ?? null;
  }

  /** Shows a file: its bytes, or the address to stream it from. */
  open(source: ArrayBuffer | Uint8Array | string): void {
    this.info = null;
    this.view = 0;
    this.controls.target = null;
    this.fixed = null;
    this.isTouched = false;
    if (typeof source === "string") {
      this.send({ kind: "url", url: new URL(source, document.baseURI).href });
      return;
    }
    const bytes = source instanceof Uint8Array ? source.slice().buffer : source.slice(0);
    this.send({ kind: "bytes", bytes: bytes as ArrayBuffer }, [bytes]);
  }

  dispose(): void {
    this.worker.terminate();
    this.controls.dispose();
    this.observer.disconnect();
    this.stage.remove();
    this.renderer?.dispose();
    this.renderer = null;
    this.isDisposed = true;
  }

  /** Goes to one of the file's viewpoints, counted from 0 and around. */
  goTo(view: number): void {
    const info = this.info;
    if (!info) return;
    this.fixed = null;
    const count = info.viewpoints?.views.length ?? 1;
    this.view = ((view % count) + count) % count;
    this.controls.target = startOf(info, this.view);
    this.changed();
  }

  nextView(): void {
    this.goTo(this.view + 1);
  }

  /** Shows exactly this camera of the world, in a picture of its size; resolves when it is drawn in full. */
  async show(camera: Camera): Promise<void> {
    this.fixed = camera;
    this.isTouched = true;
    this.resize();
    await this.settled();
  }

  /** Resolves when everything that is drawn is of the camera at hand. */
  settled(): Promise<void> {
    return new Promise((resolve) => {
      this.waitingToSettle.push(resolve);
      this.changed();
    });
  }

  /** Whether there is something now that draws. */
  private async equip(only?: RendererName): Promise<boolean> {
    try {
      const renderer = await chooseRenderer(only);
      if (this.isDisposed) renderer.dispose();
      else this.use(renderer);
      return !this.isDisposed;
    } catch (error) {
      const { name, message } = error as Error;
      this.options.onError?.(name, message);
      return false;
    }
  }

  private use(renderer: Renderer): void {
    renderer.canvas.style.cssText = "display:block;width:100%;height:100%";
    this.stage.replaceChildren(renderer.canvas);
    this.renderer = renderer;
    this.hasSplats = false;
    if (this.info) setScene(renderer, this.info);
    void renderer.lost.then((reason) => {
      if (this.renderer === renderer) void this.replace(renderer, reason);
    });
    this.resize();
  }

  /** WebGL2 takes over from WebGPU, unless that must draw. */
  private async replace(lost: Renderer, reason: string): Promise<void> {
    if (lost.name === "webgl2" || this.options.renderer) {
      const message = `The browser has taken back its graphics memory (${reason}). Load the page again.`;
      this.options.onError?.("Error", message);
      return;
    }
    console.warn(`WebGPU has stopped (${reason}). WebGL2 goes on with the drawing.`);
    if (!(await this.equip("webgl2"))) return;
    lost.dispose();
    this.send({ kind: "again" });
  }

  private move(): void {
    this.fixed = null;
    this.isTouched = true;
    this.resize();
  }

  private send(message: ToWorker, transfer: Transferable[] = []): void {
    this.worker.postMessage(message, transfer);
  }

  private receive(message: FromWorker): void {
    const { options, renderer } = this;
    if (message.kind === "progress") options.onProgress?.(message.loaded, message.total);
    else if (message.kind === "complete") options.onComplete?.(message.bytes);
    else if (message.kind === "error") options.onError?.(message.name, message.message);
    else if (message.kind === "scene") {
      this.info = message.info;
      if (renderer) setScene(renderer, message.info);
      this.controls.target ??= startOf(message.info, this.view);
      if (!this.isTouched) this.goTo(this.view);
      else this.changed();
      options.onScene?.(message.info);
    } else if (!renderer) return;
    else if (message.kind === "geometry") this.setGeometry(renderer, message.planes, message.rows);
    else if (this.hasSplats) {
      if (message.appearance) renderer.setAppearance(message.appearance, message.firstRow);
      renderer.setOrder(message.order);
      if (message.settled) this.settledId = message.id;
      this.draw();
    }
  }

  private setGeometry(renderer: Renderer, planes: Float32Array<ArrayBuffer>, rows: number): void {
    try {
      renderer.setGeometry(planes, rows);
      this.hasSplats = true;
    } catch (error) {
      this.hasSplats = false;
      this.options.onError?.("Error", (error as Error).message);
    }
  }

  private resize(): void {
    const { canvas, fixed, stage } = this;
    if (!canvas) return;
    const ratio = Math.min(devicePixelRatio, MOST_PIXELS_PER_CSS_PIXEL);
    const width = fixed ? fixed.width : Math.max(1, Math.round(stage.clientWidth * ratio));
    const height = fixed ? fixed.height : Math.max(1, Math.round(stage.clientHeight * ratio));
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    this.changed();
  }

  /** The camera has changed: the worker hears of it, and what is there is drawn from it at once. */
  private changed(): void {
    const camera = this.frameCamera();
    if (!camera) return;
    const { rotation: r, translation: t } = camera;
    const along = (column: number): number =>
      -(r[column]! * t[0]! + r[3 + column]! * t[1]! + r[6 + column]! * t[2]!);
    this.eyeId++;
    this.send({
      kind: "eye",
      eye: { id: this.eyeId, centre: [along(0), along(1), along(2)], axis: [r[6]!, r[7]!, r[8]!] },
    });
    this.draw();
  }

  private draw(): void {
    if (this.isDrawing) return;
    this.isDrawing = true;
    requestAnimationFrame(() => {
      this.isDrawing = false;
      const camera = this.frameCamera();
      if (!camera) return;
      this.renderer?.draw(camera);
      if (this.settledId === this.eyeId) for (const resolve of this.waitingToSettle.splice(0)) resolve();
    });
  }

  private frameCamera(): FrameCamera | null {
    const { info, fixed, canvas } = this;
    const target = this.controls.target;
    if (!info || !target || !canvas) return null;
    if (fixed) return inFrame(fixed, info.worldOffset);
    const { width, height } = canvas;
    const lens = info.viewpoints?.views[this.view];
    // The whole of the viewpoint's picture is seen, whatever the shape of the window.
    const focal = lens
      ? Math.min(width / lens.width, height / lens.height)
      : Math.min(width, height) / (2 * Math.tan(FIELD_OF_VIEW / 2));
    return {
      rotation: target.pose.rotation,
      translation: target.pose.translation,
      fx: focal * (lens ? lens.fx : 1),
      fy: focal * (lens ? lens.fy : 1),
      cx: width / 2,
      cy: height / 2,
    };
  }
}

/** Tells a renderer what is not of single splats. */
function setScene(renderer: Renderer, { background, angularDilation }: SceneInfo): void {
  renderer.background = background;
  renderer.angularDilation = angularDilation;
}

/** A camera of the world in the local frame: t + R offset, in 64-bit floats. */
function inFrame({ worldToCamera: m, fx, fy, cx, cy }: Camera, offset: ArrayLike<number>): FrameCamera {
  const rotation = [m[0]!, m[1]!, m[2]!, m[4]!, m[5]!, m[6]!, m[8]!, m[9]!, m[10]!];
  const translation = [0, 1, 2].map((row) => {
    const turned = [0, 1, 2].reduce((sum, column) => sum + rotation[3 * row + column]! * offset[column]!, 0);
    return m[4 * row + 3]! + turned;
  });
  return { rotation, translation, fx, fy, cx, cy };
}

function startOf(info: SceneInfo, view: number): { pose: Pose; up: Vector; distance: number } {
  const { middle, extent, viewpoints } = info;
  const start = viewpoints?.views[view];
  if (viewpoints && start) {
    const pose = Pose.of([...start.position], start.rotation);
    const depth = dot(pose.forward, add(middle, pose.centre, -1));
    return { pose, up: viewpoints.up, distance: Math.max(depth, 0.1 * extent) };
  }
  const up: Vector = [0, -1, 0];
  const distance = (2.5 * extent) / Math.tan(FIELD_OF_VIEW / 2);
  const centre = add(add(middle, [0, 0, -1], distance), up, 0.3 * distance);
  return { pose: Pose.lookingAt(centre, middle, up), up, distance };
}
