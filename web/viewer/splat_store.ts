/**
 * The splats that a renderer holds: the parts of a scene, each with rows of its own, their colors for the camera at
 * hand, and the order in which all of them are drawn.
 *
 * A part that takes the place of another gets new rows; those of the old one are free when a frame without it was sent.
 */

import { type Appearance, OPACITY_CUTOFF, type Predictor } from "../src/prediction/predictor.ts";
import { DepthOrder } from "./depth_order.ts";
import type { Eye, FromWorker, Rows } from "./messages.ts";
import { halfOf, meetings } from "./pick.ts";
import type { Vector } from "./pose.ts";
import { appearanceRows, geometryPlanes, rowsOf } from "./splat_planes.ts";
import { NEAR } from "./splatting.ts";

/** Coupled primitives whose opacity and color follow the camera in one frame. */
const SHARE = 50_000;

interface Part {
  predictor: Predictor;
  appearance: Appearance;
  /** From its frame to the scene's. */
  shift: Vector;
  rows: number[];
  /** Anchor with which the next share begins, and anchors that have not seen the camera yet. */
  nextAnchor: number;
  remaining: number;
}

type Post = (message: FromWorker, transfer: Transferable[]) => void;

export class SplatStore {
  private readonly parts = new Map<number, Part>();
  private readonly depthOrder = new DepthOrder();
  private free: number[] = [];
  /** Rows that the last frame still draws. */
  private retired: number[] = [];
  private rows = 0;
  private eye: Eye | null = null;
  private isStale = false;
  private isScheduled = false;
  /** What is sent at once, so that nobody sees half of it. */
  private held: Array<Parameters<Post>> | null = null;

  /** `isSharp`: whether the parts are as fine as the camera needs them. `isSeen`: whether it sees any of a part. */
  constructor(
    private readonly post: Post,
    private readonly isSharp: () => boolean = () => true,
    private readonly isSeen: (part: number) => boolean = () => true,
  ) {}

  /** Forgets everything, and has room for so many rows. */
  reserve(rows: number): void {
    this.parts.clear();
    this.rows = rows;
    this.clearRows();
  }

  /** One part in place of everything, in one moment. */
  replace(predictor: Predictor): void {
    this.together(() => {
      this.reserve(rowsOf(predictor.geometry.sound.length));
      this.set(0, predictor, [0, 0, 0]);
      if (this.eye) this.frame(this.eye);
    });
  }

  /** A part, in place of what was there of it. */
  set(id: number, predictor: Predictor, shift: Vector): void {
    const wanted = rowsOf(predictor.geometry.sound.length);
    const old = this.parts.get(id);
    if (old) this.retired.push(...old.rows);
    if (this.free.length < wanted) this.reuse();
    if (this.free.length < wanted) throw new Error(`${wanted} rows of splats, ${this.free.length} are free`);
    const part: Part = {
      predictor,
      appearance: predictor.newAppearance(),
      shift,
      rows: this.free.splice(0, wanted),
      nextAnchor: 0,
      remaining: predictor.primitives.anchors,
    };
    this.parts.set(id, part);
    this.send(part);
    this.touch();
  }

  delete(id: number): void {
    const part = this.parts.get(id);
    if (!part) return;
    this.parts.delete(id);
    this.retired.push(...part.rows);
    this.touch();
  }

  /** The camera is somewhere else. */
  look(eye: Eye): void {
    const moved = !this.eye || eye.centre.some((x, axis) => x !== this.eye!.centre[axis]);
    this.eye = eye;
    if (moved) for (const part of this.parts.values()) part.remaining = part.predictor.primitives.anchors;
    this.touch();
  }

  /** Everything once more, for a renderer that has nothing. */
  again(): void {
    if (!this.rows) return;
    this.together(() => {
      this.clearRows();
      for (const part of this.parts.values()) {
        part.rows = this.free.splice(0, part.rows.length);
        this.send(part);
      }
      if (this.eye) this.frame(this.eye);
    });
  }

  /** A frame is due, even if nobody moves. */
  touch(): void {
    this.isStale = true;
    this.schedule();
  }

