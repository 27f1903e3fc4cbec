"""The page draws with WebGPU where the browser offers it, the same picture, and with WebGL2 elsewhere."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import compgs
from compgs.cameras import Camera
from compgs.codec.content import FileContent
from compgs.metrics import psnr, to_8bit
from compgs.viewer import html_page
from compgs.viewer.gallery import gallery_server

from .devtools import tab, until
from .headless import WEBGPU_FLAGS, Visit, offers_webgpu, visit
from .test_picture import CONTENTS, SHARED, cameras_around, looking, make_content, written

pytestmark = pytest.mark.slow
LEAST_DB = 45.0
# Opens the page's file once more before the last camera: its splats take the place of those that are there.
OPENS_AGAIN = """window.beforeCamera = async (index) => {
  if (index !== 2) return;
  const text = document.getElementById("scene").textContent;
  compgsViewer.open(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)));
};"""
# Keeps the page's device, and harms it before the second camera.
LOSES = """
const ask = GPUAdapter.prototype.requestDevice;
GPUAdapter.prototype.requestDevice = async function (...wishes) {
  return (window.device = await ask.apply(this, wishes));
};
window.beforeCamera = async (index) => {
  if (index !== 1) return;
  const before = compgsViewer.canvas;
  %s;
  while (compgsViewer.canvas === before && !document.getElementById("error-text").textContent)
    await new Promise((resolve) => setTimeout(resolve, 20));
};"""
DESTROYED = "device.destroy()"
OUT_OF_MEMORY = """device.dispatchEvent(new GPUUncapturedErrorEvent("uncapturederror",
  { error: new GPUOutOfMemoryError("no memory") }))"""
CONTEXT_LOST = """compgsViewer.canvas.getContext("webgl2").getExtension("WEBGL_lose_context").loseContext()"""
HAS_NO_WEBGPU = """Object.defineProperty(navigator, "gpu", { value: undefined });"""
HAS_NO_ADAPTER = "GPU.prototype.requestAdapter = async () => null;"
NEVER_ANSWERS = "GPU.prototype.requestAdapter = () => new Promise(() => {});"
HAS_NO_WEBGL2 = """
const offered = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (name, ...wishes) {
  return name === "webgl2" ? null : offered.call(this, name, ...wishes);
};"""
HAS_SMALL_TEXTURES = """
const asked = WebGL2RenderingContext.prototype.getParameter;
WebGL2RenderingContext.prototype.getParameter = function (name) {
  return name === WebGL2RenderingContext.MAX_TEXTURE_SIZE ? 2 : asked.call(this, name);
};"""
HAS_SMALL_BUFFERS = """
Object.defineProperty(GPUSupportedLimits.prototype, "maxStorageBufferBindingSize", { get: () => 65536 });"""
SHOWS_EARLY = """addEventListener("DOMContentLoaded", () => {
  const worldToCamera = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 20, 0, 0, 0, 1];
  void compgsViewer.show({ width: 90, height: 80, fx: 99, fy: 99, cx: 45, cy: 40, worldToCamera });
});"""
LISTENS = """window.written = [];
console.info = (line) => written.push("info: " + line);"""
# null until there is an error or the whole scene
COMES_TO = """(() => {
  const text = (id) => document.getElementById(id)?.textContent ?? "";
  if (!text("error-text") && !text("status").includes(" in ")) return null;
  const error = text("error-title") + ": " + text("error-text");
  const canvas = window.compgsViewer?.canvas;
  const turns = Boolean(window.compgsViewer?.controls.target);
  return { error, turns, webgl2: Boolean(canvas?.getContext("webgl2")), console: window.written };
})()"""
LOST = "The scene cannot be shown: The browser has taken back its graphics memory (%s). Load the page again."
LEAVE_OUT = "Without renderer= in its address the page takes what there is."


@dataclass(frozen=True)
class Shown:
    data: bytes
    page: bytes
    cameras: list[Camera]
    expected: list[np.ndarray]


@pytest.fixture(scope="module")
def webgpu(browser: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A browser with a WebGPU adapter."""
    if not offers_webgpu(browser, tmp_path_factory.mktemp("adapter")):
        pytest.skip(f"{browser} does not draw with WebGPU, not even by software")
    return browser


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """With an angular dilation, which is other pixels for each camera, also where one renderer follows on another."""
    return from_three_cameras(CONTENTS["dilated"], tmp_path_factory.mktemp("scene"))


