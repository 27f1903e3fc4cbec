"""A city of 3 million primitives in the page, fetched by what is in view, against loading all of it.

    python benchmarks/tiles.py city FILE.cgs --side 15 --largest 0.8 --folder city.tiles --memory
    python benchmarks/levels.py city.tiles [--size 1280x800] [--caps 1000000 3000000 all] [--stops 6] [--megabits 20]
    python benchmarks/levels.py city.tiles --browser --size 640x400 --output FOLDER

A visitor opens the city at one corner and walks across it in some stops, behind a line of `--megabits` with 40 ms to
the server and back. For each cap on splats: bytes, processor seconds and seconds until the first view is sharp, the
same for the stops of the walk, what each picture costs while the camera moves, and memory. `all` is a page that loads
every tile whole before its view is sharp.

`--pictures` compares the views with those of everything, rendered by the package by the same rule.

The visitor is `levels.mjs`: all that the page does, but without drawing, which depends on the graphics card. With
`--browser` it is a headless Chromium, which draws by software; its pictures are compared with those of `all`.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image
from tiles import flight

from compgs.cameras import Camera
from compgs.formats.tiled import MANIFEST, MOST_NUMBER, read_manifest
from compgs.formats.tiled_scene import open_tiles
from compgs.metrics import psnr, to_8bit
from compgs.render import render
from compgs.viewer.gallery import GalleryHandler
from compgs.viewer.thumbnails import Thumbnails

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))
from tests.viewer import devtools  # noqa: E402
from tests.viewer.devtools import Page, tab, until  # noqa: E402

ALL = "all"
COLUMNS = (
    *(
        "at most",
        "splats at the end",
        "first view: MB",
        "processor s",
        "s",
        "walk: MB",
        "processor s a stop",
        "s a stop",
    ),
    *("moving: processor s a picture", "pictures a second", "memory"),
)
LATENCY = 0.04  # seconds to the server and back
PIECE = 1 << 14  # bytes that are sent at once
MOST_SECONDS = 900  # until a view is sharp
MOVING_SECONDS = 8.0
OPEN = """window.sharp = null; window.began = performance.now();
compgsViewer.open(%s);
compgsViewer.show(%s).then(() => (window.sharp = (performance.now() - window.began) / 1000));"""
SHOW = """window.sharp = null; window.began = performance.now();
compgsViewer.show(%s).then(() => (window.sharp = (performance.now() - window.began) / 1000));"""
# Turns to and fro as somebody does who drags, and counts the pictures.
MOVE = """window.pictures = null; (async () => {
  const { target } = compgsViewer.controls;
  const began = performance.now();
  let count = 0;
  while (performance.now() - began < %d) {
    target.pose.turn(target.up, 0.01 * Math.cos(count / 5));
    compgsViewer.move();
    await new Promise(requestAnimationFrame);
    count++;
  }
  window.pictures = { count, seconds: (performance.now() - began) / 1000 };
})();"""


@dataclass
class Server:
    address: str
    sent: int = 0  # bytes of tiles and manifests


class Line:
    """A line to the browser of so many bytes a second, which all answers share."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._lock = threading.Lock()
        self._free = 0.0  # when what has been sent so far will have arrived

    def send(self, count: int) -> None:
        with self._lock:
            self._free = max(self._free, time.monotonic()) + count / self._rate
            arrives = self._free
        time.sleep(max(0.0, arrives - time.monotonic()))


