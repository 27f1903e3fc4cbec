"""The package of web/, installed from its tarball into an empty project: .cgs files in Spark, PlayCanvas, three.js."""

import http.server
import json
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs.cameras import Camera
from compgs.codec.viewpoint_cameras import viewpoints_from_cameras
from compgs.codec.writer import write_content
from compgs.errors import TruncatedSection
from compgs.model.hybrid_model import HybridModel
from compgs.render.rasterize import rasterize
from compgs.render.render_model import settings_of

from .conftest import WEB
from .devtools import Page, tab, until
from .test_picture import CONTENTS, looking, psnr

sys.path.append(str(WEB.parent / "benchmarks"))
from made_heads import VIEW_DIM, make_heads

pytestmark = pytest.mark.slow
LEAST_DB = 35.0
WIDTH, HEIGHT = 240, 160
ENGINES = ("spark", "playcanvas", "three")
SCENES = ("far away", "hardly dilated")
# Splats are drawn by software on a machine that does other things, too.
MAX_SECONDS = 180
# What a page that goes wrong says is in the message of the test.
WATCH = """window.said = [];
for (const kind of ["warn", "error"]) console[kind] = (...words) => said.push(words.join(" "));
const fail = (reason) => said.push((window.failed = String(reason?.stack ?? reason)));
addEventListener("error", ({ message }) => fail(message));
addEventListener("unhandledrejection", ({ reason }) => fail(reason));"""