def from_three_cameras(content: FileContent, folder: Path) -> Shown:
    """Two from one place outside, then one among the anchors, with splats before and beside it; in three sizes."""
    data = written(content)
    (folder / "scene.cgs").write_bytes(data)
    model = compgs.decode(folder / "scene.cgs")
    outside = cameras_around(content)[0]
    positions = content.coordinates * content.voxel_size
    anchor = positions[np.argmin(np.linalg.norm(positions - positions.mean(0), axis=1))]
    within = looking(anchor, anchor + 7.0)
    cameras = [outside, outside.resized(200, 120), replace(within.resized(90, 120), cx=30.0)]
    expected = [to_8bit(compgs.render(model, camera).image) for camera in cameras]
    return Shown(data, html_page(data, "a scene"), cameras, expected)


def check(seen: Visit, shown: Shown, *drawn: str) -> None:
    """No error, drawn with these, and every picture the renderer's."""
    assert (seen.error, seen.drawn) == (": ", list(drawn))
    for picture, expected in zip(seen.pictures, shown.expected, strict=True):
        assert expected.std() > 10  # something is there to see
        assert psnr(np.ascontiguousarray(picture), expected) >= LEAST_DB


def test_webgpu_draws_what_the_renderer_and_webgl2_do(webgpu: str, tmp_path: Path) -> None:
    content = make_content(14_000, 3, SHARED)  # more splats than the worker colors at once
    shown = from_three_cameras(content, tmp_path)
    pictures = {}
    for name, query in {"webgpu": "", "webgl2": "?renderer=webgl2"}.items():
        folder = tmp_path / name
        seen = visit(webgpu, folder, shown.page, shown.cameras, WEBGPU_FLAGS, query, OPENS_AGAIN)
        check(seen, shown, name, name, name)
        assert seen.console == []
        pictures[name] = np.concatenate([picture.ravel() for picture in seen.pictures]).astype(int)
    assert abs(pictures["webgpu"] - pictures["webgl2"]).max() <= 2


@pytest.mark.parametrize(
    ("harm", "reason"), [(DESTROYED, ""), (OUT_OF_MEMORY, "no memory")], ids=["destroyed", "out of memory"]
)
def test_webgl2_goes_on_where_webgpu_stops(
    harm: str, reason: str, webgpu: str, shown: Shown, tmp_path: Path
) -> None:
    seen = visit(webgpu, tmp_path, shown.page, shown.cameras, WEBGPU_FLAGS, script=LOSES % harm)
    check(seen, shown, "webgpu", "webgl2", "webgl2")
    (line,) = seen.console
    assert line.startswith(f"warn: WebGPU has stopped ({reason}")
    assert line.endswith("). WebGL2 goes on with the drawing.")


def test_a_renderer_that_was_asked_for_is_not_replaced(webgpu: str, shown: Shown, tmp_path: Path) -> None:
    script = LOSES % OUT_OF_MEMORY
    seen = visit(webgpu, tmp_path, shown.page, shown.cameras[:2], WEBGPU_FLAGS, "?renderer=webgpu", script)
    assert (seen.error, seen.drawn) == (LOST % "no memory", ["webgpu", "webgpu"])


def test_nothing_takes_over_from_webgl2(browser: str, shown: Shown, tmp_path: Path) -> None:
    seen = visit(browser, tmp_path, shown.page, shown.cameras[:2], script=LOSES % CONTEXT_LOST)
    assert (seen.error, seen.drawn) == (LOST % "the context is lost", ["webgl2", "webgl2"])


