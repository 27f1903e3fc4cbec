/**
 * A scene of tiles as fine as the camera at hand needs it: each step of the plan that is not there is fetched, decoded
 * and shown, the coarsest tile first. No byte is asked for twice; what is not shown keeps its bytes, which are few.
 */

import type { Scene } from "../codec/scene_decoder.ts";
import { CorruptSection, TruncatedSection } from "../errors.ts";
import { ProgressiveDecoder } from "../progressive.ts";
import { type Plan, type Sight, planDetail, sizeOf } from "./detail.ts";
import type { Manifest, TileEntry } from "./manifest.ts";

/** Requests at a time: as many as browsers send to one server. */
const MOST_REQUESTS = 6;
/** A request takes so many levels of a tile that it becomes half as coarse: fewer would be many requests. */
const FINER = 1 / 2;
/** Of requests that fail, and milliseconds until the next, which double. */
const MOST_TRIES = 3;
const PAUSE = 500;

export interface TileLoaderOptions {
  /** Splats of all tiles together. */
  most: number;
  /**
   * A tile is there in so many levels, finer or coarser than before, or no longer (null). `shift`: from its frame to
   * the manifest's.
   */
  onTile: (tile: number, scene: Scene | null, shift: [number, number, number], levels: number) => void;
  /** More bytes are there, or others are wanted. */
  onProgress?: () => void;
  /** Everything that the camera needs is there. */
  onSharp?: () => void;
  /** A tile is damaged, or cannot be had: what is there of it stays. */
  onError?: (error: unknown) => void;
}

/** What is there of a tile. */
interface TileState {
  entry: TileEntry;
  url: string;
  shift: [number, number, number];
  pieces: Uint8Array[];
  bytes: number;
  /** Levels that are shown, and what decodes the next one. */
  shown: number;
  decoder: ProgressiveDecoder | null;
  decoded: number;
  isBusy: boolean;
  isBroken: boolean;
}

export class TileLoader {
  /** Bytes of tiles so far. */
  loaded = 0;
  private readonly tiles: TileState[];
  private readonly sizes: Float64Array;
  private plan: Plan;
  private requests = 0;
  private isWorking = false;
  private isDisposed = false;
  private wasSharp = false;

  /** `base`: the manifest's address. */
  constructor(
    readonly manifest: Manifest,
    base: string,
    private readonly options: TileLoaderOptions,
  ) {
    this.tiles = manifest.tiles.map((entry) => ({
      entry,
      url: new URL(entry.file, base).href,
      shift: [0, 1, 2].map((axis) => entry.worldOffset[axis]! - manifest.worldOffset[axis]!) as [
        number,
        number,
        number,
      ],
      pieces: [],
      bytes: 0,
      shown: 0,
      decoder: null,
      decoded: 0,
      isBusy: false,
      isBroken: false,
    }));
    this.sizes = Float64Array.from(manifest.tiles, sizeOf);
    this.plan = { levels: new Int32Array(this.tiles.length), steps: [] };
  }

  /** The camera is somewhere else: what it needs is fetched from now on. */
  look(sight: Sight): void {
    const shown = this.tiles.map((tile) => tile.shown);
    this.plan = planDetail(this.manifest.tiles, this.sizes, sight, this.options.most, shown);
    this.wasSharp = false;
    this.options.onProgress?.();
    void this.work();
  }

  /** Bytes that the camera at hand still needs. */
  get missing(): number {
    return this.tiles.reduce((sum, { bytes, entry, isBroken }, i) => {
      const wanted = this.plan.levels[i] ? entry.levels[this.plan.levels[i]! - 1]!.bytes : 0;
      return sum + (isBroken ? 0 : Math.max(0, wanted - bytes));
    }, 0);
  }

  /** Everything that the camera needs is shown. */
  get isSharp(): boolean {
    return this.tiles.every(({ shown, isBroken }, i) => isBroken || shown === this.plan.levels[i]);
  }

  /** Splats that are shown. */
  get splats(): number {
    return this.tiles.reduce(
      (sum, { entry, shown }) => sum + (shown ? entry.levels[shown - 1]!.coupled : 0),
      0,
    );
  }

  dispose(): void {
    this.isDisposed = true;
  }

  /** Decodes one tile at a time, with room for new cameras in between. */
  private async work(): Promise<void> {
    if (this.isWorking) return;
    this.isWorking = true;
    while (!this.isDisposed) {
      this.request();
      if (!this.coarsen() && !this.refine()) break;
      await new Promise((resolve) => setTimeout(resolve, 0));
    }
    this.isWorking = false;
    if (this.isDisposed || this.wasSharp || !this.isSharp) return;
    this.wasSharp = true;
    this.options.onSharp?.();
  }

  /** Levels of a tile whose bytes are there. */
  private arrived({ entry, bytes }: TileState): number {
    return entry.levels.filter((level) => level.bytes <= bytes).length;
  }