@pytest.fixture(scope="module")
def project(node: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty project in which the package is installed, and the engines that it leaves to others."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(WEB, folder / "web", ignore=shutil.ignore_patterns("node_modules", "dist"))
    (folder / "web" / "node_modules").symlink_to(WEB / "node_modules")
    tables = Path("src", "compgs", "codec", "gaussian_tables.bin")  # beside web/, which embeds it
    (folder / tables).parent.mkdir(parents=True)
    shutil.copyfile(WEB.parent / tables, folder / tables)
    npm = shutil.which("npm")
    assert npm is not None
    npm_in(folder / "web", npm, "pack", "--pack-destination", str(folder))
    (tarball,) = folder.glob("*.tgz")
    project = folder / "project"
    project.mkdir()
    (project / "package.json").write_text('{ "name": "empty", "private": true, "type": "module" }')
    npm_in(project, npm, "install", "--offline", "--no-audit", "--no-fund", str(tarball))
    for name in ("three", "@sparkjsdev", "playcanvas", "@types", "@webgpu", "fflate"):
        (project / "node_modules" / name).symlink_to(WEB / "node_modules" / name)
    return project


def npm_in(folder: Path, *command: str) -> None:
    done = subprocess.run(
        command, cwd=folder, timeout=600, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert done.returncode == 0, done.stdout[-6000:]


def bundled(node: str, project: Path, entry: Path, *options: str) -> bytes:
    """A script with all that it imports, as a bundler makes it."""
    out = entry.with_suffix(".bundle.js")
    esbuild = str(WEB / "node_modules" / "esbuild" / "bin" / "esbuild")
    command = [node, esbuild, str(entry), "--bundle", "--format=esm", f"--outfile={out}", *options]
    npm_in(project, *command, "--log-level=warning", "--target=es2022")
    return out.read_bytes()


def readme_lines(engine: str) -> str:
    """The lines of the README that show a file in an engine."""
    found = re.search(rf"```js {engine}\n(.*?)```", (WEB / "README.md").read_text(encoding="utf-8"), re.S)
    assert found is not None
    return found[1]


@dataclass
class Site:
    """Files by their paths. `held`: bytes of scene.cgs that are sent at once; the rest when `release` is set."""

    files: dict[str, bytes]
    address: str = ""
    held: int | None = None
    release: threading.Event = None  # type: ignore[assignment]


@contextmanager
def served(files: dict[str, bytes], held: int | None = None) -> Iterator[Site]:
    site = Site(files, held=held, release=threading.Event())
    kinds = {".html": "text/html", ".js": "text/javascript", ".cgs": "model/vnd.compgs"}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.split("?")[0]
            body = site.files.get(path)
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Type", kinds.get(Path(path).suffix, "application/octet-stream"))
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            if body and site.held is not None and path.endswith(".cgs"):
                self.wfile.write(body[: site.held])
                self.wfile.flush()
                site.release.wait(MAX_SECONDS)
                body = body[site.held :]
            self.wfile.write(body or b"")

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        site.address = f"http://127.0.0.1:{server.server_port}"
        yield site
        site.release.set()
        server.shutdown()


@contextmanager
def opened(browser: str, folder: Path, site: Site, path: str) -> Iterator[Page]:
    with tab(browser, folder, WIDTH, HEIGHT) as page:
        page.call("Page.addScriptToEvaluateOnNewDocument", source=WATCH)
        page.open(site.address + path)
        until(lambda: page.ask("document.querySelector('canvas') !== null"), "the page")
        yield page


def page_of(script: bytes) -> dict[str, bytes]:
    html = f"""<!doctype html><style>body {{ margin: 0 }} canvas {{ display: block }}</style>
<canvas width="{WIDTH}" height="{HEIGHT}"></canvas><script type="module" src="main.js"></script>"""
    return {"/index.html": html.encode(), "/main.js": script}


def scene_file(name: str) -> bytes:
    """A made-up file whose colors depend on where one looks from, with two viewpoints of the pages' shape."""
    content = CONTENTS[name]
    middle = content.coordinates.mean(0) * content.voxel_size + np.array(content.world_offset)
    extent = float(np.ptp(content.coordinates, axis=0).max()) * content.voxel_size
    poses = [
        looking(middle + extent * np.array(side), middle) for side in ((0.4, -0.5, -1.1), (1.1, -0.3, 0.2))
    ]
    views = [Camera(c.world_to_camera, 180.0, 180.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT) for c in poses]
    viewpoints = viewpoints_from_cameras(views, (0, -1, 0), content.world_offset)
    d = content.dimensions
    heads = dict(make_heads(np.random.default_rng(5), d))
    weight = heads["appearance.input_weight"]
    seen = slice(d.reference_dim, d.reference_dim + VIEW_DIM)
    weight.values[seen] *= 4
    return write_content(replace(content, viewpoints=viewpoints, heads=tuple(heads.items())))


def decoded(data: bytes, folder: Path, prefix: int | None = None) -> HybridModel:
    path = folder / "scene.cgs"
    path.write_bytes(data)
    return compgs.decode(path) if prefix is None else compgs.decode(path, prefix=prefix)


def coarsest(data: bytes, folder: Path) -> tuple[HybridModel, int]:
    """The first scene in a file that arrives, and of how many bytes it is, to within a hundred."""
    for prefix in range(0, len(data), 100):
        with suppress(TruncatedSection):
            return decoded(data, folder, prefix), prefix
    raise AssertionError("no beginning of the file is a scene")


def settles_to(page: Page, model: HybridModel, view: int = 0) -> None:
    """Waits until the page's picture is the renderer's of one of the file's viewpoints."""
    expected = np.rint(np.clip(compgs.render(model, model.viewpoints[view]).image, 0, 1) * 255)
    assert expected.std() > 10  # something is there to see
    best = 0.0
    end = time.monotonic() + MAX_SECONDS
    while time.monotonic() < end:
        best = max(best, psnr(page.picture(), expected))
        if best >= LEAST_DB:
            return
        time.sleep(0.1)
    raise AssertionError(f"{best:.1f} dB at best; the page says: {page.ask('said.join()')}")


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("engine", ENGINES)
def test_five_lines_show_a_file(
    engine: str, name: str, node: str, browser: str, project: Path, tmp_path: Path
) -> None:
    lines = readme_lines(engine)
    assert len(lines.splitlines()) == 5
    entry = project / f"{engine}.js"
    entry.write_text(lines)
    data = scene_file(name)
    model = decoded(data, tmp_path)
    with (
        served(page_of(bundled(node, project, entry)) | {"/scene.cgs": data}) as site,
        opened(browser, tmp_path / "browser", site, "/index.html") as page,
    ):
        settles_to(page, model)
        assert page.ask("said.join()") == ""


@pytest.mark.parametrize("engine", ENGINES)
def test_colors_follow_the_camera_of_the_example_pages(
    engine: str, node: str, browser: str, project: Path, tmp_path: Path
) -> None:
    shutil.copytree(WEB / "examples" / engine, project / "examples" / engine)
    entry = project / "examples" / engine / "main.js"
    data = scene_file("paired")
    model = decoded(data, tmp_path)
    first, second = model.viewpoints[:2]
    with_old_colors = rasterize(model.gaussians(first), second, settings_of(model)).image
    assert psnr(255 * with_old_colors, 255 * compgs.render(model, second).image) < LEAST_DB - 5
    files = {
        "/index.html": entry.with_name("index.html").read_bytes(),
        "/main.js": bundled(node, project, entry),
        "/scene.cgs": data,
    }
    with (
        served(files) as site,
        opened(browser, tmp_path / "browser", site, "/index.html?url=/scene.cgs") as page,
    ):
        settles_to(page, model)
        page.call("Input.dispatchKeyEvent", type="keyDown", key="2")
        settles_to(page, model, 1)
        assert until(lambda: page.ask("window.splats?.isSettled"), "colors of the camera at hand")


@pytest.mark.parametrize("engine", ENGINES)
def test_the_beginning_of_a_file_is_shown_before_the_rest(
    engine: str, node: str, browser: str, project: Path, tmp_path: Path
) -> None:
    entry = project / f"{engine}_coarse.js"
    entry.write_text(readme_lines(engine))
    data = scene_file("paired")
    whole = decoded(data, tmp_path)
    coarse, held = coarsest(data, tmp_path)
    assert 0 < coarse.anchors < whole.anchors
    with (
        served(page_of(bundled(node, project, entry)) | {"/scene.cgs": data}, held) as site,
        opened(browser, tmp_path / "browser", site, "/index.html") as page,
    ):
        settles_to(page, coarse)
        site.release.set()
        settles_to(page, whole)


REGISTERED = {
    "spark": """import { LoadingManager } from "three";
import { CgsLoader, CgsMesh, registerCgs } from "compgs/spark";
const manager = new LoadingManager();
registerCgs(manager);
const found = (address) => manager.getHandler(address) instanceof CgsLoader;
const names = ["a/scene.cgs", "scene.CGS?x=1", "data:model/vnd.compgs;base64,AA", "scene.ply", "cgs"].map(found);
const data = await (await fetch("scene.cgs")).arrayBuffer();
const meshes = [data, new Uint8Array(data), new Blob([data]), await fetch("scene.cgs")].map((s) => new CgsMesh(s));
const counts = (await Promise.all(meshes.map((mesh) => mesh.complete))).map((mesh) => mesh.numSplats);
const damaged = await new CgsMesh(data.slice(0, 5000)).complete.catch(({ name, message }) => `${name}: ${message}`);
const missing = await new CgsLoader().loadAsync("no.cgs").catch(({ message }) => message);
window.result = JSON.stringify({ names, counts, bytes: data.byteLength, damaged, missing });
""",
    "playcanvas": """import { Application, Asset } from "playcanvas";
import { CgsParser, registerCgs } from "compgs/playcanvas";
const app = new Application(document.querySelector("canvas"));
registerCgs(app);
registerCgs(app);
const parsers = app.loader.getHandler("gsplat").parsers.filter((parser) => parser instanceof CgsParser);
const load = (file) => new Promise((resolve, reject) => {
  const asset = new Asset("scene", "gsplat", file);
  asset.once("load", ({ resource }) => resolve(resource.complete));
  asset.once("error", reject);
  app.assets.add(asset);
  app.assets.load(asset);
});
const data = await (await fetch("scene.cgs")).arrayBuffer();
const url = URL.createObjectURL(new Blob([data]));
const files = [
  { url: "scene.cgs?x=1" },
  { url, filename: "scene.cgs" },
  { url: "a", contents: fetch("scene.cgs"), filename: "b.cgs" },
  { url: "c", contents: await fetch("scene.cgs") },
  { url: "d", contents: new Blob([data], { type: "model/vnd.compgs" }) },
];
const names = [parsers.length];
const counts = [];
for (const file of files) counts.push((await load(file)).numSplats);
const damaged = await load({ url: "e.cgs", contents: data.slice(0, 5000) }).catch(String);
const missing = await load({ url: "no.cgs" }).catch(String);
window.result = JSON.stringify({ names, counts, bytes: data.byteLength, damaged, missing });
""",
}


@pytest.mark.parametrize("engine", REGISTERED)
def test_engines_know_the_files_by_ending_and_media_type_and_name_what_is_wrong(
    engine: str, node: str, browser: str, project: Path, tmp_path: Path
) -> None:
    entry = project / f"{engine}_registered.js"
    entry.write_text(REGISTERED[engine])
    data = scene_file("paired")
    splats = decoded(data, tmp_path).coupled
    with (
        served(page_of(bundled(node, project, entry)) | {"/scene.cgs": data}) as site,
        opened(browser, tmp_path / "browser", site, "/index.html") as page,
    ):
        found = until(lambda: page.ask("window.result || window.failed"), "what the page found")
    assert found.startswith("{"), found
    result = json.loads(found)
    assert result["names"] == ([True, True, True, False, False] if engine == "spark" else [1])
    assert set(result["counts"]) == {splats} and len(result["counts"]) >= 4
    assert "file ends after" in result["damaged"]
    assert "404" in result["missing"]


def test_a_bundler_takes_only_what_is_used(node: str, project: Path) -> None:
    def size(line: str) -> int:
        entry = project / "shaken.js"
        entry.write_text(line)
        outside = ("--external:three", "--external:playcanvas", "--external:@sparkjsdev/spark")
        return len(bundled(node, project, entry, "--minify", *outside))

    assert (
        size('import "compgs"; import "compgs/spark"; import "compgs/playcanvas"; import "compgs/three";')
        < 200
    )
    alone = size('import { decode } from "compgs"; console.log(decode);')
    assert alone < 90_000
    for engine in ENGINES:  # the decoder is there once, as the worker
        assert size(f'export * from "compgs/{engine}";') < alone + 20_000


def test_types_hold_in_a_project_of_their_own(node: str, project: Path) -> None:
    (project / "typed.ts").write_text(
        """import { type DecodedScene, type Gaussians, decode, poseOf } from "compgs";
import { LiveScene } from "compgs/live";
import { CgsMesh, CgsSparkRenderer, registerCgs } from "compgs/spark";
import { type CgsResource, goTo, loadSplats } from "compgs/playcanvas";
import { CgsSplats } from "compgs/three";
import { Viewer } from "compgs/viewer";
import { DefaultLoadingManager, type Mesh, type PerspectiveCamera, type WebGLRenderer } from "three";
import type { AppBase, Entity } from "playcanvas";
import type { SplatMesh } from "@sparkjsdev/spark";

export async function use(app: AppBase, camera: Entity, renderer: WebGLRenderer): Promise<void> {
  const now: DecodedScene = decode(new Uint8Array(8), { prefix: true });
  const later: Promise<DecodedScene> = decode(await fetch("scene.cgs"));
  const seen: Gaussians = (await later).splatsFor({ worldToCamera: poseOf([1, 0, 0, 0], [0, 0, 0]) });
  const mesh: SplatMesh = new CgsMesh("scene.cgs");
  const start: PerspectiveCamera = new CgsMesh(new Blob()).camera(1, 1.5);
  const quads: Mesh = await new CgsSplats("scene.cgs", { sorter: new Worker("sorter.js") }).complete;
  const splats: Entity = await loadSplats(app, "scene.cgs", { onSplats: (found: CgsResource) => found.info });
  goTo(camera, splats, 1);
  registerCgs(DefaultLoadingManager);
  const live = new LiveScene("scene.cgs", {
    layout: "arrays",
    onSplats: ({ geometry }) => geometry.quaternions.length,
    onColors: (colors: Uint8Array) => colors.length,
  });
  live.follow([0, 0, 0]);
  // @ts-expect-error: of this layout there is no such thing
  new LiveScene("scene.cgs", { layout: "spark", onSplats: ({ geometry }) => geometry.means, onColors() {} });
  new Viewer(document.body).open("scene.cgs");
  console.log(now, seen, mesh, start, quads, new CgsSparkRenderer({ renderer }));
}
"""
    )
    tsc = str(WEB / "node_modules" / "typescript" / "bin" / "tsc")
    strict = ("--strict", "--noEmit", "--skipLibCheck", "--moduleResolution", "bundler", "--module", "esnext")
    npm_in(project, node, tsc, *strict, "--target", "es2022", "--lib", "es2022,dom", "typed.ts")
