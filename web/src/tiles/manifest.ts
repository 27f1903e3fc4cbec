/** The list of a scene's tiles (docs/tiles.md, "The folder"): what is known of each before any of its bytes are there. */

import type { Camera } from "../cameras.ts";
import { CorruptSection, NotACompGSFile, UnsupportedVersion } from "../errors.ts";
import { canonicalJson } from "./canonical_json.ts";
import { sha256 } from "./sha256.ts";

const KIND = "compgs tiles";
const VERSION = 1;
const MOST_TILES = 1 << 16;
const MOST_SPHERES = 1 << 10;
const MOST_LEVELS = 1 << 5;
const MOST_NUMBER = 1e30;
const MOST_COUNT = 2 ** 48;
const MOST_SIDE = 1 << 20;
const BEGINNING = /^\s*\{\s*"format"\s*:\s*"compgs tiles"/;
const NAME = /^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$/;

export type Vector = [number, number, number];

/** A beginning of a tile's file that is a scene, or all of it. */
export interface TileLevel {
  bytes: number;
  anchors: number;
  /** Coupled primitives: splats. */
  coupled: number;
}

export interface TileEntry {
  name: string;
  /** Beside the manifest. */
  file: string;
  worldOffset: Vector;
  /** From coarse to fine; the last is the whole file. */
  levels: TileLevel[];
  /** [G, 4] centre, counted from the manifest's world offset, and radius of what holds all that is drawn. */
  spheres: Float64Array;
}

export interface Manifest {
  tiles: TileEntry[];
  worldOffset: Vector;
  background: Vector;
  angularDilation: number | null;
  up: Vector;
  /** Of the world, the best first. */
  viewpoints: Camera[];
}

/** Whether a text, or the beginning of one, is that of a manifest. */
export function isManifest(text: string): boolean {
  return BEGINNING.test(text);
}

/** Throws NotACompGSFile, UnsupportedVersion or CorruptSection. */
export function readManifest(text: string): Manifest {
  if (!isManifest(text)) throw new NotACompGSFile("manifest: is not that of a scene of tiles");
  try {
    const content = JSON.parse(text) as Record<string, unknown>;
    if (content.version !== VERSION)
      throw new UnsupportedVersion(`manifest: version ${String(content.version)}, expected ${VERSION}`);
    const rest = canonicalJson(text, ["format", "version", "checksum"]);
    if (content.format !== KIND || content.checksum !== sha256(new TextEncoder().encode(rest)))
      throw new CorruptSection("manifest: checksum does not match");
    return manifestOf(content);
  } catch (error) {
    if (error instanceof CorruptSection || error instanceof UnsupportedVersion) throw error;
    throw new CorruptSection(`manifest: is damaged (${(error as Error).message})`);
  }
}

function manifestOf(content: Record<string, unknown>): Manifest {
  const tiles = list(content.tiles, 1, MOST_TILES).map(tileOf);
  if (new Set(tiles.map(({ name }) => name)).size < tiles.length) throw new Error("two tiles have one name");
  const dilation = content.angular_dilation ?? null;
  return {
    tiles,
    worldOffset: vector(content.world_offset),
    background: vector(content.background),
    angularDilation: dilation === null ? null : dilationOf(dilation),
    up: vector(content.up),
    viewpoints: list(content.viewpoints, 0, MOST_TILES).map(cameraOf),
  };
}

function tileOf(value: unknown): TileEntry {
  const entry = value as Record<string, unknown>;
  const { name } = entry;
  if (typeof name !== "string" || !NAME.test(name))
    throw new Error(`a tile named ${String(name).slice(0, 80)}`);
  const coarser = list(entry.levels ?? [], 0, MOST_LEVELS).map((level) => {
    const [bytes, anchors, coupled] = list(level, 3, 3);
    return { bytes: count(bytes), anchors: count(anchors), coupled: count(coupled, 0) };
  });
  const whole = {
    bytes: count(entry.bytes),
    anchors: count(entry.anchors),
    coupled: count(entry.coupled_primitives),
  };
  const levels = [...coarser, whole];
  levels.slice(1).forEach((finer, i) => {
    const { bytes, anchors, coupled } = levels[i]!;
    if (bytes >= finer.bytes || anchors >= finer.anchors || coupled > finer.coupled)
      throw new Error(`level ${i} of tile ${name} is not less than the next`);
  });
  const spheres = list(entry.spheres, 1, MOST_SPHERES).flatMap((sphere) => list(sphere, 4, 4).map(number));
  if (spheres.some((radius, i) => i % 4 === 3 && radius < 0)) throw new Error(`a radius of tile ${name}`);
  return {
    name,
    file: `${name}.cgs`,
    worldOffset: vector(entry.world_offset),
    levels,
    spheres: Float64Array.from(spheres),
  };
}

function cameraOf(value: unknown): Camera {
  const entry = value as Record<string, unknown>;
  const worldToCamera = list(entry.world_to_camera, 4, 4).flatMap((row) => list(row, 4, 4).map(number));
  const [fx, fy, cx, cy] = [number(entry.fx), number(entry.fy), number(entry.cx), number(entry.cy)];
  const [width, height] = [count(entry.width), count(entry.height)];
  if (fx <= 0 || fy <= 0 || Math.max(width, height) > MOST_SIDE)
    throw new Error(`a viewpoint of ${width} x ${height} pixels, lens ${fx} ${fy}`);
  return { worldToCamera, width, height, fx, fy, cx, cy };
}

function dilationOf(value: unknown): number {
  const dilation = number(value);
  if (!(dilation > 0 && dilation < 1)) throw new Error(`angular_dilation is ${dilation}`);
  return dilation;
}

function vector(value: unknown): Vector {
  return list(value, 3, 3).map(number) as Vector;
}

function number(value: unknown): number {
  if (typeof value !== "number" || !(Math.abs(value) <= MOST_NUMBER))
    throw new Error(`expected a number, found ${String(value).slice(0, 80)}`);
  return value;
}

function count(value: unknown, least = 1): number {
  if (!Number.isInteger(value) || (value as number) < least || (value as number) >= MOST_COUNT)
    throw new Error(`expected a count, found ${String(value).slice(0, 80)}`);
  return value as number;
}

function list(value: unknown, fewest: number, most: number): unknown[] {
  if (!Array.isArray(value) || value.length < fewest || value.length > most)
    throw new Error(`expected a list of ${fewest} to ${most}`);
  return value;
}
