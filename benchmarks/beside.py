"""Beside what people would pick instead: one scene as a .cgs file, and as .spz and .sog of several origins: one table.

    python benchmarks/beside.py SCENE -o OUT --ours FILE.cgs [--plain 3DGS.ply] [-r 2] [--settle 500]
        [--refine 100] [--lpips-weights FILE] [--mbit 10] [--times 3] [--no-browser]

The rows: the .cgs file; the .spz and .sog that `compgs export` makes of it; with --plain (from `compgs train --method
3dgs`) the same splats as .spz and .sog, and four of five of them pruned, the others settled for --settle steps (the
methods pruned-spz and pruned-sog). Without --plain the table says that these are missing. Bytes are those of the files;
PSNR, SSIM and LPIPS those of `compgs evaluate` on the held-out views; a file in the folder of its run is not measured
again. Milliseconds are from the beginning of a page to the first picture with anything in it, and to the last change of
the picture, in a headless Chromium that draws with Spark by software, while the file comes at --mbit megabits a second:
medians of --times visits. "Drawn" compares the last picture with this program's of the same file. What OUT has already
is not made again. Needs Node and the packages of web/ (`make web`), chromium and the Python package websockets.
"""

import argparse
import hashlib
import http.server
import json
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import compgs
from compgs import metrics
from compgs.cameras import Camera
from compgs.methods import settings_of, train
from compgs.methods.pruned import PrunedSection

ROOT = Path(__file__).resolve().parents[1]
WEB = ROOT / "web"
sys.path.append(str(ROOT / "tests"))
PIECE_SECONDS = 0.02  # of a file, at once
# Without a change of the picture, after which it was the last.
QUIET_SECONDS = 3
QUIET_PICTURES = 5
MOST_SECONDS = 900

# Shows a file in Spark from one camera, and notes when the picture changed, by thumbnails, as looking at them takes no
# time.
PAGE = """
import { Color, PerspectiveCamera, Quaternion, Scene, SRGBColorSpace, Vector3, WebGLRenderer } from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { CgsMesh, CgsSparkRenderer } from "compgs/spark";
const { file, center, rotation, fov, width, height, background } = window.asked;
const canvas = document.querySelector("canvas");
const renderer = new WebGLRenderer({ canvas, preserveDrawingBuffer: true });
renderer.setSize(width, height, false);
const scene = new Scene();
scene.background = new Color().setRGB(...background, SRGBColorSpace);
const isOurs = file.endsWith(".cgs");
scene.add(isOurs ? new CgsSparkRenderer({ renderer }) : new SparkRenderer({ renderer }));
const mesh = isOurs ? new CgsMesh(file) : new SplatMesh({ url: file });
if (file.endsWith(".spz")) mesh.quaternion.set(1, 0, 0, 0); // its axes: y up
scene.add(mesh);
const camera = new PerspectiveCamera(fov, width / height, 0.01, 1e5);
camera.position.set(...center);
camera.quaternion.set(...rotation);
(isOurs ? mesh.complete : mesh.initialized).then(
  () => (window.isLoaded = true),
  (error) => (window.failed = String(error)),
);
const small = new OffscreenCanvas(48, 48).getContext("2d", { willReadFrequently: true });
let before = null;
window.first = window.last = null;
window.unchanged = 0; // pictures of the whole file since the last change
renderer.setAnimationLoop(() => {
  renderer.render(scene, camera);
  small.drawImage(canvas, 0, 0, 48, 48);
  const now = small.getImageData(0, 0, 48, 48).data;
  if (before && now.some((value, i) => Math.abs(value - before[i]) > 1)) {
    window.last = performance.now();
    window.first ??= window.last;
    window.unchanged = 0;
  } else if (window.isLoaded && (!isOurs || mesh.isSettled)) window.unchanged++;
  before = now;
});
"""


# Rows that need the splats of plain 3DGS: names, and files in OUT without their ending.
PLAIN = (("3DGS", "3dgs"), ("3DGS pruned to a fifth", "pruned"))
KINDS = ("spz", "sog")


