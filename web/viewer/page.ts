/** The page: a scene that is embedded in it, named by ?url=, chosen, or dropped onto it. */

import type { SceneInfo } from "../src/scene_info.ts";
import { whatItIs } from "./kinds.ts";
import type { RendererName } from "./renderer.ts";
import { Viewer } from "./viewer.ts";

const HINT_TIME = 8000; // ms
const CALM = "2b2f36"; // behind scenes whose own background is black

const element = (id: string): HTMLElement => document.getElementById(id)!;

const bytesOf = (count: number): string =>
  count < 1e6 ? `${Math.max(1, Math.round(count / 1e3))} kB` : `${(count / 1e6).toFixed(1)} MB`;

/** The file within the page, or null. */
function embedded(): Uint8Array | null {
  const text = element("scene").textContent!.trim();
  if (!text) return null;
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

/** The name of a file in an address, without its ending; of a manifest, that of the folder of tiles. */
function nameOf(url: string): string {
  const parts = new URL(url, document.baseURI).pathname.replace(/\/manifest\.json$/, "").split("/");
  const last = parts.pop()!;
  try {
    return decodeURIComponent(last).replace(/\.(cgs|tiles)$/, "") || document.title;
  } catch {
    return last; // it has a percent sign that is no code
  }
}

function sayError(title: string, text: string): void {
  element("error-title").textContent = title;
  element("error-text").textContent = text;
  element("error").hidden = false;
  element("bar").hidden = true;
}

function explain(name: string, message: string, head?: Uint8Array): void {
  const other = name === "NotACompGSFile" && head ? whatItIs(head) : null;
  if (other) {
    sayError(other.title, other.remedy);
    return;
  }
  const titles: Record<string, string> = {
    NotACompGSFile: "This is not a .cgs file",
    UnsupportedVersion: "This file is of another version",
    TruncatedSection: "This file is not complete",
    CorruptSection: "This file is damaged",
    CannotDraw: "This browser cannot show the scene",
    MissingDependency: "This file cannot be shown in a browser",
  };
  const remedy = new URLSearchParams(location.search).has("renderer")
    ? " Without renderer= in its address the page takes what there is."
    : " Try a current version of Firefox, Chrome, Edge or Safari.";
  const hint = name === "CannotDraw" ? remedy : "";
  sayError(titles[name] ?? "The scene cannot be shown", message + hint);
}

function describe(info: SceneInfo): string {
  const splats = info.coupled.toLocaleString("en");
  const share =
    info.anchors < info.totalAnchors ? `, ${Math.round((100 * info.anchors) / info.totalAnchors)} %` : "";
  return `${splats} splats${share}`;
}

/** What ?renderer= asks for. */
function askedRenderer(): RendererName | undefined {
  const asked = new URLSearchParams(location.search).get("renderer");
  if (asked === null || asked === "webgpu" || asked === "webgl2") return asked ?? undefined;
  throw new Error(`The address asks for renderer=${asked}; there are webgpu and webgl2.`);
}

/** Splats that ?splats= asks for at most. */
function askedSplats(): number | undefined {
  const asked = new URLSearchParams(location.search).get("splats");
  if (asked === null) return undefined;
  if (!(Number(asked) >= 1))
    throw new Error(`The address asks for splats=${asked}, expected a number above 0`);
  return Number(asked);
}

function start(): void {
  let described = "";
  let isShown = false;
  const hint = new Hint(element("hint"));
  const viewer = new Viewer(element("view"), {
    renderer: askedRenderer(),
    most: askedSplats(),
    keys: window,
    onMove() {
      hint.fade();
      sayMode(viewer);
    },
    onProgress(loaded, total) {
      element("bar").hidden = total !== null && loaded >= total;
      element("bar").style.width = total ? `${(100 * loaded) / total}%` : "100%";
    },
    onScene(info) {
      described = describe(info);
      if (!isShown) hint.show(hintFor(viewer));
      isShown = true;
      sayMode(viewer);
      setBackground(viewer, info);
      element("status").textContent = described;
      element("welcome").hidden = true;
      element("buttons").hidden = false;
      element("next").hidden = (info.viewpoints?.views.length ?? 0) < 2;
    },
    onComplete(bytes) {
      element("bar").hidden = true;
      element("status").textContent = `${described} in ${bytesOf(bytes)}`;
    },
    onError: explain,
  });
  const close = (): void => {
    element("error").hidden = true;
    element("welcome").hidden = isShown;
  };
  Object.assign(window, { compgsViewer: viewer });
  const open = (source: ArrayBuffer | Uint8Array | string): void => {
    element("error").hidden = true;
    element("welcome").hidden = true;
    isShown = false;
    viewer.open(source);
  };
  noteHands();
  wireButtons(viewer, close);
  wirePanel(viewer);
  wireFiles(open);
  const data = embedded();
  const url = new URLSearchParams(location.search).get("url");
  if (data) open(data);
  else if (url) {
    document.title = nameOf(url);
    open(url);
  } else element("welcome").hidden = false;
}

/** Says something for a while. */
class Hint {
  private waiting: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly place: HTMLElement) {}

  show(text: string): void {
    this.place.textContent = text;
    this.place.classList.remove("gone");
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => this.fade(), HINT_TIME);
  }

  fade(): void {
    this.place.classList.add("gone");
  }
}