  distanceAlong(origin: Vector, direction: Vector, pixel: number): number | null {
    const met = [...this.parts.values()].flatMap(({ predictor, appearance, shift }) => {
      const local = origin.map((x, axis) => x - shift[axis]!) as Vector;
      return meetings(local, direction, pixel, predictor.geometry, appearance.opacities, NEAR);
    });
    return halfOf(met);
  }

  private together(job: () => void): void {
    this.held = [];
    job();
    const messages = this.held;
    this.held = null;
    for (const message of messages) this.post(...message);
  }

  private say(message: FromWorker, transfer: Transferable[] = []): void {
    if (this.held) this.held.push([message, transfer]);
    else this.post(message, transfer);
  }

  private clearRows(): void {
    this.free = Array.from({ length: this.rows }, (_, row) => row);
    this.retired = [];
    this.say({ kind: "reserve", rows: this.rows });
  }

  private reuse(): void {
    // In order, as neighbouring rows are sent together.
    this.free = [...this.free, ...this.retired].sort((a, b) => a - b);
    this.retired = [];
  }

  /** Geometry, and colors for the camera at hand: a new part has no others. */
  private send(part: Part): void {
    const { predictor, appearance, shift, rows } = part;
    const planes = geometryPlanes(predictor.geometry, shift);
    this.say({ kind: "geometry", planes, rows }, [planes.buffer]);
    if (!this.eye) return;
    predictor.predictAppearance(localTo(part, this.eye.centre), appearance);
    part.remaining = 0;
    const { values } = appearanceRows(appearance, 0, predictor.geometry.sound.length);
    this.say({ kind: "appearance", values, rows }, [values.buffer]);
  }

  /** One frame at a time, with room for messages in between. */
  private schedule(): void {
    const isBehind = [...this.parts.values()].some(({ remaining }) => remaining > 0);
    if (this.isScheduled || !this.rows || !this.eye || !(this.isStale || isBehind)) return;
    this.isScheduled = true;
    setTimeout(() => {
      this.isScheduled = false;
      this.isStale = false;
      this.frame(this.eye!);
      this.schedule();
    }, 0);
  }

  private frame(eye: Eye): void {
    const { axis, centre, id } = eye;
    const parts = [...this.parts];
    const seen = parts.filter(([index]) => this.isSeen(index)).map(([, part]) => part);
    // What is seen follows the camera first.
    let left = SHARE;
    for (const part of [...seen, ...parts.map(([, part]) => part)]) {
      if (left <= 0) break;
      if (part.remaining) left -= this.follow(part, centre, left);
    }
    const along = (v: ArrayLike<number>): number => axis[0] * v[0]! + axis[1] * v[1]! + axis[2] * v[2]!;
    const depthParts = seen.map(({ predictor, appearance, shift, rows }) => ({
      means: predictor.geometry.means,
      sound: predictor.geometry.sound,
      opacities: appearance.opacities,
      shift: along(shift) - along(centre),
      rows,
    }));
    const order = this.depthOrder.sort(depthParts, axis, OPACITY_CUTOFF, NEAR);
    const settled = parts.every(([, { remaining }]) => remaining === 0);
    this.say({ kind: "frame", id, order, settled, sharp: settled && this.isSharp() }, [order.buffer]);
    this.reuse();
  }

  /** Colors of at most so many primitives more; how many they were. */
  private follow(part: Part, centre: Vector, most: number): number {
    const { predictor, appearance, rows } = part;
    const { firstCoupled, anchors } = predictor.primitives;
    const first = part.nextAnchor % anchors;
    const last = Math.min(anchors, first + part.remaining);
    let end = first + 1;
    while (end < last && firstCoupled[end + 1]! - firstCoupled[first]! <= most) end++;
    predictor.predictAppearance(localTo(part, centre), appearance, first, end);
    part.nextAnchor = end % anchors;
    part.remaining -= end - first;
    const [from, to] = [firstCoupled[first]!, firstCoupled[end]!];
    if (to > from) {
      const found = appearanceRows(appearance, from, to);
      const places: Rows = rows.slice(found.firstRow, found.firstRow + found.rows);
      this.say({ kind: "appearance", values: found.values, rows: places }, [found.values.buffer]);
    }
    return Math.max(1, to - from);
  }
}

function localTo({ shift }: Part, centre: Vector): Vector {
  return [centre[0] - shift[0], centre[1] - shift[1], centre[2] - shift[2]];
}