def test_a_scene_too_large_for_webgpu_is_refused(webgpu: str, shown: Shown, tmp_path: Path) -> None:
    seen = visit(webgpu, tmp_path, shown.page, [], WEBGPU_FLAGS, script=HAS_SMALL_BUFFERS)
    assert "The scene has more splats than the 1,365 that this device's graphics can hold." in seen.error


@pytest.fixture(scope="module")
def opened(
    browser: str, shown: Shown, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[str, str], dict[str, Any]]]:
    """Opens the scene in the gallery, after a script and with more of an address; gives what it comes to."""
    folder = tmp_path_factory.mktemp("gallery")
    (folder / "scene.cgs").write_bytes(shown.data)
    with (
        gallery_server(folder, "127.0.0.1", 0) as server,
        tab(browser, tmp_path_factory.mktemp("browser"), 300, 200) as page,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def come_to(script: str, query: str) -> dict[str, Any]:
            source = f"{LISTENS}\n{script}"
            added = page.call("Page.addScriptToEvaluateOnNewDocument", source=source)
            page.open(f"http://127.0.0.1:{server.server_port}/view?url=%2Ffiles%2Fscene.cgs{query}")
            found: dict[str, Any] = until(lambda: page.ask(COMES_TO), "the scene or an error")
            page.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
            return found

        yield come_to
        server.shutdown()


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        (HAS_NO_WEBGPU, "this browser has no WebGPU"),
        (HAS_NO_ADAPTER, "this browser finds no graphics device for WebGPU"),
        (NEVER_ANSWERS, "WebGPU takes too long to start"),
    ],
    ids=["no WebGPU", "no adapter", "no answer"],
)
def test_webgl2_draws_where_there_is_no_webgpu(
    script: str, reason: str, opened: Callable[[str, str], dict[str, Any]]
) -> None:
    line = f"info: Drawing with WebGL2: {reason}."
    assert opened(script, "") == {"error": ": ", "turns": True, "webgl2": True, "console": [line]}


def test_a_camera_that_is_shown_before_the_scene_is_there_can_be_turned(
    opened: Callable[[str, str], dict[str, Any]],
) -> None:
    found = opened(SHOWS_EARLY, "")
    assert found["error"] == ": " and found["turns"]


@pytest.mark.parametrize(
    ("script", "query", "error"),
    [
        (
            HAS_NO_ADAPTER,
            "&renderer=webgpu",
            "This browser cannot show the scene: The viewer was asked to draw with webgpu, but this browser finds no "
            f"graphics device for WebGPU. {LEAVE_OUT}",
        ),
        (
            HAS_NO_WEBGL2,
            "&renderer=webgl2",
            "This browser cannot show the scene: The viewer was asked to draw with webgl2, but this browser has no "
            f"WebGL2. {LEAVE_OUT}",
        ),
        (
            HAS_NO_WEBGPU + HAS_NO_WEBGL2,
            "",
            "This browser cannot show the scene: The viewer draws with WebGPU or WebGL2: this browser has no WebGPU, "
            "and this browser has no WebGL2. Try a current version of Firefox, Chrome, Edge or Safari.",
        ),
        (
            "",
            "&renderer=opengl",
            "The scene cannot be shown: The address asks for renderer=opengl; there are webgpu and webgl2.",
        ),
        (
            HAS_SMALL_TEXTURES,
            "&renderer=webgl2",
            "The scene cannot be shown: The scene has more splats than the 0 that this device's graphics can hold.",
        ),
    ],
    ids=["webgpu", "webgl2", "neither", "opengl", "too many splats"],
)
def test_the_page_says_what_cannot_draw(
    script: str, query: str, error: str, opened: Callable[[str, str], dict[str, Any]]
) -> None:
    assert opened(script, query)["error"] == error
