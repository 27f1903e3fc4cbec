"""Pictures of cameras from the viewer in a headless Chromium: the page posts them to a server in this process."""

import http.server
import json
import subprocess
import threading
from pathlib import Path

import numpy as np

from compgs.cameras import Camera

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
)  # fmt: skip
MAX_SECONDS = 240
# Shows each camera and posts its pixels, bottom row first; then the text of the error box.
DRIVER = """<script>(async () => {
  const post = (name, body) => fetch("/" + name, { method: "POST", body });
  const pause = () => new Promise((resolve) => setTimeout(resolve, 20));
  const text = (id) => document.getElementById(id).textContent;
  addEventListener("unhandledrejection", (event) => post("failed", String(event.reason)));
  try {
    const viewer = window.compgsViewer;
    while (!text("error-text") && !text("status").includes(" in ")) await pause();
    await post("seconds", String(performance.now() / 1000));
    const cameras = text("error-text") ? [] : %s;
    for (const [i, camera] of cameras.entries()) {
      await viewer.show(camera);
      const gl = viewer.canvas.getContext("webgl2");
      const pixels = new Uint8Array(4 * camera.width * camera.height);
      gl.readPixels(0, 0, camera.width, camera.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      await post("picture" + i, pixels);
    }
    await post("done", text("error-title") + ": " + text("error-text"));
  } catch (error) {
    await post("failed", String(error.stack ?? error));
  }
})();</script></body>"""


def visit(browser: str, folder: Path, page: bytes, cameras: list[Camera]) -> tuple[list[np.ndarray], str]:
    """Pictures [H, W, 3] uint8 of the cameras, and what the page's error box says. `folder`: for the browser."""
    pictures, error, _ = timed_visit(browser, folder, page, cameras)
    return pictures, error


def timed_visit(
    browser: str, folder: Path, page: bytes, cameras: list[Camera]
) -> tuple[list[np.ndarray], str, float]:
    """The same, and the seconds from the page's first byte until it shows the whole scene (or an error)."""
    driver = DRIVER % json.dumps([_described(camera) for camera in cameras])
    page = page.replace(b"</body>", driver.encode())
    got: dict[str, bytes] = {}
    finished = threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/" else 404)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(page if self.path == "/" else b"")

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
        address = f"http://127.0.0.1:{server.server_port}/"
        process = subprocess.Popen(
            [browser, *FLAGS, f"--user-data-dir={folder}", address],
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
    pictures = [_picture(got[f"picture{i}"], c) for i, c in enumerate(cameras) if f"picture{i}" in got]
    return pictures, got["done"].decode(), float(got["seconds"])


def _described(camera: Camera) -> dict[str, object]:
    lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return lens | {"worldToCamera": camera.world_to_camera.ravel().tolist()}


def _picture(pixels: bytes, camera: Camera) -> np.ndarray:
    return np.frombuffer(pixels, np.uint8).reshape(camera.height, camera.width, 4)[::-1, :, :3]