@contextmanager
def serving(folder: Path, megabits: float) -> Iterator[Server]:
    """A folder of scenes, by a server that counts what it sends, on a slow line."""
    server, line = Server(""), Line(megabits * 125_000)

    class Counting(GalleryHandler):
        def do_GET(self) -> None:
            if self.path.startswith("/files/"):
                time.sleep(LATENCY)
                write = self.wfile.write

                def slowly(data: bytes) -> int:
                    for at in range(0, len(data), PIECE):
                        line.send(len(data[at : at + PIECE]))
                        write(data[at : at + PIECE])
                    return len(data)

                self.wfile.write = slowly  # type: ignore[method-assign]
            super().do_GET()

        def send_header(self, name: str, value: str) -> None:
            if name == "Content-Length" and self.path.startswith("/files/"):
                server.sent += int(value)
            super().send_header(name, value)

    class Quiet(ThreadingHTTPServer):
        def handle_error(self, request: object, client_address: object) -> None:
            """Browsers that leave say nothing."""

    with Quiet(("127.0.0.1", 0), partial(Counting, folder.resolve(), Thumbnails())) as http:
        threading.Thread(target=http.serve_forever, daemon=True).start()
        server.address = f"http://127.0.0.1:{http.server_port}"
        yield server
        http.shutdown()


def without_levels(city: Path, folder: Path) -> Path:
    """The city with a manifest that knows no levels, and tiles that reach everywhere: all of them are wanted whole."""
    place = folder / "whole.tiles"
    place.mkdir()
    for file in city.glob("*.cgs"):
        (place / file.name).hardlink_to(file)
    content = json.loads((city / MANIFEST).read_bytes())
    for tile in content["tiles"]:
        tile["levels"], tile["spheres"] = [], [[0.0, 0.0, 0.0, 1e-3 * MOST_NUMBER]]
    rest = {name: content[name] for name in content if name not in ("format", "version", "checksum")}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    head = {"format": content["format"], "version": 1, "checksum": hashlib.sha256(text.encode()).hexdigest()}
    (place / MANIFEST).write_text(json.dumps(head | rest, separators=(",", ":")))
    return place


def described(camera: Camera) -> str:
    lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return json.dumps(lens | {"worldToCamera": camera.world_to_camera.ravel().tolist()})


def memory(process: int) -> int:
    """Bytes of a process and those that it began; what they share counts once."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    own = next((int(line.split()[1]) << 10 for line in lines if line.startswith("Pss:")), 0)
    return own + sum(memory(int(child)) for child in children)


def processor(process: int) -> float:
    """Seconds that a process and those that it began have used so far."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    own = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return own + sum(processor(int(child)) for child in children)


def visit(server: Server, url: str, cap: str, cameras: list[Camera]) -> dict[str, Any]:
    """What a visit measures. `url`: of the manifest, on the server."""
    browser = shutil.which("chromium")
    if browser is None:
        raise SystemExit("no chromium on PATH")
    width, height = cameras[0].width, cameras[0].height
    most = f"&splats={10**9 if cap == ALL else cap}"
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        tab(browser, Path(folder), width, height) as page,
    ):
        page.open(f"{server.address}/view?renderer=webgl2{most}&url=")
        until(lambda: page.ask("Boolean(window.compgsViewer)"), "the page")
        server.sent = 0
        process = browser_of(folder)
        used = [processor(process)]
        seconds = [sharp(page, OPEN % (json.dumps(server.address + url), described(cameras[0])))]
        used.append(processor(process))
        sent = [server.sent]
        pictures = [page.picture()]
        for camera in cameras[1:]:
            seconds.append(sharp(page, SHOW % described(camera)))
            used.append(processor(process))
            sent.append(server.sent)
            pictures.append(page.picture())
        before = processor(process)
        page.ask("compgsViewer.fixed = null; " + MOVE % (1000 * MOVING_SECONDS))
        moving = until(lambda: page.ask("window.pictures"), "moving", MOST_SECONDS)
        return {
            "cap": cap,
            "seconds": seconds,
            "bytes": sent,
            "splats": page.ask("compgsViewer.info.coupled"),
            "processor": np.diff(used).tolist(),
            "frames": moving["count"] / moving["seconds"],
            "moving processor": (processor(process) - before) / moving["count"],
            "memory": memory(process),
            "pictures": pictures,
        }


def browser_of(folder: str) -> int:
    """The process that was begun with this folder."""
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if f"--user-data-dir={folder}".encode() in words and not any(w.startswith(b"--type=") for w in words):
            return int(place.name)
    raise SystemExit("the browser's process was not found")