@dataclass(frozen=True)
class Entry:
    """One row: a file, and where it came from."""

    name: str
    file: Path


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--ours", type=Path, required=True)
    parser.add_argument("--plain", type=Path)
    parser.add_argument("-r", "--downscale", type=int, default=1)
    parser.add_argument("--settle", type=int, default=500)
    parser.add_argument("--refine", type=int, default=100)
    parser.add_argument("--lpips-weights", type=Path)
    parser.add_argument("--mbit", type=float, default=10.0)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--no-browser", action="store_true")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    entries = list(files(options))
    measured = [measures(entry, options) for entry in entries]
    shown: list[dict[str, float]] = [{} for _ in entries]
    if not options.no_browser:
        shown = in_browser(entries, compgs.decode(options.ours), options)
    rows = [
        {"name": e.name, "file": e.file.name, **m, **s}
        for e, m, s in zip(entries, measured, shown, strict=True)
    ]
    if options.plain is None:
        rows += [{"name": f"{name}, `.{kind}`", "missing": True} for name, _ in PLAIN for kind in KINDS]
    (options.output / "beside.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


def files(options: argparse.Namespace) -> Iterator[Entry]:
    """Makes what OUT does not have yet."""
    out = options.output
    yield Entry("ours, `.cgs`", options.ours)
    ply = out / "ours.ply"
    if not ply.is_file():
        compgs.export(options.ours, ply, refine=options.refine)
    for kind in KINDS:
        yield Entry(f"ours, exported to `.{kind}`", written(ply, out / f"ours.{kind}"))
    if options.plain is None:
        return
    pruned = out / "pruned.ply"
    if not pruned.is_file():
        config = replace(settings_of("pruned-spz"), pruned=PrunedSection(settled=1.0))  # type: ignore[call-arg]
        config = replace(config, training=replace(config.training, steps=options.settle))
        model = train(read(options), config, method="pruned-spz", splats=options.plain)
        compgs.export(model, pruned)
    for (name, stem), splats in zip(PLAIN, (options.plain, pruned), strict=True):
        for kind in KINDS:
            yield Entry(f"{name}, `.{kind}`", written(splats, out / f"{stem}.{kind}"))


def written(source: Path, target: Path) -> Path:
    """The same splats in another format."""
    if not target.is_file():
        compgs.export(source, target)
    return target


def read(options: argparse.Namespace) -> Any:
    return compgs.load_scene(options.scene, downscale=options.downscale)


def measures(entry: Entry, options: argparse.Namespace) -> dict[str, Any]:
    """Bytes and quality of a file on the held-out views."""
    results = of_its_run(entry.file)
    if results is None or (options.lpips_weights and results["lpips"] is None):
        folder = options.output / "evaluation" / entry.file.name
        if not (folder / "results.json").is_file():
            compgs.evaluate(entry.file, read(options), output=folder, lpips=options.lpips_weights or False)
        results = json.loads((folder / "results.json").read_text())
    return {name: results[name] for name in ("bytes", "psnr", "ssim", "lpips", "lpips_3dgs")}


def of_its_run(file: Path) -> dict[str, Any] | None:
    """What the run that made a file has measured of it; None if it is in no run's folder, or another file."""
    path = file.parent / "results.json"
    results = json.loads(path.read_text()) if path.is_file() else {}
    return results if results.get("sha256") == hashlib.sha256(file.read_bytes()).hexdigest() else None


def in_browser(entries: list[Entry], model: Any, options: argparse.Namespace) -> list[dict[str, float]]:
    """Milliseconds to the first and to the last picture."""
    from viewer import devtools
    from viewer.devtools import tab, until

    devtools.MAX_SECONDS = MOST_SECONDS  # a page that draws by software may answer late
    browser = shutil.which("chromium")
    if browser is None:
        raise SystemExit("no chromium on PATH")
    script = bundled(options.output)
    camera = model.viewpoints[0]
    found = []
    for entry in entries:
        visits = []
        for number in range(options.times):
            folder = options.output / "browser" / f"{entry.file.name}.{number}"
            with (
                served(page(entry, camera, model.background), script, entry.file, options.mbit) as address,
                tab(browser, folder, camera.width, camera.height) as opened,
            ):
                opened.open(address)

                def settled(opened: Any = opened, entry: Entry = entry) -> "tuple[float, float] | None":
                    if failed := opened.ask("window.failed"):
                        raise SystemExit(f"{entry.file.name}: {failed}")
                    first, last, now, unchanged = opened.ask(
                        "window.first ? [first, last, performance.now(), unchanged] : [0, 0, 0, 0]"
                    )
                    is_last = now - last > 1000 * QUIET_SECONDS and unchanged >= QUIET_PICTURES
                    return (first, last) if first and is_last else None

                visits.append(until(settled, f"a picture of {entry.file.name}", MOST_SECONDS))
                drawn = opened.picture()
            shutil.rmtree(folder, ignore_errors=True)
        first, last = (statistics.median(values) for values in zip(*visits, strict=True))
        expected = metrics.to_8bit(
            compgs.render(compgs.open_scene(entry.file, background=model.background), camera).image
        )
        found.append({"first_ms": first, "last_ms": last, "drawn_db": metrics.psnr(drawn, expected)})
        print(f"{entry.file.name}: {first:.0f} ms, {last:.0f} ms", file=sys.stderr, flush=True)
    return found


def bundled(folder: Path) -> bytes:
    """The page's script with Spark and the decoder, as a bundler makes it."""
    node = shutil.which("node")
    if node is None or not (WEB / "dist" / "spark.js").is_file():
        raise SystemExit("the package of web/ is not built: run make web")
    esbuild = str(WEB / "node_modules" / "esbuild" / "bin" / "esbuild")
    out = folder / "page.js"
    command = [
        node,
        esbuild,
        "--bundle",
        "--format=esm",
        "--target=es2022",
        "--minify",
        f"--outfile={out.resolve()}",
    ]
    subprocess.run(command, input=PAGE.encode(), cwd=WEB, check=True, stdout=subprocess.DEVNULL)
    return out.read_bytes()


def page(entry: Entry, camera: Camera, background: tuple[float, float, float]) -> bytes:
    """The page of a file, seen from a camera."""
    x, y, z, w = quaternion_of(camera)
    asked = {
        "file": f"scene{entry.file.suffix}",
        "center": camera.center.tolist(),
        "rotation": [x, y, z, w],
        "fov": vertical_degrees(camera),
        "width": camera.width,
        "height": camera.height,
        "background": list(background),
    }
    return f"""<!doctype html><style>body {{ margin: 0 }} canvas {{ display: block }}</style><canvas></canvas>
<script>window.asked = {json.dumps(asked)};
addEventListener("unhandledrejection", ({{ reason }}) => (window.failed = String(reason)));</script>
<script type="module" src="page.js"></script>""".encode()


def quaternion_of(camera: Camera) -> tuple[float, float, float, float]:
    """x, y, z, w of the rotation camera to world, for a camera that has y up and looks along -z."""
    from scipy.spatial.transform import Rotation

    turned = camera.world_to_camera[:3, :3].T.copy()
    turned[:, 1:] *= -1
    x, y, z, w = Rotation.from_matrix(turned).as_quat()
    return float(x), float(y), float(z), float(w)


def vertical_degrees(camera: Camera) -> float:
    from math import atan, degrees

    return degrees(2 * atan(camera.height / (2 * camera.fy)))


@contextmanager
def served(html: bytes, script: bytes, file: Path, mbit: float) -> Iterator[str]:
    """The address of a page whose script is there at once, and whose file comes at a speed."""
    piece = max(1, round(mbit * 1e6 / 8 * PIECE_SECONDS))

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.split("?")[0]
            known = {"/": ("text/html", html), "/page.js": ("text/javascript", script)}
            kind, body = known.get(path, ("application/octet-stream", file.read_bytes()))
            if path != f"/scene{file.suffix}" and path not in known:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if path in known:
                self.wfile.write(body)
                return
            start = time.monotonic()
            for number, at in enumerate(range(0, len(body), piece), 1):
                self.wfile.write(body[at : at + piece])
                time.sleep(max(0.0, start + number * PIECE_SECONDS - time.monotonic()))

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| file | bytes | times ours | PSNR, dB | SSIM | LPIPS | first picture, ms | last picture, ms | drawn, dB |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        if row.get("missing"):
            lines.append(f"| {row['name']} | missing | | | | | | | |")
            continue
        lpips = "" if row["lpips_3dgs"] is None else f"{row['lpips_3dgs']:.3f}"
        first, last = (f"{row[name]:,.0f}" if name in row else "" for name in ("first_ms", "last_ms"))
        drawn = f"{row['drawn_db']:.1f}" if "drawn_db" in row else ""
        lines.append(
            f"| {row['name']} | {row['bytes']:,} | {row['bytes'] / rows[0]['bytes']:.1f} | {row['psnr']:.2f} "
            f"| {row['ssim']:.4f} | {lpips} | {first} | {last} | {drawn} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
