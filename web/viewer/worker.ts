/** The worker: decodes a file as it arrives, predicts its splats, and sorts them for the camera at hand. */

import { chooseKernels } from "../src/choose_kernels.ts";
import type { Kernels } from "../src/codec/kernels.ts";
import type { Scene } from "../src/codec/scene_decoder.ts";
import { type Appearance, OPACITY_CUTOFF, Predictor } from "../src/prediction/predictor.ts";
import { ProgressiveDecoder } from "../src/progressive.ts";
import { sceneInfo } from "../src/scene_info.ts";
import { DepthOrder } from "./depth_order.ts";
import { firstView } from "./first_view.ts";
import type { Eye, FromWorker, ToWorker } from "./messages.ts";
import { distanceAlong } from "./pick.ts";
import { appearanceRows, geometryPlanes, rowsOf } from "./splat_planes.ts";
import { NEAR } from "./splatting.ts";

/** Coupled primitives whose opacity and color follow the camera in one frame. */
const PART = 50_000;
/** Bytes by which a file that is no .cgs file is known. */
const HEAD = 16;
const NO_BYTES = new Uint8Array(0);

interface Shown {
  predictor: Predictor;
  appearance: Appearance;
  /** Anchor with which the next part begins, and anchors that have not seen the camera yet. */
  nextAnchor: number;
  remaining: number;
}

declare const self: {
  onmessage: ((event: MessageEvent<ToWorker>) => void) | null;
  postMessage(message: FromWorker, transfer?: Transferable[]): void;
};

const kernels = chooseKernels();
const depthOrder = new DepthOrder();
let shown: Shown | null = null;
let eye: Eye | null = null;
let isStale = false;
let isScheduled = false;
/** Files opened so far: what an earlier one still has to say is dropped. */
let opened = 0;

self.onmessage = ({ data }) => {
  if (data.kind === "bytes") openBytes(data.bytes, data.most);
  else if (data.kind === "url") void openUrl(++opened, data.url, data.most);
  else if (data.kind === "eye") setEye(data.eye);
  else if (data.kind === "pick") pick(data);
  else if (shown) present(shown);
};

function pick({ id, origin, direction, pixel }: Extract<ToWorker, { kind: "pick" }>): void {
  const { predictor, appearance } = shown!;
  const { opacities } = appearance;
  const distance = distanceAlong(origin, direction, pixel, predictor.geometry, opacities, NEAR);
  self.postMessage({ kind: "picked", id, distance });
}

function setEye(next: Eye): void {
  const moved = !eye || next.centre.some((x, axis) => x !== eye!.centre[axis]);
  eye = next;
  isStale = true;
  if (shown && moved) shown.remaining = shown.predictor.primitives.anchors;
  schedule();
}

function openBytes(bytes: ArrayBuffer, most: number): void {
  void open(++opened, streamOf(new Uint8Array(bytes)), bytes.byteLength, most);
}

async function openUrl(ticket: number, url: string, most: number): Promise<void> {
  try {
    const response = await fetch(url).catch((error: Error) => {
      throw new Error(
        `${url} cannot be fetched (${error.message}). Another site must allow it by CORS headers.`,
      );
    });
    if (!response.ok) throw new Error(`${url}: the server answers ${response.status} ${response.statusText}`);
    const length = Number(response.headers.get("Content-Length")) || null;
    await open(ticket, response.body!, response.headers.get("Content-Encoding") ? null : length, most);
  } catch (error) {
    report(ticket, error, NO_BYTES);
  }
}

function streamOf(bytes: Uint8Array): ReadableStream<Uint8Array> {
  return new ReadableStream({
    start(controller) {
      if (bytes.length) controller.enqueue(bytes);
      controller.close();
    },
  });
}

