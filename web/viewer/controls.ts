/** Mouse, touch and keys move a pose: orbit around a target, or fly. Movements run out softly. */

import { Pose, type Vector, add, dot, unit } from "./pose.ts";

const TURN = 0.006; // radians a CSS pixel
const STEEPEST = 0.985; // cosine between the line of sight and up
const WHEEL = 0.0012; // logarithm of the distance a wheel's pixel
const CROSSINGS = 0.5; // target distances a second, flying
const SOFTNESS = 70; // ms in which most of a movement is made
const LEAST_LEFT = 0.01; // CSS pixels: what is left of a movement is no longer seen
const LONGEST_STEP = 100; // ms a frame, of what keys move
const TAP_TIME = 300; // ms between two taps, and of one
const TAP_REACH = 24; // CSS pixels
const SWING = 350; // ms in which a point comes to the middle
/** Of the scene's extent: nearest and farthest place from what is looked at, and from its middle. */
const NEAREST = 0.01;
const FARTHEST = 12;

export interface Target {
  pose: Pose;
  up: Vector;
  /** World units from the camera to what it turns about. */
  distance: number;
}

/** Where a scene is, which nobody need leave. */
export interface Place {
  middle: Vector;
  extent: number;
}

export interface ControlsOptions {
  /** The pose has changed. */
  moved: () => void;
  /** Somebody has pointed at a place, in CSS pixels of the element, to turn about what is there. */
  pointed?: (x: number, y: number) => void;
  /** Where keys are listened to: the window, for a page that is nothing but the scene. */
  keys?: HTMLElement | Window;
}

const FLIGHT: Record<string, Vector> = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyQ: [0, 1, 0],
  KeyE: [0, -1, 0],
  ArrowUp: [0, 0, 1],
  ArrowDown: [0, 0, -1],
  ArrowLeft: [-1, 0, 0],
  ArrowRight: [1, 0, 0],
};

/** What is still to be moved. */
interface Pending {
  turn: [number, number]; // CSS pixels
  pan: [number, number]; // CSS pixels
  approach: number; // logarithm of a factor of the distance
}

export class Controls {
  target: Target | null = null;
  place: Place | null = null;
  /** Turning is about the target (orbit), or about the camera itself (fly). */
  mode: "orbit" | "fly" = "orbit";
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private readonly keys = new Set<string>();
  private readonly listening = new AbortController();
  private pending: Pending = nothing();
  private swing: { from: Vector; to: Vector; since: number; about: Vector } | null = null;
  private tap: { x: number; y: number; at: number; isMoved: boolean } | null = null;
  private lastTap = { x: 0, y: 0, at: -Infinity };
  private lastTick = 0;
  private isTicking = false;

  constructor(
    private readonly element: HTMLElement,
    private readonly options: ControlsOptions,
  ) {
    const { signal } = this.listening;
    const on = <K extends keyof HTMLElementEventMap>(
      name: K,
      call: (event: HTMLElementEventMap[K]) => void,
    ): void => element.addEventListener(name, call, { signal, passive: false });
    element.tabIndex = 0;
    element.style.touchAction = "none";
    on("pointerdown", (event) => this.touch(event));
    on("pointermove", (event) => this.drag(event));
    on("pointerup", (event) => this.release(event, true));
    on("pointercancel", (event) => this.release(event, false));
    on("wheel", (event) => {
      event.preventDefault();
      this.pending.approach += event.deltaY * (event.deltaMode === 1 ? 16 : 1) * WHEEL;
      this.start();
    });
    on("contextmenu", (event) => event.preventDefault());
    const keys = options.keys ?? element;
    keys.addEventListener("keydown", (event) => this.press(event as KeyboardEvent), { signal });
    keys.addEventListener("keyup", (event) => this.keys.delete((event as KeyboardEvent).code), { signal });
    keys.addEventListener("blur", () => this.keys.clear(), { signal });
  }

  /** Something still moves. */
  get isBusy(): boolean {
    return this.isTicking;
  }

  dispose(): void {
    this.listening.abort();
  }

  /** Stops what still moves. */
  rest(): void {
    this.pending = nothing();
    this.swing = null;
  }

  /** Brings a point of the local frame to the middle, and turns about it from then on. */
  turnAbout(point: Vector): void {
    const { target } = this;
    if (!target) return;
    this.rest();
    const offset = add(point, target.pose.centre, -1);
    this.mode = "orbit";
    target.distance = Math.hypot(...offset);
    this.swing = { from: target.pose.forward, to: unit(offset), since: performance.now(), about: point };
    this.start();
  }

  private touch(event: PointerEvent): void {
    this.element.setPointerCapture(event.pointerId);
    this.element.focus({ preventScroll: true });
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const { clientX: x, clientY: y } = event;
    this.tap = this.pointers.size === 1 ? { x, y, at: performance.now(), isMoved: false } : null;
    this.swing = null;
  }

  private release(event: PointerEvent, isLifted: boolean): void {
    if (!this.pointers.delete(event.pointerId)) return;
    const { tap, lastTap } = this;
    const now = performance.now();
    this.tap = null;
    if (!isLifted || !tap || tap.isMoved || now - tap.at > TAP_TIME || event.button > 0) return;
    const isSecond =
      now - lastTap.at < 2 * TAP_TIME && Math.hypot(tap.x - lastTap.x, tap.y - lastTap.y) < TAP_REACH;
    this.lastTap = { x: tap.x, y: tap.y, at: isSecond ? -Infinity : now };
    if (!isSecond) return;
    const { left, top } = this.element.getBoundingClientRect();
    this.options.pointed?.(tap.x - left, tap.y - top);
  }

