/** The worker of a live scene: decodes a file as it arrives, and predicts colors for the camera at hand. */

import { type Appearance, Predictor } from "../prediction/predictor.ts";
import { ProgressiveDecoder } from "../progressive.ts";
import { type SceneInfo, sceneInfo } from "../scene_info.ts";
import { piecesOf } from "../sources.ts";
import type { FromWorker, ToWorker } from "./messages.ts";
import { type Layout, PACKERS, packColors } from "./packing.ts";

interface Shown {
  predictor: Predictor;
  appearance: Appearance;
}

declare const self: {
  onmessage: ((event: MessageEvent<ToWorker>) => void) | null;
  postMessage(message: FromWorker, transfer?: Transferable[]): void;
};

let decoder: ProgressiveDecoder | null = null;
let layout: Layout = "arrays";
let shown: Shown | null = null;
let eye: { id: number; centre: [number, number, number] } | null = null;
let loaded = 0;
let hasFailed = false;
/** Messages are taken one after the other, though what each of them does may wait. */
let queue: Promise<void> = Promise.resolve();

self.onmessage = ({ data }) => {
  if (data.kind === "eye") setEye(data.id, data.centre);
  else queue = queue.then(() => answer(data)).catch(report);
};

async function answer(message: Exclude<ToWorker, { kind: "eye" }>): Promise<void> {
  if (hasFailed) return;
  if (message.kind === "piece") await take(message.bytes, null);
  else if (message.kind === "end") finish();
  else {
    layout = message.layout;
    decoder = new ProgressiveDecoder(message.most);
    if (message.url !== null) await openUrl(message.url);
  }
}

async function openUrl(url: string): Promise<void> {
  const response = await fetch(url).catch((error: Error) => {
    throw new Error(
      `${url} cannot be fetched (${error.message}). Another site must allow it by CORS headers.`,
    );
  });
  const length = Number(response.headers.get("Content-Length")) || null;
  const total = response.headers.get("Content-Encoding") ? null : length;
  for await (const piece of piecesOf(response)) {
    await take(piece, total);
    if (decoder!.isFull) break; // which ends the download
  }
  finish();
}

async function take(piece: Uint8Array, total: number | null): Promise<void> {
  loaded += piece.length;
  const isFiner = decoder!.push(piece);
  self.postMessage({ kind: "progress", loaded, total: total ?? decoder!.expectedBytes });
  if (!isFiner) return;
  const scene = decoder!.scene();
  const predictor = new Predictor(scene);
  shown = { predictor, appearance: predictor.newAppearance() };
  show(shown, sceneInfo(scene, predictor));
}

function finish(): void {
  decoder!.finish();
  self.postMessage({ kind: "complete" });
}

function report(error: unknown): void {
  hasFailed = true;
  const { name, message } = error instanceof Error ? error : new Error(String(error));
  self.postMessage({ kind: "error", name, message });
}

function show(scene: Shown, info: SceneInfo): void {
  const geometry = PACKERS[layout](scene.predictor.geometry);
  const colors = colorsFor(scene, eye?.centre ?? startOf(info));
  const values = Object.values(geometry).flat();
  const buffers = values.filter((value) => ArrayBuffer.isView(value)).map(({ buffer }) => buffer);
  self.postMessage({ kind: "splats", info, geometry, colors, eye: eye?.id ?? 0 }, [
    ...(buffers as ArrayBuffer[]),
    colors.buffer,
  ]);
}

function setEye(id: number, centre: [number, number, number]): void {
  eye = { id, centre };
  if (!shown) return;
  const colors = colorsFor(shown, centre);
  self.postMessage({ kind: "colors", colors, eye: id }, [colors.buffer]);
}

/** Where a scene is seen from before anybody has said it. */
function startOf({ viewpoints, middle, extent }: SceneInfo): [number, number, number] {
  return viewpoints?.views[0]?.position ?? [middle[0], middle[1], middle[2] - 4 * extent];
}

function colorsFor({ predictor, appearance }: Shown, centre: ArrayLike<number>): Uint8Array<ArrayBuffer> {
  predictor.predictAppearance(centre, appearance);
  return packColors(appearance, predictor.geometry.sound);
}
