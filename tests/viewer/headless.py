"""Pictures of cameras from the viewer in a headless Chromium: the page posts them to a server in this process."""

import http.server
import json
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgs.cameras import Camera

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
)  # fmt: skip
# With WebGPU by software, which a machine without graphics card must be asked for: its adapter, and a canvas for it.
WEBGPU_FLAGS = (
    *(flag for flag in FLAGS if flag != "--disable-gpu"),
    *("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"),
    *("--enable-features=Vulkan", "--use-vulkan=swiftshader"),
)
MAX_SECONDS = 240
POST = """const post = (name, body) => fetch("/" + name, { method: "POST", body });"""
# Before anything else of the page: remembers what is written to the console, and makes the page wait a hundred times
# as long for a graphics device, which a slow machine would else not have in time.
PRELUDE = """<script>
  window.written = [];
  const setsTimeout = window.setTimeout;
  window.setTimeout = (job, after) => setsTimeout(job, after >= 1000 ? 100 * after : after);
  for (const kind of ["info", "warn", "error"]) console[kind] = (line) => written.push(kind + ": " + line);
  %s
</script>"""
# Shows each camera and posts its pixels and what drew them; then the text of the error box.
DRIVER = """<script>(async () => {
  %s
  const pause = () => new Promise((resolve) => setTimeout(resolve, 20));
  const text = (id) => document.getElementById(id).textContent;
  const drawnWith = (canvas) => ["webgpu", "webgl2"].find((name) => canvas.getContext(name));
  addEventListener("unhandledrejection", (event) => post("failed", String(event.reason)));
  setsTimeout(() => post("failed", ["not done in time", ...window.written].join("\\n")), %d);
  try {
    const viewer = window.compgsViewer;
    while (!text("error-text") && !text("status").includes(" in ")) await pause();
    await post("seconds", String(performance.now() / 1000));
    const cameras = text("error-text") ? [] : %s;
    const drawn = [];
    for (const [i, camera] of cameras.entries()) {
      await window.beforeCamera?.(i);
      await viewer.show(camera);
      const copy = new OffscreenCanvas(camera.width, camera.height).getContext("2d");
      copy.drawImage(viewer.canvas, 0, 0);
      drawn.push(drawnWith(viewer.canvas));
      await post("picture" + i, copy.getImageData(0, 0, camera.width, camera.height).data);
    }
    await post("drawn", JSON.stringify(drawn));
    await post("console", JSON.stringify(window.written));
    await post("done", text("error-title") + ": " + text("error-text"));
  } catch (error) {
    await post("failed", [error.stack ?? error, ...window.written].join("\\n"));
  }
})();</script></body>"""
# Says whether WebGPU can make a canvas red.
RED = """<!doctype html><script>(async () => {
  %s
  try {
    const device = await (await navigator.gpu.requestAdapter()).requestDevice();
    const context = new OffscreenCanvas(8, 8).getContext("webgpu");
    context.configure({ device, format: "rgba8unorm" });
    const view = context.getCurrentTexture().createView();
    const encoder = device.createCommandEncoder();
    const color = { view, clearValue: [1, 0, 0, 1], loadOp: "clear", storeOp: "store" };
    encoder.beginRenderPass({ colorAttachments: [color] }).end();
    device.queue.submit([encoder.finish()]);
    const copy = new OffscreenCanvas(8, 8).getContext("2d");
    copy.drawImage(context.canvas, 0, 0);
    await post("done", String(copy.getImageData(4, 4, 1, 1).data));
  } catch (error) {
    await post("done", String(error));
  }
})();</script>"""


@dataclass(frozen=True)
class Visit:
    """`pictures`: of the cameras, [H, W, 3] uint8; `drawn`: what drew them, "webgpu" or "webgl2"; `error`: of the
    page's error box, ": " if there is none; `seconds`: until the page showed the whole scene or an error; `console`:
    lines, each with its kind."""

    pictures: list[np.ndarray]
    drawn: list[str]
    error: str
    seconds: float
    console: list[str]


def visit(
    browser: str,
    folder: Path,
    page: bytes,
    cameras: list[Camera],
    flags: tuple[str, ...] = FLAGS,
    query: str = "",
    script: str = "",
) -> Visit:
    """Opens the page and shows the cameras, one after the other.

    `folder`: for the browser. `flags`: of the browser. `query`: of the page's address, "?name=value".
    `script`: runs before those of the page; a function `beforeCamera(index)` of it is called, and waited for, before
    each camera.
    """
    described = json.dumps([_described(camera) for camera in cameras])
    driver = DRIVER % (POST, 1000 * (MAX_SECONDS - 20), described)  # it says why before this process gives up
    page = page.replace(b"<head>", b"<head>" + (PRELUDE % script).encode(), 1)
    page = page.replace(b"</body>", driver.encode())
    got = _posted(browser, folder, page, flags, query)
    return Visit(
        pictures=[_picture(got[f"picture{i}"], c) for i, c in enumerate(cameras) if f"picture{i}" in got],
        drawn=json.loads(got["drawn"]),
        error=got["done"].decode(),
        seconds=float(got["seconds"]),
        console=json.loads(got["console"]),
    )


def offers_webgpu(browser: str, folder: Path) -> bool:
    """Whether a page can draw with WebGPU, with WEBGPU_FLAGS."""
    return _posted(browser, folder, (RED % POST).encode(), WEBGPU_FLAGS)["done"] == b"255,0,0,255"


def _posted(
    browser: str, folder: Path, page: bytes, flags: tuple[str, ...], query: str = ""
) -> dict[str, bytes]:
    """What a page posts, by name, until it posts "done". Fails where it posts "failed", or nothing for long."""
    got: dict[str, bytes] = {}
    finished = threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            found = self.path == "/" + query
            self.send_response(200 if found else 404)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(page if found else b"")

        def do_POST(self) -> None:
            got[self.path[1:]] = self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(204)
            self.end_headers()
            if self.path in ("/done", "/failed"):
                finished.set()

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/{query}"
        process = subprocess.Popen(
            [browser, *flags, f"--user-data-dir={folder}", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            ended = finished.wait(MAX_SECONDS)
        finally:
            process.terminate()
            process.wait()
            server.shutdown()
    assert ended, f"the page did not finish within {MAX_SECONDS} s; it sent {sorted(got)}"
    assert "failed" not in got, got["failed"].decode()
    return got


def _described(camera: Camera) -> dict[str, object]:
    lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return lens | {"worldToCamera": camera.world_to_camera.ravel().tolist()}


def _picture(pixels: bytes, camera: Camera) -> np.ndarray:
    return np.frombuffer(pixels, np.uint8).reshape(camera.height, camera.width, 4)[:, :, :3]
