/** Mouse, touch and keys move a pose: orbit around a target, or fly. */

import { type Pose, type Vector, add, dot } from "./pose.ts";

const TURN = 0.006; // radians a CSS pixel
const STEEPEST = 0.985; // cosine between the line of sight and up
const WHEEL = 0.0012; // share of the distance a wheel's pixel
const CROSSINGS = 0.5; // target distances a second, flying

export interface Target {
  pose: Pose;
  up: Vector;
  /** World units from the camera to what it turns about. */
  distance: number;
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

export class Controls {
  target: Target | null = null;
  /** Turning is about the target (orbit), or about the camera itself (fly). */
  mode: "orbit" | "fly" = "orbit";
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private readonly keys = new Set<string>();
  private readonly listening = new AbortController();
  private lastTick = 0;

  constructor(
    private readonly element: HTMLElement,
    private readonly moved: () => void,
  ) {
    const { signal } = this.listening;
    const on = <K extends keyof HTMLElementEventMap>(
      name: K,
      call: (event: HTMLElementEventMap[K]) => void,
    ): void => element.addEventListener(name, call, { signal, passive: false });
    element.tabIndex = 0;
    element.style.touchAction = "none";
    on("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      element.focus({ preventScroll: true });
      this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    on("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"] as const)
      on(name, (event) => this.pointers.delete(event.pointerId));
    on("wheel", (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
      this.approach(Math.exp(pixels * WHEEL));
    });
    on("contextmenu", (event) => event.preventDefault());
    on("keydown", (event) => this.press(event));
    on("keyup", (event) => this.keys.delete(event.code));
    on("blur", () => this.keys.clear());
  }

  dispose(): void {
    this.listening.abort();
  }

  private drag(event: PointerEvent): void {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.target) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    this.pointers.set(event.pointerId, now);
    if (others.length) {
      const other = others[0]!;
      const spread =
        Math.hypot(now.x - other.x, now.y - other.y) / Math.hypot(before.x - other.x, before.y - other.y);
      this.pan(dx / 2, dy / 2);
      if (spread > 0 && Number.isFinite(spread)) this.approach(1 / spread);
    } else if (event.buttons & 6 || event.shiftKey) this.pan(dx, dy);
    else this.turn(dx, dy);
  }

  private turn(dx: number, dy: number): void {
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
    this.moved();
  }

  private pan(dx: number, dy: number): void {
    const { pose, distance } = this.target!;
    const step = distance / this.element.clientHeight;
    pose.move(-dx * step, -dy * step, 0);
    this.moved();
  }

  /** Makes the distance to the target `factor` times as long. */
  private approach(factor: number): void {
    if (!this.target) return;
    const { pose, distance } = this.target;
    pose.move(0, 0, distance * (1 - factor));
    if (this.mode === "orbit") this.target.distance = distance * factor;
    this.moved();
  }

  private press(event: KeyboardEvent): void {
    if (!(event.code in FLIGHT) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    if (!this.keys.size) {
      this.lastTick = performance.now();
      requestAnimationFrame(() => this.tick());
    }
    this.keys.add(event.code);
  }

  private tick(): void {
    if (!this.keys.size || !this.target) return;
    const now = performance.now();
    const step = Math.min((now - this.lastTick) / 1000, 0.1) * CROSSINGS * this.target.distance;
    this.lastTick = now;
    for (const key of this.keys) {
      const [right, down, forward] = FLIGHT[key]!;
      this.target.pose.move(right * step, down * step, forward * step);
    }
    this.moved();
    requestAnimationFrame(() => this.tick());
  }
}
