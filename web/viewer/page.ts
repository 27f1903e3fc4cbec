/** The page: a scene that is embedded in it, named by ?url=, chosen, or dropped onto it. */

import type { SceneInfo } from "./messages.ts";
import type { RendererName } from "./renderer.ts";
import { Viewer } from "./viewer.ts";

const element = (id: string): HTMLElement => document.getElementById(id)!;

const bytesOf = (count: number): string =>
  count < 1e6 ? `${Math.max(1, Math.round(count / 1e3))} kB` : `${(count / 1e6).toFixed(1)} MB`;

/** The file within the page, or null. */
function embedded(): Uint8Array | null {
  const text = element("scene").textContent!.trim();
  if (!text) return null;
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

/** The name of a file in an address, without its ending. */
function nameOf(url: string): string {
  const last = new URL(url, document.baseURI).pathname.split("/").pop()!;
  try {
    return decodeURIComponent(last).replace(/\.cgs$/, "") || document.title;
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

function explain(name: string, message: string): void {
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

function start(): void {
  let described = "";
  const viewer = new Viewer(element("view"), {
    renderer: askedRenderer(),
    onProgress(loaded, total) {
      element("bar").hidden = total !== null && loaded >= total;
      element("bar").style.width = total ? `${(100 * loaded) / total}%` : "100%";
    },
    onScene(info) {
      described = describe(info);
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
  Object.assign(window, { compgsViewer: viewer });
  const open = (source: ArrayBuffer | Uint8Array | string): void => {
    element("error").hidden = true;
    element("welcome").hidden = true;
    viewer.open(source);
  };
  wireButtons(viewer);
  wireFiles(open);
  const data = embedded();
  const url = new URLSearchParams(location.search).get("url");
  if (data) open(data);
  else if (url) {
    document.title = nameOf(url);
    open(url);
  } else element("welcome").hidden = false;
}

function wireButtons(viewer: Viewer): void {
  const toggleMode = (): void => {
    viewer.controls.mode = viewer.controls.mode === "orbit" ? "fly" : "orbit";
    element("mode").textContent = viewer.controls.mode === "orbit" ? "Orbit" : "Fly";
  };
  const toggleScreen = (): void => {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void document.documentElement.requestFullscreen?.();
  };
  element("mode").onclick = toggleMode;
  element("screen").onclick = toggleScreen;
  element("next").onclick = () => viewer.nextView();
  element("start").onclick = () => viewer.goTo(0);
  element("close").onclick = () => (element("error").hidden = true);
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const actions: Record<string, () => void> = {
      KeyO: toggleMode,
      KeyF: toggleScreen,
      KeyN: () => viewer.nextView(),
      KeyR: () => viewer.goTo(0),
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
