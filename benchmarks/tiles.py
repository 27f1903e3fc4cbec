"""Scenes in tiles: what a border costs, and what memory and time it takes to fly over a city of millions.

    python benchmarks/tiles.py seam ONE TWO SCENE [-r 1]
    python benchmarks/tiles.py city FILE.cgs [--side 12] [--largest 0.8] [--memory 60MB] [--frames 48] [--folder DIR]
    python benchmarks/tiles.py whole FILE.cgs OUT.cgs [--side 8] [--largest 0.8]

`seam`: ONE is the run of a scene trained whole, TWO that of the same in tiles. Held-out views of both against the
photographs: all pixels, and those that show what is near a border. Which these are the scene trained whole says: its
Gaussians are drawn white where they are near a border and black elsewhere.

`city`: the middle of a trained file, repeated on a grid, each tile with its own world offset, as captures side by side
would be. A camera flies over it, in one process with a bounded cache and in another with all tiles open: peak memory,
and processor time of each picture. Pictures are compared bit by bit.

`whole`: such a city in one file, for `compgs export OUT.cgs OUT.tiles`.
"""

import argparse
import hashlib
import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from compgs import metrics
from compgs.cameras import Camera
from compgs.cli.sizes import parse_size
from compgs.codec.content import FileContent, dequantize, reordered
from compgs.codec.decoder import decode_bytes
from compgs.codec.reader import read_content
from compgs.codec.reduce import with_latents, without_coupled
from compgs.codec.writer import write_content
from compgs.evaluation.camera_path import look_at
from compgs.formats.tiled import read_manifest
from compgs.formats.tiled_ground import Ground, contains
from compgs.formats.tiled_scene import open_tiles
from compgs.formats.tiled_writer import NewTile, write_tiles
from compgs.opening import open_scene
from compgs.ordering.order import canonical_order
from compgs.outputs import write_bytes
from compgs.render import RasterSettings, local_camera, rasterize, render, visible_mask
from compgs.scene import load_scene
from compgs.tiles import Plan, read_plan
from compgs.tiles.ground import ground_of

NEAR = 0.1  # of the narrowest core's side across a border, to both sides of it
CORE_SHARE = 0.7  # of the anchors, those nearest to the middle on the ground, that become a tile of the city
SIZE = 480, 360  # pixels


# what a border costs -----------------------------------------------------------------------------------------------


def seam(one: Path, two: Path, folder: Path, downscale: int) -> None:
    """Prints a table."""
    scene, plan = load_scene(folder, downscale=downscale), read_plan(two / "plan.json")
    whole = open_scene(one / f"{one.name}.cgs")
    tiled = open_scene(two / f"{two.name}.tiles")
    errors: dict[str, list[np.ndarray]] = {"one": [], "two": []}
    masks, psnr = [], {"one": [], "two": []}
    for view in scene.test_views:
        masks.append(near_border(whole, view.camera, plan, np.asarray(scene.points.positions)))
        for name, model in (("one", whole), ("two", tiled)):
            image = metrics.to_8bit(render(model, view.camera).image)
            psnr[name].append(metrics.psnr(image, view.image))
            errors[name].append(((image.astype(np.float64) - view.image) ** 2).mean(2))
    near = np.stack(masks)
    print(
        f"{scene.name}, {len(scene.test_views)} held-out views, {100 * near.mean():.1f} % of the pixels near a border"
    )
    print(
        "| | mean PSNR of the views | all pixels | near a border | elsewhere | bytes |\n|---|---|---|---|---|---|"
    )
    for name, label, place in (
        ("one", "whole", one / f"{one.name}.cgs"),
        ("two", f"{plan.grid} tiles", two / f"{two.name}.tiles"),
    ):
        error = np.stack(errors[name])
        parts = [decibels(error.mean()), decibels(error[near].mean()), decibels(error[~near].mean())]
        size = sum(file.stat().st_size for file in (place.iterdir() if place.is_dir() else [place]))
        values = [f"{np.mean(psnr[name]):.2f}", *(f"{part:.2f}" for part in parts), f"{size:,}"]
        print(f"| {label} | {' | '.join(values)} |")