def sharp(page: Page, script: str) -> float:
    """Seconds until the view is sharp."""
    page.ask(script)
    return float(until(lambda: page.ask("window.sharp"), "a sharp view", MOST_SECONDS))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("city", type=Path)
    parser.add_argument("--size", default="1280x800")
    parser.add_argument("--caps", nargs="+", default=["1000000", "3000000", ALL])
    parser.add_argument("--stops", type=int, default=6)
    parser.add_argument("--megabits", type=float, default=20.0)
    parser.add_argument("--browser", action="store_true", help="with a headless Chromium")
    parser.add_argument(
        "--pictures", action="store_true", help="only how near views are to those of everything"
    )
    parser.add_argument(
        "--plan", action="store_true", help="only bytes and splats of the walk, which take no time"
    )
    parser.add_argument(
        "--viewpoints", action="store_true", help="stop at the scene's own cameras, in place of the walk"
    )
    parser.add_argument("--output", type=Path, help="folder for levels.json and pictures")
    options = parser.parse_args()
    devtools.MAX_SECONDS = MOST_SECONDS  # a page that draws by software may answer late
    width, height = map(int, options.size.split("x"))
    manifest = read_manifest(options.city / MANIFEST)
    stops = manifest.viewpoints if options.viewpoints else flight(options.city, options.stops + 1)[:-1]
    cameras = [camera.resized(width, height) for camera in stops[: options.stops]]
    tiles, offset = manifest.tiles, np.array(manifest.world_offset)
    print(
        f"{len(tiles)} tiles, {sum(t.coupled_primitives for t in tiles):,} coupled primitives, "
        f"{sum(t.bytes for t in tiles) / 1e6:.1f} MB; {width} x {height}, {options.megabits:g} Mbit/s"
    )
    if options.plan:
        count(options.city, cameras, offset, options.caps)
        return
    if options.pictures:
        compare(options.city, cameras, [int(cap) for cap in options.caps if cap != ALL], options.output)
        return
    print(f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(dir=options.city.parent) as folder:
        scenes = Path(folder)
        shutil.copytree(
            options.city, scenes / "city.tiles", copy_function=lambda a, b: Path(b).hardlink_to(a)
        )
        whole = without_levels(options.city, scenes)
        with serving(scenes, options.megabits) as server:
            for cap in options.caps:
                name = whole.name if cap == ALL else "city.tiles"
                url = f"/files/{name}/{MANIFEST}"
                row = (
                    visit(server, url, cap, cameras)
                    if options.browser
                    else walk(server, url, cap, cameras, offset)
                )
                rows.append(row)
                print(line(row), flush=True)
                if options.output:
                    save(options.output, rows)
    if options.browser and rows[-1]["cap"] == ALL:
        for row in rows[:-1]:
            pairs = zip(row["pictures"], rows[-1]["pictures"], strict=True)
            values = [psnr(*map(np.ascontiguousarray, pair)) for pair in pairs]
            told = ", ".join(f"{value:.1f}" for value in values)
            print(f"at most {int(row['cap']):,} splats, beside everything, at each stop: {told} dB")


def walk(server: Server, url: str, cap: str, cameras: list[Camera], offset: np.ndarray) -> dict[str, Any]:
    """The same, without a browser and without drawing. `offset`: of the manifest's frame."""
    node = shutil.which("node")
    if node is None:
        raise SystemExit("no node on PATH")
    sights = [_sight(camera.moved(offset)) for camera in cameras]
    most = str(10**9) if cap == ALL else cap
    command = [
        node,
        "--max-old-space-size=8000",
        str(Path(__file__).with_suffix(".mjs")),
        server.address + url,
        most,
    ]
    done = subprocess.run(command, input=json.dumps(sights), check=True, stdout=subprocess.PIPE, text=True)
    found = json.loads(done.stdout)
    stops, moving = found["stops"], found["moving"]
    return {
        "cap": cap,
        "splats": stops[-1]["splats"],
        "seconds": [stop["seconds"] for stop in stops],
        "processor": [stop["processor"] for stop in stops],
        "bytes": [stop["bytes"] for stop in stops],
        "frames": moving["pictures"] / moving["seconds"],
        "moving processor": moving["processor"] / moving["pictures"],
        "memory": found["memory"],
    }


def _sight(camera: Camera) -> dict[str, Any]:
    """A camera as the page's tiles know it."""
    lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy")}
    return lens | {"centre": camera.center.tolist(), "rotation": camera.rotation.ravel().tolist()}


def count(city: Path, cameras: list[Camera], offset: np.ndarray, caps: list[str]) -> None:
    """Prints a table of what is fetched and shown at each stop."""
    sights = json.dumps([_sight(camera.moved(offset)) for camera in cameras])
    print("| at most | stop | tiles in view | splats | MB so far |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(dir=city.parent) as folder:
        whole = without_levels(city, Path(folder))
        with serving(city.parent, 1e6) as server:
            for cap in caps:
                place = f"{Path(folder).name}/{whole.name}" if cap == ALL else city.name
                address = f"{server.address}/files/{place}/{MANIFEST}"
                command = [
                    "node",
                    str(Path(__file__).with_suffix(".mjs")),
                    address,
                    str(10**9) if cap == ALL else cap,
                ]
                done = subprocess.run(
                    [*command, "plan"], input=sights, check=True, stdout=subprocess.PIPE, text=True
                )
                for number, stop in enumerate(json.loads(done.stdout)["stops"]):
                    values = [
                        cap,
                        f"{number}",
                        f"{stop['inView']}",
                        f"{stop['splats']:,}",
                        f"{stop['bytes'] / 1e6:.2f}",
                    ]
                    print(f"| {' | '.join(values)} |", flush=True)


def compare(city: Path, cameras: list[Camera], caps: list[int], folder: Path | None) -> None:
    """Prints the PSNR of each view for each cap, and how many splats there are in it; keeps the pictures."""
    whole = open_tiles(city / MANIFEST)
    expected = [to_8bit(render(whole, camera).image) for camera in cameras]
    for cap in caps:
        model = open_tiles(city / MANIFEST, most_splats=cap)
        told = []
        for i, (camera, picture) in enumerate(zip(cameras, expected, strict=True)):
            found = to_8bit(render(model, camera).image)
            told.append(f"{psnr(found, picture):.1f}")
            if folder:
                folder.mkdir(parents=True, exist_ok=True)
                both = Image.fromarray(np.concatenate([found, picture]))
                both.save(folder / f"{cap}_{i}.png")
        print(f"at most {cap:,} splats, beside everything, at each stop: {', '.join(told)} dB", flush=True)


def line(row: dict[str, Any]) -> str:
    again = row["seconds"][1:]
    values = [
        "everything at once" if row["cap"] == ALL else f"{int(row['cap']):,}",
        f"{row['splats']:,}",
        f"{row['bytes'][0] / 1e6:.2f}",
        f"{row['processor'][0]:.1f}",
        f"{row['seconds'][0]:.0f}",
        f"{row['bytes'][-1] / 1e6:.2f}",
        f"{median(row['processor'][1:]):.1f}" if again else "",
        f"{median(again):.0f}" if again else "",
        f"{row['moving processor']:.2f}",
        f"{row['frames']:.1f}",
        f"{row['memory'] / 1e6:.0f} MB",
    ]
    return f"| {' | '.join(values)} |"


def save(folder: Path, rows: list[dict[str, Any]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    numbers = [{name: value for name, value in row.items() if name != "pictures"} for row in rows]
    (folder / "levels.json").write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
    for i, picture in enumerate(rows[-1].get("pictures", ())):
        Image.fromarray(picture).save(folder / f"{rows[-1]['cap']}_{i}.png")


if __name__ == "__main__":
    main()