function hintFor(viewer: Viewer): string {
  const turn = viewer.controls.mode === "orbit" ? "turn" : "look around";
  return document.body.classList.contains("touch")
    ? `One finger to ${turn}, two to move, double tap to turn about a point`
    : `Drag to ${turn}, wheel to come nearer, W A S D to move; ? has more`;
}

/** Which controls are spoken of: those of the hand that was last seen. */
function noteHands(): void {
  const note = (isTouch: boolean): void => {
    document.body.classList.toggle("touch", isTouch);
    document.body.classList.toggle("mouse", !isTouch);
  };
  note(matchMedia("(pointer: coarse)").matches);
  addEventListener("pointerdown", (event) => note(event.pointerType === "touch"), true);
}

function sayMode({ controls }: Viewer): void {
  element("mode").textContent = controls.mode === "orbit" ? "Orbit" : "Look around";
}

/** Where a scene ends there is no black hole: what it has nothing to say about is calm, unless black was chosen. */
function setBackground(viewer: Viewer, { background }: SceneInfo): void {
  const select = element("background") as HTMLSelectElement;
  if (!select.dataset.chosen) select.value = background.every((x) => x === 0) ? CALM : "";
  applyBackground(viewer, select.value);
}

function applyBackground(viewer: Viewer, color: string): void {
  const parts = [0, 2, 4].map((at) => parseInt(color.slice(at, at + 2), 16) / 255);
  viewer.background = color ? (parts as [number, number, number]) : null;
}

function wirePanel(viewer: Viewer): void {
  const lens = element("lens") as HTMLInputElement;
  const background = element("background") as HTMLSelectElement;
  const toggle = (isOpen = element("help").hidden): void => {
    element("help").hidden = !isOpen;
    lens.value = String(Math.round(viewer.fieldOfView));
  };
  element("ask").onclick = () => toggle();
  element("shut").onclick = () => toggle(false);
  lens.oninput = () => (viewer.fieldOfView = Number(lens.value));
  background.onchange = () => {
    background.dataset.chosen = "yes";
    applyBackground(viewer, background.value);
  };
  addEventListener("keydown", (event) => {
    if (event.key === "?") toggle();
    else if (event.key === "Escape") toggle(false);
  });
}

async function savePicture(viewer: Viewer): Promise<void> {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await viewer.screenshot());
  link.download = `${document.title || "scene"}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

function wireButtons(viewer: Viewer, close: () => void): void {
  const toggleMode = (): void => {
    viewer.controls.mode = viewer.controls.mode === "orbit" ? "fly" : "orbit";
    sayMode(viewer);
  };
  const start = (): void => {
    viewer.goToStart();
    sayMode(viewer);
  };
  const toggleScreen = (): void => {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void document.documentElement.requestFullscreen?.();
  };
  element("mode").onclick = toggleMode;
  element("screen").onclick = toggleScreen;
  element("next").onclick = () => viewer.nextView();
  element("start").onclick = start;
  element("picture").onclick = () => void savePicture(viewer);
  element("close").onclick = close;
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || element("buttons").hidden) return;
    const actions: Record<string, () => void> = {
      KeyO: toggleMode,
      KeyF: toggleScreen,
      KeyN: () => viewer.nextView(),
      KeyR: start,
      KeyP: () => void savePicture(viewer),
    };
    actions[event.code]?.();
  });
}

function wireFiles(open: (source: ArrayBuffer) => void): void {
  const input = element("file") as HTMLInputElement;
  const read = async (file: File | undefined): Promise<void> => {
    if (file) open(await file.arrayBuffer());
  };
  input.onchange = () => void read(input.files?.[0]);
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  for (const name of ["dragleave", "drop"])
    addEventListener(name, () => document.body.classList.remove("dropping"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    void read(event.dataTransfer?.files[0]);
  });
}

try {
  start();
} catch (error) {
  const { name, message } = error as Error;
  explain(name, message);
}