def near_border(model: Any, camera: Camera, plan: Plan, points: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels that show for the most part what is near an edge between two cores."""
    local = local_camera(model, camera)
    gaussians = model.gaussians(local)
    places = plan.ground.places(gaussians.means + np.array(model.world_offset))
    on_ground = plan.ground.places(points)
    inner = [np.quantile(on_ground[contains(t.core, on_ground)], [0.02, 0.98], axis=0) for t in plan.tiles]
    lengths = np.min([np.ptp(corners, axis=0) for corners in inner], axis=0)
    near = np.zeros(len(places), bool)
    for tile in plan.tiles:
        for axis in (0, 1):
            edge = tile.core.high[axis]
            if math.isfinite(edge):
                near |= np.abs(places[:, axis] - edge) < NEAR * lengths[axis]
    painted = replace(gaussians, colors=np.repeat(near[:, None], 3, axis=1).astype(np.float32))
    return rasterize(painted, local, RasterSettings()).image[..., 0] > 0.5


def decibels(squares: float) -> float:
    return float(10 * np.log10(255**2 / squares))


# a city ------------------------------------------------------------------------------------------------------------


def middle_of(file: Path, largest: float) -> tuple[FileContent, Ground, np.ndarray, np.ndarray]:
    """The middle of a file, without anchors that reach farther than `largest` world units: walls and skies of so many
    captures would stand in front of each other. Its ground, and how far the next one lies to its right and forward,
    world units.
    """
    data = file.read_bytes()
    model, content = decode_bytes(data, file), read_content(data)
    ground = ground_of(model.viewpoints, model.primitives.positions)
    places = np.abs(ground.places(model.primitives.positions + np.array(model.world_offset))).max(1)
    half = float(np.quantile(places, CORE_SHARE))
    inside = (places <= half) & (model.bounds[1] < largest)
    tile = without_coupled(content, np.repeat(inside, content.mask.sum(1)))
    return tile, ground, 2 * half * np.array(ground.right), 2 * half * np.array(ground.forward)


def make_city(file: Path, folder: Path, side: int, largest: float = math.inf) -> None:
    """`side` x `side` times the middle of a file, a tile each."""
    tile, ground, right, forward = middle_of(file, largest)

    def tiles() -> Iterator[NewTile]:
        for i in range(side):
            for j in range(side):
                x, y, z = (np.array(tile.world_offset) + i * right + j * forward).tolist()
                yield NewTile(f"{i}_{j}", write_content(replace(tile, world_offset=(x, y, z))))

    write_tiles(folder, tiles(), ground)


def make_whole(file: Path, out: Path, side: int, largest: float) -> None:
    """The same in one file, moved by whole voxels; of two anchors in one voxel the first stays."""
    tile, _, right, forward = middle_of(file, largest)
    tile = reordered(tile, canonical_order(tile.coordinates))
    latents = dequantize(tile)
    shifts = [
        np.rint((i * right + j * forward) / tile.voxel_size).astype(np.int32)
        for i in range(side)
        for j in range(side)
    ]
    every = np.concatenate([tile.coordinates + shift for shift in shifts])
    chosen = np.sort(np.unique(every, axis=0, return_index=True)[1])
    chosen = chosen[canonical_order(every[chosen])]
    source = chosen % len(tile.coordinates)
    city = replace(
        tile,
        coordinates=every[chosen],
        mask=tile.mask[source],
        groups=tuple(replace(group, symbols=group.symbols[source]) for group in tile.groups),
        levels=None,
    )
    write_bytes(out, write_content(with_latents(city, [rows[source] for rows in latents])))


def flight(folder: Path, frames: int) -> list[Camera]:
    """Across the city from one corner to the other, a little above it, looking ahead and down."""
    manifest = read_manifest(folder / "manifest.json")
    up = np.array(manifest.up)
    middles = np.array([tile.world_offset for tile in manifest.tiles])
    if len(np.unique(middles, axis=0)) == 1:  # of one file
        middles = middles + np.array([np.median(tile.spheres[:, :3], axis=0) for tile in manifest.tiles])
    start, end = middles[0], middles[-1]
    ahead = (end - start) / np.linalg.norm(end - start)
    block = np.linalg.norm(end - start) / (math.isqrt(len(middles)) - 1) / math.sqrt(2)
    width, height = SIZE
    cameras = []
    for t in np.linspace(0, 1, frames):
        eye = start + t * (end - start) + 0.8 * block * up
        pose = look_at(eye, eye + 1.2 * block * ahead - 0.8 * block * up, up)
        cameras.append(Camera(pose, 0.9 * width, 0.9 * width, width / 2, height / 2, width, height))
    return cameras


def fly(folder: Path, memory: int | None, frames: int) -> dict[str, Any]:
    """In this process, whose peak of memory is told. Without a bound all tiles are open before the first picture."""
    cameras = flight(folder, frames)
    model = open_tiles(folder / "manifest.json", memory=memory or 1 << 50)
    before, opening = peak(), time.process_time()
    if memory is None:
        for index in range(len(model.manifest.tiles)):
            assert model.cache.get(index).bounds
    else:
        render(model, cameras[0])
    opening = time.process_time() - opening
    digest, seconds, reads, in_view = hashlib.sha256(), [], [], []
    for camera in cameras:
        groups = visible_mask(*model.bounds, local_camera(model, camera), RasterSettings())
        in_view.append(len(model.tiles_of(groups)))
        read, start = model.cache.reads, time.process_time()
        image = render(model, camera).image
        seconds.append(time.process_time() - start)
        reads.append(model.cache.reads - read)
        digest.update(image.tobytes())
    return {
        "tiles": len(model.manifest.tiles),
        **model.counts,
        "memory": memory,
        "peak before": before,
        "peak": peak(),
        "most open": model.cache.most_open,
        "opening seconds": opening,
        "median seconds": median(seconds),
        "worst seconds": max(seconds),
        "tiles opened a picture": sum(reads) / len(reads),
        "tiles in view": [min(in_view), median(in_view), max(in_view)],
        "pictures": digest.hexdigest(),
    }


def peak() -> int:
    """Bytes: the most that this process has taken."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def city(options: argparse.Namespace) -> None:
    """Prints a table."""
    if not (options.folder / "manifest.json").is_file():
        make_city(options.file, options.folder, options.side, options.largest)
    rows = []
    for memory in (None, *(parse_size(size, "--memory") for size in options.memory)):
        words = [sys.executable, __file__, "fly", str(options.folder), "--frames", str(options.frames)]
        words += [] if memory is None else ["--memory", str(memory)]
        rows.append(json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout))
    first = rows[0]
    whole = sum(file.stat().st_size for file in options.folder.iterdir())
    print(
        f"{first['tiles']} tiles, {first['anchors']:,} anchors, {first['coupled_primitives']:,} coupled primitives, "
        f"{whole / 1e6:.1f} MB; {options.frames} pictures of {SIZE[0]} x {SIZE[1]}; "
        f"tiles in view: {' / '.join(f'{count:.0f}' for count in first['tiles in view'])} (least, median, most); "
        f"identical: {len({row['pictures'] for row in rows}) == 1}"
    )
    head = (
        "open tiles",
        "most open",
        "peak of the process",
        "of it tiles and pictures",
        "tiles opened a picture",
    )
    print("| " + " | ".join((*head, "processor time a picture, median", "worst")) + " |\n" + "|---" * 7 + "|")
    for row in rows:
        bound = "all" if row["memory"] is None else f"at most {row['memory'] / 1e6:.0f} MB"
        values = [
            bound,
            *(
                f"{value / 1e6:.0f} MB"
                for value in (row["most open"], row["peak"], row["peak"] - row["peak before"])
            ),
            f"{row['tiles opened a picture']:.2f}",
            *(f"{1e3 * row[name]:.0f} ms" for name in ("median seconds", "worst seconds")),
        ]
        print(f"| {' | '.join(values)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("seam")
    one.add_argument("one", type=Path)
    one.add_argument("two", type=Path)
    one.add_argument("scene", type=Path)
    one.add_argument("-r", type=int, default=1)
    two = commands.add_parser("city")
    two.add_argument("file", type=Path)
    two.add_argument("--side", type=int, default=12)
    two.add_argument("--largest", type=float, default=math.inf, help="world units an anchor may reach")
    two.add_argument("--memory", nargs="*", default=["60MB"])
    two.add_argument("--frames", type=int, default=48)
    two.add_argument("--folder", type=Path, default=Path("city.tiles"))
    three = commands.add_parser("fly")
    three.add_argument("folder", type=Path)
    three.add_argument("--memory", type=int)
    three.add_argument("--frames", type=int, default=48)
    four = commands.add_parser("whole")
    four.add_argument("file", type=Path)
    four.add_argument("out", type=Path)
    four.add_argument("--side", type=int, default=8)
    four.add_argument("--largest", type=float, default=math.inf)
    options = parser.parse_args()
    if options.command == "whole":
        make_whole(options.file, options.out, options.side, options.largest)
    elif options.command == "seam":
        seam(options.one, options.two, options.scene, options.r)
    elif options.command == "city":
        city(options)
    else:
        print(json.dumps(fly(options.folder, options.memory, options.frames)))


if __name__ == "__main__":
    main()