  private request(): void {
    for (const { tile: index, level } of this.plan.steps) {
      if (this.requests >= MOST_REQUESTS) return;
      const tile = this.tiles[index]!;
      if (tile.isBusy || tile.isBroken || this.arrived(tile) > level) continue;
      const { levels } = tile.entry;
      let goal = level + 1;
      // Coarseness goes with the root of the number of splats.
      const enough = (level ? levels[level - 1]!.coupled : 1) / FINER ** 2;
      while (goal < this.plan.levels[index]! && levels[goal - 1]!.coupled < enough) goal++;
      void this.fetch(tile, levels[goal - 1]!.bytes);
    }
  }

  private async fetch(tile: TileState, end: number): Promise<void> {
    tile.isBusy = true;
    this.requests++;
    try {
      const piece = await persistently(() =>
        bytesOf(tile.url, tile.bytes, end, tile.entry.levels.at(-1)!.bytes),
      );
      tile.pieces.push(piece);
      tile.bytes += piece.length;
      this.loaded += piece.length;
    } catch (error) {
      this.refuse(tile, error);
    }
    this.requests--;
    tile.isBusy = false;
    if (this.isDisposed) return;
    this.options.onProgress?.();
    void this.work();
  }

  /** Makes room: a tile that shows more than is wanted shows less. */
  private coarsen(): boolean {
    const index = this.tiles.findIndex(({ shown }, i) => shown > this.plan.levels[i]!);
    if (index < 0) return false;
    const tile = this.tiles[index]!;
    tile.decoder = null;
    tile.decoded = 0;
    this.show(index, this.plan.levels[index]!);
    return true;
  }

  private refine(): boolean {
    for (const { tile: index } of this.plan.steps) {
      const tile = this.tiles[index]!;
      const goal = Math.min(this.plan.levels[index]!, this.arrived(tile));
      if (tile.isBroken || goal <= tile.shown) continue;
      this.show(index, goal);
      return true;
    }
    return false;
  }

  private show(index: number, level: number): void {
    const tile = this.tiles[index]!;
    const { onTile } = this.options;
    try {
      let scene: Scene | null = null;
      if (level) {
        tile.decoder ??= new ProgressiveDecoder();
        const { bytes } = tile.entry.levels[level - 1]!;
        for (const piece of between(tile.pieces, tile.decoded, bytes)) tile.decoder.push(piece);
        tile.decoded = bytes;
        if (level === tile.entry.levels.length) tile.decoder.finish();
        scene = tile.decoder.scene();
        check(tile.entry, level, scene);
      }
      tile.shown = level;
      onTile(index, scene, tile.shift, level);
    } catch (error) {
      tile.shown = 0;
      this.refuse(tile, error);
      onTile(index, null, tile.shift, 0);
    }
  }

  private refuse(tile: TileState, error: unknown): void {
    tile.isBroken = true;
    if (error instanceof Error) error.message = `${tile.entry.file}: ${error.message}`;
    this.options.onError?.(error);
  }
}

/** Bytes first ... end - 1 of `parts` that lie one after the other. */
function* between(parts: readonly Uint8Array[], first: number, end: number): Generator<Uint8Array> {
  let at = 0;
  for (const part of parts) {
    if (at < end && at + part.length > first) yield part.subarray(Math.max(0, first - at), end - at);
    at += part.length;
  }
}

/** Refuses a file that is another than the manifest speaks of; its sections have checksums of their own. */
function check({ levels, worldOffset }: TileEntry, level: number, scene: Scene): void {
  const [promised, whole] = [levels[level - 1]!, levels.at(-1)!];
  const isIt =
    scene.anchors === promised.anchors &&
    scene.coupled === promised.coupled &&
    scene.totalAnchors === whole.anchors &&
    scene.worldOffset.every((x, axis) => x === worldOffset[axis]);
  if (!isIt) throw new CorruptSection("holds another scene than the manifest says");
}

/** A network may be away for a moment; what a server refuses, it refuses again. */
async function persistently<T>(job: () => Promise<T>): Promise<T> {
  for (let tries = 1; ; tries++) {
    try {
      return await job();
    } catch (error) {
      if (tries === MOST_TRIES || !(error instanceof Unreachable)) throw error;
      await new Promise((resolve) => setTimeout(resolve, PAUSE * 2 ** (tries - 1)));
    }
  }
}

class Unreachable extends Error {}

/** Bytes first ... end - 1 of a file of `total`; all that follow where the server knows no ranges. */
async function bytesOf(url: string, first: number, end: number, total: number): Promise<Uint8Array> {
  const headers = end - first < total ? { Range: `bytes=${first}-${end - 1}` } : undefined;
  const response = await fetch(url, headers ? { headers } : {}).catch((error: Error) => {
    throw new Unreachable(
      `cannot be fetched (${error.message}). Another site must allow it by CORS headers.`,
    );
  });
  if (!response.ok) throw new Error(`the server answers ${response.status} ${response.statusText}`.trim());
  const bytes = new Uint8Array(await response.arrayBuffer());
  const isPart = response.status === 206;
  const expected = isPart ? end - first : total;
  if (bytes.length !== expected)
    throw new TruncatedSection(`the server sends ${bytes.length} bytes, expected ${expected}`);
  return isPart ? bytes : bytes.subarray(first);
}
