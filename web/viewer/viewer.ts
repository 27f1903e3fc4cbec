/** A scene in an element of a page: decodes in a worker, draws with WebGPU or WebGL2, follows mouse, touch and keys. */

import { splatBudget } from "../src/budget.ts";
import type { Camera } from "../src/cameras.ts";
import type { SceneInfo } from "../src/scene_info.ts";
import type { Sight } from "../src/tiles/detail.ts";
import { chooseRenderer } from "./choose_renderer.ts";
import { Controls } from "./controls.ts";
import type { FromWorker, ToWorker } from "./messages.ts";
import type { FirstView } from "./first_view.ts";
import { Pace } from "./pace.ts";
import { type Vector, add, unit } from "./pose.ts";
import type { FrameCamera, Renderer, RendererName } from "./renderer.ts";
import { FIELD_OF_VIEW, startOf } from "./start.ts";
import workerSource from "compgs:worker";

export interface ViewerOptions {
  /** What must draw; else WebGPU where the browser and its device have it, and WebGL2 elsewhere. */
  renderer?: RendererName;
  /** Splats that are wanted: finer parts of a file that would be more are not fetched. By default `splatBudget()`. */
  most?: number;
  /** Bytes of the file so far and of all, the latter if it is known. */
  onProgress?: (loaded: number, total: number | null) => void;
  /** A scene is there, or a finer version of it. */
  onScene?: (info: SceneInfo) => void;
  /** All bytes are there and sound. */
  onComplete?: (bytes: number) => void;
  /** The file is damaged, or cannot be had: what has been shown of it stays. Or nothing can be drawn (CannotDraw). */
  onError?: (name: string, message: string, head?: Uint8Array) => void;
  /** Somebody has moved. */
  onMove?: () => void;
  /** Where keys are listened to: the window, for a page that is nothing but the scene; else the element alone. */
  keys?: HTMLElement | Window;
}

