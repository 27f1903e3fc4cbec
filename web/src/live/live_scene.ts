/** A scene that is decoded in a worker while its bytes arrive, and whose colors follow a camera. */

import * as errors from "../errors.ts";
import { splatBudget } from "../budget.ts";
import type { SceneInfo } from "../scene_info.ts";
import { type Source, piecesOf } from "../sources.ts";
import workerSource from "compgs:live-worker";
import type { FromWorker, ToWorker } from "./messages.ts";
import type { Layout, Layouts } from "./packing.ts";

/** Scenes of so many coupled primitives and fewer follow each movement; a core predicts them within a frame or two. */
const SMALL = 60_000;
/** Larger ones follow when the camera has moved by this share of their extent, or stands still. */
const STEP = 0.01;

export interface Splats<L extends Layout = Layout> {
  info: SceneInfo;
  geometry: Layouts[L];
  /** [P, 4] bytes: red, green, blue, opacity */
  colors: Uint8Array<ArrayBuffer>;
}

export interface LiveSceneOptions<L extends Layout = Layout> {
  layout: L;
  /** A scene is there, or a finer one, which takes the place of the one before. */
  onSplats: (splats: Splats<L>) => void;
  /** Colors and opacities of all splats, seen from where `follow` said. */
  onColors: (colors: Uint8Array<ArrayBuffer>) => void;
  /** Bytes of the file so far and of all, the latter if it is known. */
  onProgress?: (loaded: number, total: number | null) => void;
  /** Splats that are wanted: finer parts of the file that would be more are not fetched. By default `splatBudget()`. */
  most?: number;
  /** Of `compgs/worker`, for pages whose policy forbids workers from blobs. */
  worker?: Worker;
}

export class LiveScene<L extends Layout = Layout> {
  /** Resolves with the first scene, however coarse, after `onSplats`; rejects if there is none. */
  readonly first: Promise<SceneInfo>;
  /**
   * Resolves when all bytes that are wanted are there and sound; rejects if they are not: what was shown of them may
   * stay.
   */
  readonly complete: Promise<SceneInfo>;
  /** Of what is there so far. */
  info: SceneInfo | null = null;
  private readonly worker: Worker;
  private id = 0;
  /** What colors were last asked for, and for what they last came. */
  private asked: [number, number, number] | null = null;
  private arrivedId = 0;
  private before: [number, number, number] | null = null;
  private resolveFirst!: (info: SceneInfo) => void;
  private resolveComplete!: (info: SceneInfo) => void;
  private fail!: (error: Error) => void;

  constructor(
    source: Source,
    private readonly options: LiveSceneOptions<L>,
  ) {
    const rejecters: Array<(error: Error) => void> = [];
    this.first = new Promise((resolve, reject) => {
      this.resolveFirst = resolve;
      rejecters.push(reject);
    });
    this.complete = new Promise((resolve, reject) => {
      this.resolveComplete = resolve;
      rejecters.push(reject);
    });
    // Who waits for one of them must not answer for the other.
    for (const promise of [this.first, this.complete]) promise.catch(() => {});
    this.fail = (error) => rejecters.forEach((reject) => reject(error));
    this.worker = options.worker ?? inlineWorker();
    this.worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.receive(data);
    this.worker.onerror = (event) => this.fail(new Error(event.message || "the worker cannot be started"));
    void this.send(source).catch(this.fail);
  }

  /**
   * Says where the scene is seen from (local frame: world minus `info.worldOffset`). To be called with each picture:
   * small scenes follow each movement, larger ones when it was large enough, and when it has ended. One prediction runs
   * at a time. Colors do not depend on where the camera looks.
   */
  follow(centre: ArrayLike<number>): void {
    const now: [number, number, number] = [centre[0]!, centre[1]!, centre[2]!];
    const stands = isSame(now, this.before);
    this.before = now;
    if (this.arrivedId !== this.id || isSame(now, this.asked) || !now.every(Number.isFinite)) return;
    if (this.asked && this.info && !stands && this.info.coupled > SMALL) {
      const moved = Math.hypot(...now.map((x, axis) => x - this.asked![axis]!));
      if (moved < STEP * this.info.extent) return;
    }
    this.asked = now;
    this.id++;
    this.post({ kind: "eye", id: this.id, centre: now });
  }

  /** Whether the colors are those of where `follow` last said. */
  get isSettled(): boolean {
    return this.info !== null && this.arrivedId === this.id && isSame(this.before, this.asked);
  }

  dispose(): void {
    this.worker.terminate();
    this.fail(new Error("the scene was disposed of"));
  }

  private async send(source: Source): Promise<void> {
    const { layout, most = splatBudget() } = this.options;
    if (typeof source === "string" || source instanceof URL) {
      const { href } = new URL(source, globalThis.document?.baseURI);
      this.post({ kind: "open", layout, most, url: href });
      return;
    }
    this.post({ kind: "open", layout, most, url: null });
    if (source instanceof ArrayBuffer) this.sendPiece(new Uint8Array(source.slice(0)));
    else if (source instanceof Uint8Array) this.sendPiece(source.slice());
    else for await (const piece of piecesOf(source)) this.sendPiece(piece.slice());
    this.post({ kind: "end" });
  }

  /** Of an array of which nobody else has a part: it is gone afterwards. */
  private sendPiece(bytes: Uint8Array<ArrayBuffer>): void {
    this.post({ kind: "piece", bytes }, [bytes.buffer]);
  }

  private post(message: ToWorker, transfer: Transferable[] = []): void {
    this.worker.postMessage(message, transfer);
  }

  private receive(message: FromWorker): void {
    const { onSplats, onColors, onProgress } = this.options;
    if (message.kind === "progress") onProgress?.(message.loaded, message.total);
    else if (message.kind === "complete") this.resolveComplete(this.info!);
    else if (message.kind === "error") this.fail(errorOf(message));
    else {
      this.arrivedId = message.eye;
      if (message.kind === "colors") onColors(message.colors);
      else {
        this.info = message.info;
        onSplats({ info: message.info, geometry: message.geometry as Layouts[L], colors: message.colors });
        this.resolveFirst(message.info);
      }
    }
  }
}

/** One address for the workers of all scenes. */
let workerUrl: string | null = null;

function inlineWorker(): Worker {
  workerUrl ??= URL.createObjectURL(new Blob([workerSource], { type: "text/javascript" }));
  return new Worker(workerUrl);
}

function isSame(a: ArrayLike<number> | null, b: ArrayLike<number> | null): boolean {
  return a !== null && b !== null && [0, 1, 2].every((axis) => a[axis] === b[axis]);
}

/** Errors lose their class on the way out of a worker. */
function errorOf({ name, message }: { name: string; message: string }): Error {
  const known = (errors as Record<string, typeof errors.BitstreamError | undefined>)[name];
  return known ? new known(message) : new Error(message);
}
