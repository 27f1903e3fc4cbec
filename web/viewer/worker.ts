/** The worker: decodes a scene as it arrives, predicts its splats, and sorts them for the camera at hand. */

import type { Scene } from "../src/codec/scene_decoder.ts";
import { Predictor } from "../src/prediction/predictor.ts";
import { ProgressiveDecoder } from "../src/progressive.ts";
import { sceneInfo } from "../src/scene_info.ts";
import { isInView } from "../src/tiles/detail.ts";
import { TileLoader } from "../src/tiles/loader.ts";
import { type Manifest, isManifest, readManifest } from "../src/tiles/manifest.ts";
import { countsOf, sphereCentres, tilesInfo } from "../src/tiles/scene_info.ts";
import { firstView } from "./first_view.ts";
import type { Eye, FromWorker, ToWorker } from "./messages.ts";
import { rowsOf } from "./splat_planes.ts";
import { SplatStore } from "./splat_store.ts";

/** Bytes by which a file that is no .cgs file is known. */
const HEAD = 32;
const NO_BYTES = new Uint8Array(0);
/** Tiles that may begin a row of their own; scenes of more show fewer than that at a time. */
const MOST_PARTS = 2048;

declare const self: {
  onmessage: ((event: MessageEvent<ToWorker>) => void) | null;
  postMessage(message: FromWorker, transfer?: Transferable[]): void;
};

/** Of the scene that is shown. */
let store = newStore();
let tiles: TileLoader | null = null;
let isOfTiles = false;
let eye: Eye | null = null;
/** Files opened so far: what an earlier one still has to say is dropped. */
let opened = 0;

self.onmessage = ({ data }) => {
  if (data.kind === "bytes") openBytes(data.bytes, data.most);
  else if (data.kind === "url") void openUrl(begin(), data.url, data.most);
  else if (data.kind === "eye") look(data.eye);
  else if (data.kind === "pick") pick(data);
  else store.again();
};

function newStore(isSharp?: () => boolean, isSeen?: (tile: number) => boolean): SplatStore {
  return new SplatStore((message, transfer) => self.postMessage(message, transfer), isSharp, isSeen);
}

function pick({ id, origin, direction, pixel }: Extract<ToWorker, { kind: "pick" }>): void {
  self.postMessage({ kind: "picked", id, distance: store.distanceAlong(origin, direction, pixel) });
}

function look(next: Eye): void {
  eye = next;
  tiles?.look(next.sight);
  store.look(next);
}

/** A number for the file that is opened now. */
function begin(): number {
  tiles?.dispose();
  tiles = null;
  return ++opened;
}

function openBytes(bytes: ArrayBuffer, most: number): void {
  void open(begin(), streamOf(new Uint8Array(bytes)), bytes.byteLength, most);
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
    const total = response.headers.get("Content-Encoding") ? null : length;
    await open(ticket, response.body!, total, most, response.url || url);
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

/** `base`: the address that the bytes are of, if they have one. */
async function open(
  ticket: number,
  stream: ReadableStream<Uint8Array>,
  total: number | null,
  most: number,
  base?: string,
): Promise<void> {
  let head = NO_BYTES;
  try {
    const decoder = new ProgressiveDecoder(most);
    const reader = stream.getReader();
    let loaded = 0;
    for (;;) {
      const { done, value } = await reader.read();
      if (ticket !== opened) return;
      if (done) break;
      if (!loaded) {
        head = value.slice(0, HEAD);
        if (base && isManifest(text(value))) {
          const manifest = readManifest(text(await restOf(reader, value)));
          if (ticket === opened) openTiles(ticket, manifest, base, most);
          return;
        }
      }
      loaded += value.length;
      const isFiner = decoder.push(value);
      self.postMessage({ kind: "progress", loaded, total: total ?? decoder.expectedBytes });
      if (isFiner) show(decoder.scene());
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

function text(bytes: Uint8Array): string {
  return new TextDecoder().decode(bytes);
}

async function restOf(
  reader: ReadableStreamDefaultReader<Uint8Array>,
  first: Uint8Array,
): Promise<Uint8Array> {
  const pieces = [first];
  for (let next = await reader.read(); !next.done; next = await reader.read()) pieces.push(next.value);
  return new Uint8Array(await new Blob(pieces as BlobPart[]).arrayBuffer());
}

function report(ticket: number, error: unknown, head: Uint8Array): void {
  if (ticket !== opened) return;
  const { name, message } = error instanceof Error ? error : new Error(String(error));
  self.postMessage({ kind: "error", name, message, head });
}

function show(scene: Scene): void {
  const predictor = new Predictor(scene);
  const info = sceneInfo(scene, predictor);
  const first = firstView(predictor.positions, info.viewpoints, info.extent);
  if (isOfTiles) {
    store = newStore();
    if (eye) store.look(eye);
    isOfTiles = false;
  }
  self.postMessage({ kind: "scene", info, first });
  store.replace(predictor);
}

/** Shows a scene of tiles: at first nothing but where it is, then what the camera needs. */
function openTiles(ticket: number, manifest: Manifest, base: string, most: number): void {
  const levels = new Int32Array(manifest.tiles.length);
  const loader = new TileLoader(manifest, base, {
    most,
    onTile(tile, scene, shift, level) {
      levels[tile] = level;
      if (scene) parts.set(tile, new Predictor(scene), shift);
      else parts.delete(tile);
      self.postMessage({ kind: "counts", ...countsOf(manifest, levels) });
    },
    onProgress() {
      self.postMessage({ kind: "progress", loaded: loader.loaded, total: loader.loaded + loader.missing });
    },
    onSharp() {
      self.postMessage({ kind: "complete", bytes: loader.loaded });
      parts.touch();
    },
    onError: (error) => report(ticket, error, NO_BYTES),
  });
  const parts = newStore(
    () => loader.isSharp,
    (tile) => !eye || isInView(manifest.tiles[tile]!, eye.sight),
  );
  const info = tilesInfo(manifest);
  // Eyes of an earlier scene say nothing about this one.
  eye = null;
  self.postMessage({
    kind: "scene",
    info,
    first: firstView(sphereCentres(manifest), info.viewpoints, info.extent),
  });
  const whole = manifest.tiles.map((tile) => tile.levels.at(-1)!.coupled);
  // Each tile begins a row, and some may be there twice for a moment.
  const spare = Math.min(MOST_PARTS, whole.length) + 2 * rowsOf(Math.max(...whole));
  parts.reserve(rowsOf(Math.min(most, info.totalCoupled)) + spare);
  [store, tiles, isOfTiles] = [parts, loader, true];
}