async function open(
  ticket: number,
  stream: ReadableStream<Uint8Array>,
  total: number | null,
  most: number,
): Promise<void> {
  let head = NO_BYTES;
  try {
    const chosen = await kernels;
    const decoder = new ProgressiveDecoder(chosen, most);
    const reader = stream.getReader();
    let loaded = 0;
    for (;;) {
      const { done, value } = await reader.read();
      if (ticket !== opened) return;
      if (done) break;
      if (!loaded) head = value.slice(0, HEAD);
      loaded += value.length;
      const isFiner = decoder.push(value);
      self.postMessage({ kind: "progress", loaded, total: total ?? decoder.expectedBytes });
      if (isFiner) show(decoder.scene(), chosen);
      if (decoder.isFull) {
        void reader.cancel().catch(() => {}); // nothing that is still to come is shown
        break;
      }
    }
    decoder.finish();
    self.postMessage({ kind: "complete", bytes: loaded });
  } catch (error) {
    report(ticket, error, head);
  }
}

function report(ticket: number, error: unknown, head: Uint8Array): void {
  if (ticket !== opened) return;
  const { name, message } = error instanceof Error ? error : new Error(String(error));
  self.postMessage({ kind: "error", name, message, head });
}

function show(scene: Scene, chosen: Kernels): void {
  const predictor = new Predictor(scene, chosen);
  shown = { predictor, appearance: predictor.newAppearance(), nextAnchor: 0, remaining: 0 };
  const info = sceneInfo(scene, predictor);
  const first = firstView(predictor.positions, info.viewpoints, info.extent);
  self.postMessage({ kind: "scene", info, first });
  present(shown);
}

/** Everything that a renderer needs to draw a scene that it has nothing of. */
function present(scene: Shown): void {
  const { geometry, primitives } = scene.predictor;
  scene.nextAnchor = 0;
  scene.remaining = primitives.anchors;
  const planes = geometryPlanes(geometry);
  const rows = rowsOf(geometry.sound.length);
  // Splats take the place of others in full: their first frame comes with them.
  const frame = eye && frameOf(scene, eye, Infinity);
  self.postMessage({ kind: "geometry", planes, rows }, [planes.buffer]);
  if (frame) post(frame);
}

/** One frame at a time, with room for messages in between. */
function schedule(): void {
  if (isScheduled || !shown || !eye || !(isStale || shown.remaining)) return;
  isScheduled = true;
  setTimeout(() => {
    isScheduled = false;
    isStale = false;
    post(frameOf(shown!, eye!, PART));
    schedule();
  }, 0);
}

interface Frame {
  message: FromWorker;
  transfer: Transferable[];
}

/** What is drawn for an eye, after at most `part` more coupled primitives have seen it. */
function frameOf(scene: Shown, { id, centre, axis }: Eye, part: number): Frame {
  const { predictor, appearance } = scene;
  let rows: { values: Float32Array<ArrayBuffer>; firstRow: number } | null = null;
  if (scene.remaining) {
    const { firstCoupled, anchors } = predictor.primitives;
    const first = scene.nextAnchor;
    const most = Math.min(anchors, first + scene.remaining);
    let end = first + 1;
    while (end < most && firstCoupled[end + 1]! - firstCoupled[first]! <= part) end++;
    predictor.predictAppearance(centre, appearance, first, end);
    rows = appearanceRows(appearance, firstCoupled[first]!, firstCoupled[end]!);
    scene.nextAnchor = end % anchors;
    scene.remaining -= end - first;
  }
  const { means, sound } = predictor.geometry;
  const shift = -(axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2]);
  const order = depthOrder.sort(means, appearance.opacities, sound, axis, shift, OPACITY_CUTOFF, NEAR);
  const settled = scene.remaining === 0;
  const [values, firstRow] = rows ? [rows.values, rows.firstRow] : [null, 0];
  return {
    message: { kind: "frame", id, order, appearance: values, firstRow, settled },
    transfer: [order.buffer, ...(values ? [values.buffer] : [])],
  };
}

function post({ message, transfer }: Frame): void {
  self.postMessage(message, transfer);
}