const MOST_PIXELS_PER_CSS_PIXEL = 2;
const REST = 250; // ms without movement, after which the picture becomes sharp
const MOST_CUT = 1.35; // of a viewpoint's picture, by which it is enlarged to fill a window of another shape
const LEAST_LENS = 0.2; // of a focal length, as the scene has it
const MOST_LENS = 5;

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
  private sharpId = -1;
  private waitingToSettle: Array<() => void> = [];
  private isDrawing = false;
  /** A camera that stays until the controls move: its picture has exactly its size. */
  private fixed: Camera | null = null;
  private isTouched = false;
  /** Pictures are smaller while somebody moves and frames take too long. */
  private readonly pace = new Pace();
  private isMoving = false;
  private lastFrame = -Infinity;
  private atRest: ReturnType<typeof setTimeout> | undefined;
  private first: FirstView = { view: 0, isInside: false };
  private lens = 1;
  private ownBackground: [number, number, number] | null = null;
  private picks = new Map<number, (distance: number | null) => void>();
  private pickId = 0;
  private isDisposed = false;

  constructor(
    container: HTMLElement,
    private readonly options: ViewerOptions = {},
  ) {
    this.stage = document.createElement("div");
    this.stage.style.cssText = "width:100%;height:100%;outline:none";
    container.append(this.stage);
    this.controls = new Controls(this.stage, {
      moved: () => this.move(),
      pointed: (x, y) => void this.turnAbout(x, y),
      ...(options.keys ? { keys: options.keys } : {}),
    });
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

  /** Shows a file: its bytes, or the address to stream it from; of a scene of tiles, the address of its manifest. */
  open(source: ArrayBuffer | Uint8Array | string): void {
    this.info = null;
    this.view = 0;
    this.controls.rest();
    this.controls.target = null;
    this.fixed = null;
    this.isTouched = false;
    const most = this.options.most ?? splatBudget();
    if (typeof source === "string") {
      this.send({ kind: "url", url: new URL(source, document.baseURI).href, most });
      return;
    }
    const bytes = source instanceof Uint8Array ? source.slice().buffer : source.slice(0);
    this.send({ kind: "bytes", bytes: bytes as ArrayBuffer, most }, [bytes]);
  }

  dispose(): void {
    this.worker.terminate();
    clearTimeout(this.atRest);
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
    this.lens = 1;
    this.controls.rest();
    this.controls.target = startOf(info, this.view);
    this.resize();
  }

  /** Goes to the viewpoint that has most of the scene in its picture. */
  goToStart(): void {
    this.controls.mode = this.first.isInside ? "fly" : "orbit";
    this.goTo(this.first.view);
  }

  /** Degrees that the smaller side of the picture takes in, from 5 to 150. */
  get fieldOfView(): number {
    const camera = this.frameCamera();
    if (!camera || !this.canvas) return 0;
    const tangent = Math.min(this.canvas.width / camera.fx, this.canvas.height / camera.fy) / 2;
    return (360 / Math.PI) * Math.atan(tangent);
  }

  set fieldOfView(degrees: number) {
    const wanted = Math.tan((Math.PI / 360) * Math.min(Math.max(degrees, 5), 150));
    const now = Math.tan((Math.PI / 360) * this.fieldOfView);
    if (!now) return;
    this.lens = Math.min(Math.max((this.lens * now) / wanted, LEAST_LENS), MOST_LENS);
    this.move();
  }

  /** Red, green, blue behind the scene, display values 0 to 1; null: the scene's own. */
  set background(color: [number, number, number] | null) {
    this.ownBackground = color;
    this.draw();
  }

  /** Turns about what is seen at a place of the element, in CSS pixels; false where nothing is there. */
  async turnAbout(x: number, y: number): Promise<boolean> {
    const { canvas, controls, stage } = this;
    const camera = this.frameCamera();
    if (!camera || !canvas || !controls.target || this.fixed) return false;
    const { pose } = controls.target;
    const column = ((x / stage.clientWidth) * canvas.width - camera.cx) / camera.fx;
    const row = ((y / stage.clientHeight) * canvas.height - camera.cy) / camera.fy;
    const direction = unit(add(add(pose.forward, pose.right, column), pose.down, row));
    const origin: Vector = [...pose.centre];
    const id = ++this.pickId;
    const distance = await new Promise<number | null>((resolve) => {
      this.picks.set(id, resolve);
      this.send({ kind: "pick", id, origin, direction, pixel: 0.5 / camera.fx });
    });
    if (distance === null) return false;
    controls.turnAbout(add(origin, direction, distance));
    return true;
  }

  /** The picture that is shown, as PNG, sharp. */
  async screenshot(): Promise<Blob> {
    await this.settled();
    this.isMoving = false;
    this.fit();
    const camera = this.frameCamera();
    if (!camera || !this.renderer) throw new Error("There is no scene to take a picture of.");
    // Browsers keep what is drawn for the task that has drawn it.
    this.drawNow(this.renderer, camera);
    const { canvas } = this.renderer;
    return new Promise((resolve, reject) => {
      canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The browser gives no picture."))));
    });
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

  /** Resolves when everything that is drawn is of the camera at hand, and of tiles all that it needs is there. */
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
    this.isMoving = true;
    clearTimeout(this.atRest);
    this.atRest = setTimeout(() => this.rest(), REST);
    this.options.onMove?.();
    this.resize();
  }

  /** Nobody moves: the picture becomes sharp. */
  private rest(): void {
    clearTimeout(this.atRest);
    if (this.controls.isBusy) {
      this.atRest = setTimeout(() => this.rest(), REST);
      return;
    }
    this.isMoving = false;
    this.lastFrame = -Infinity;
    this.fit();
    this.draw();
  }

  private send(message: ToWorker, transfer: Transferable[] = []): void {
    this.worker.postMessage(message, transfer);
  }

  private receive(message: FromWorker): void {
    const { options, renderer } = this;
    if (message.kind === "progress") options.onProgress?.(message.loaded, message.total);
    else if (message.kind === "complete") options.onComplete?.(message.bytes);
    else if (message.kind === "error") options.onError?.(message.name, message.message, message.head);
    else if (message.kind === "picked") {
      this.picks.get(message.id)?.(message.distance);
      this.picks.delete(message.id);
    } else if (message.kind === "scene") {
      const isNew = !this.info;
      this.info = message.info;
      this.controls.place = message.info;
      if (renderer) setScene(renderer, message.info);
      if (isNew) this.first = message.first;
      this.controls.target ??= startOf(message.info, this.view);
      if (!this.isTouched && isNew) this.goToStart();
      else if (!this.isTouched) this.goTo(this.view);
      else this.changed();
      options.onScene?.(message.info);
    } else if (message.kind === "counts") {
      if (!this.info) return;
      const { anchors, coupled } = message;
      this.info = { ...this.info, anchors, coupled };
      options.onScene?.(this.info);
    } else if (!renderer) return;
    else if (message.kind === "reserve") this.reserve(renderer, message.rows);
    else if (!this.hasSplats) return;
    else if (message.kind === "geometry") renderer.setGeometry(message.planes, message.rows);
    else if (message.kind === "appearance") renderer.setAppearance(message.values, message.rows);
    else {
      renderer.setOrder(message.order);
      if (message.settled) this.settledId = message.id;
      if (message.sharp) this.sharpId = message.id;
      this.fit();
      this.draw();
    }
  }

  private reserve(renderer: Renderer, rows: number): void {
    try {
      renderer.reserve(rows);
      this.hasSplats = true;
    } catch (error) {
      this.hasSplats = false;
      this.options.onError?.("Error", (error as Error).message);
    }
  }

  private resize(): void {
    if (!this.canvas) return;
    this.fit();
    this.changed();
  }

  /** Gives the picture the size that it has now: less than it could have, while there is no time for more. */
  private fit(): void {
    const { canvas, fixed, stage } = this;
    if (!canvas) return;
    const isUnfinished = this.isMoving || this.settledId !== this.eyeId;
    const share = isUnfinished ? this.pace.share : 1;
    const ratio = share * this.ratio;
    const width = fixed ? fixed.width : Math.max(1, Math.round(stage.clientWidth * ratio));
    const height = fixed ? fixed.height : Math.max(1, Math.round(stage.clientHeight * ratio));
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
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
      eye: {
        id: this.eyeId,
        centre: [along(0), along(1), along(2)],
        axis: [r[6]!, r[7]!, r[8]!],
        sight: this.sightOf(camera, [along(0), along(1), along(2)]),
      },
    });
    this.draw();
  }

  /** What a camera takes in at rest: pictures may be smaller just now. */
  private sightOf({ rotation, fx, fy }: FrameCamera, centre: Vector): Sight {
    const { width, height } = this.canvas!;
    const whole = this.fixed ? width : this.stage.clientWidth * this.ratio;
    const grow = Math.max(1, whole / width);
    return { centre, rotation, width: grow * width, height: grow * height, fx: grow * fx, fy: grow * fy };
  }

  /** Pixels of a sharp picture in a CSS pixel. */
  private get ratio(): number {
    return Math.min(devicePixelRatio, MOST_PIXELS_PER_CSS_PIXEL);
  }

  private draw(): void {
    if (this.isDrawing) return;
    this.isDrawing = true;
    requestAnimationFrame(() => {
      this.isDrawing = false;
      this.keepPace();
      const camera = this.frameCamera();
      if (!camera) return;
      if (this.renderer) this.drawNow(this.renderer, camera);
      if (this.sharpId === this.eyeId) for (const resolve of this.waitingToSettle.splice(0)) resolve();
    });
  }

  private drawNow(renderer: Renderer, camera: FrameCamera): void {
    // Cameras that are asked for show the scene as it is.
    const own = this.fixed ? null : this.ownBackground;
    renderer.background = own ?? this.info?.background ?? [0, 0, 0];
    renderer.draw(camera);
  }

  private keepPace(): void {
    const now = performance.now();
    const passed = now - this.lastFrame;
    this.lastFrame = now;
    if (!this.isMoving || this.fixed || passed === Infinity) return;
    this.pace.took(passed);
    this.fit();
  }

  private frameCamera(): FrameCamera | null {
    const { info, fixed, canvas } = this;
    const target = this.controls.target;
    if (!info || !target || !canvas) return null;
    if (fixed) return inFrame(fixed, info.worldOffset);
    const { width, height } = canvas;
    const lens = info.viewpoints?.views[this.view];
    const focal = lens
      ? fitted(width / lens.width, height / lens.height)
      : Math.min(width, height) / (2 * Math.tan(FIELD_OF_VIEW / 2));
    return {
      rotation: target.pose.rotation,
      translation: target.pose.translation,
      fx: this.lens * focal * (lens ? lens.fx : 1),
      fy: this.lens * focal * (lens ? lens.fy : 1),
      cx: width / 2,
      cy: height / 2,
    };
  }
}

/** How large a viewpoint's picture is in a window of another shape: cut a little, as nothing is known beyond it. */
function fitted(across: number, down: number): number {
  const [whole, full] = [Math.min(across, down), Math.max(across, down)];
  return whole * Math.min(Math.sqrt(full / whole), MOST_CUT);
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