  private drag(event: PointerEvent): void {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.target) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const { tap, pending } = this;
    if (tap && Math.hypot(now.x - tap.x, now.y - tap.y) > TAP_REACH / 3) tap.isMoved = true;
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    this.pointers.set(event.pointerId, now);
    if (others.length) {
      const other = others[0]!;
      const spread =
        Math.hypot(now.x - other.x, now.y - other.y) / Math.hypot(before.x - other.x, before.y - other.y);
      pending.pan = [pending.pan[0] + dx / 2, pending.pan[1] + dy / 2];
      if (spread > 0 && Number.isFinite(spread)) pending.approach -= Math.log(spread);
    } else if (event.buttons & 6 || event.shiftKey) pending.pan = [pending.pan[0] + dx, pending.pan[1] + dy];
    else pending.turn = [pending.turn[0] + dx, pending.turn[1] + dy];
    this.start();
  }

  private press(event: KeyboardEvent): void {
    if (!(event.code in FLIGHT) || event.ctrlKey || event.metaKey || event.altKey || writes(event.target))
      return;
    event.preventDefault();
    this.keys.add(event.code);
    this.start();
  }

  /** Moves from now on, until all has been moved. */
  private start(): void {
    if (this.isTicking || !this.target) return;
    this.isTicking = true;
    this.lastTick = performance.now();
    requestAnimationFrame(() => this.tick());
  }

  private tick(): void {
    this.isTicking = false;
    if (!this.target) return;
    const now = performance.now();
    const passed = Math.max(now - this.lastTick, 1);
    const { pending, keys, swing } = this;
    const isMore =
      Math.hypot(...pending.turn, ...pending.pan) > LEAST_LEFT ||
      Math.abs(pending.approach) > WHEEL * LEAST_LEFT;
    if (!isMore && !keys.size && !swing) return;
    const part = 1 - Math.exp(-passed / SOFTNESS);
    this.turn(pending.turn[0] * part, pending.turn[1] * part);
    this.pan(pending.pan[0] * part, pending.pan[1] * part);
    this.approach(Math.exp(pending.approach * part));
    const left = 1 - part;
    pending.turn = [pending.turn[0] * left, pending.turn[1] * left];
    pending.pan = [pending.pan[0] * left, pending.pan[1] * left];
    pending.approach *= left;
    this.fly((Math.min(passed, LONGEST_STEP) / 1000) * CROSSINGS);
    if (swing) this.swingOn(swing, now);
    this.stay();
    this.options.moved();
    this.isTicking = true;
    this.lastTick = now;
    requestAnimationFrame(() => this.tick());
  }

  private turn(dx: number, dy: number): void {
    if (!dx && !dy) return;
    const { pose, up, distance } = this.target!;
    const flies = this.mode === "fly";
    const pivot = flies ? pose.centre : add(pose.centre, pose.forward, distance);
    // The scene follows the hand; flying, the head does.
    const sign = flies ? 1 : -1;
    pose.turn(up, -sign * dx * TURN, pivot);
    const before = pose.copy();
    pose.turn(pose.right, -sign * dy * TURN, pivot);
    const steepness = dot(pose.forward, up);
    if (Math.abs(steepness) > STEEPEST && Math.abs(steepness) > Math.abs(dot(before.forward, up))) {
      Object.assign(pose, before);
    }
  }

  private pan(dx: number, dy: number): void {
    const { pose, distance } = this.target!;
    const step = distance / this.element.clientHeight;
    pose.move(-dx * step, -dy * step, 0);
  }

  /** Makes the distance to the target `factor` times as long. */
  private approach(factor: number): void {
    const { target, place } = this;
    const { pose, distance } = target!;
    if (this.mode === "fly") {
      pose.move(0, 0, distance * (1 - factor));
      return;
    }
    const [least, most] = place ? [NEAREST * place.extent, FARTHEST * place.extent] : [0, Infinity];
    const next = Math.min(Math.max(distance * factor, Math.min(least, distance)), Math.max(most, distance));
    pose.move(0, 0, distance - next);
    target!.distance = next;
  }

  private fly(share: number): void {
    for (const key of this.keys) {
      const [right, down, forward] = FLIGHT[key]!;
      const step = share * this.target!.distance;
      this.target!.pose.move(right * step, down * step, forward * step);
    }
  }

  private swingOn({ from, to, since, about }: NonNullable<Controls["swing"]>, now: number): void {
    const { target } = this;
    const passed = Math.min((now - since) / SWING, 1);
    const eased = passed * passed * (3 - 2 * passed);
    const forward = unit(add(add([0, 0, 0], from, 1 - eased), to, eased));
    const { centre } = target!.pose;
    target!.pose = Pose.lookingAt(centre, passed < 1 ? add(centre, forward) : about, target!.up);
    if (passed === 1) this.swing = null;
  }

  /** Nobody gets so far away that nothing is left to see. */
  private stay(): void {
    const { target, place } = this;
    if (!place) return;
    const offset = add(target!.pose.centre, place.middle, -1);
    const away = Math.hypot(...offset);
    const most = FARTHEST * place.extent;
    if (away > most) target!.pose.centre = add(place.middle, offset, most / away);
  }
}

function nothing(): Pending {
  return { turn: [0, 0], pan: [0, 0], approach: 0 };
}

/** Whether keys mean letters there, or the element's own. */
function writes(target: EventTarget | null): boolean {
  return target instanceof HTMLElement && /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName);
}
