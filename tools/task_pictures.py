"""Makes the pictures of the site's task pages, docs/images/task_*.webp.

    python tools/made_city.py scenes/city
    python tools/task_pictures.py docs/gallery/city.cgs scenes/city

They show the made-up city and its file. task_look and task_share are screenshots of the program's own pages:
`compgs export city.cgs city.html`, and `compgs serve docs/gallery`.
"""

import argparse
import csv
import io
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

import compgs
from compgs.evaluation.camera_path import look_at
from compgs.metrics import psnr, to_8bit
from compgs.outputs import write_bytes
from compgs.reconstruct.report import picture
from compgs.scene import Scene
from compgs.scene.colmap import read_sparse_model
from compgs.tiles.plan import contains, plan_tiles
from compgs.words import size

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
WIDTH = 320  # pixels of one picture in a row
GAP = 6


def save(image: Image.Image, name: str) -> None:
    buffer = io.BytesIO()
    image.convert("RGB").save(buffer, format="WEBP", quality=80)
    write_bytes(IMAGES / f"task_{name}.webp", buffer.getvalue())


def beside(pictures: Sequence[Image.Image], captions: Sequence[str]) -> Image.Image:
    """Pictures in a row, each with a line below."""
    height = round(WIDTH * pictures[0].height / pictures[0].width)
    canvas = Image.new("RGB", (len(pictures) * (WIDTH + GAP) - GAP, height + 22), "white")
    draw = ImageDraw.Draw(canvas)
    for i, (image, caption) in enumerate(zip(pictures, captions, strict=True)):
        canvas.paste(image.resize((WIDTH, height), Image.Resampling.LANCZOS), (i * (WIDTH + GAP), 0))
        draw.text((i * (WIDTH + GAP) + 2, height + 4), caption, fill="black", font_size=14)
    return canvas


def drawn(figure: Figure) -> Image.Image:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return Image.open(buffer)


def photographs(scene: Path) -> None:
    """Six photographs, and the cameras and points that a reconstruction finds."""
    paths = sorted((scene / "images").iterdir())
    chosen = [Image.open(path).convert("RGB") for path in paths[:: max(1, len(paths) // 6)][:6]]
    width, height = 160, round(160 * chosen[0].height / chosen[0].width)
    panels = picture(read_sparse_model(scene / "sparse" / "0"))
    panels = panels.resize((round(panels.width * 2 * height / panels.height), 2 * height))
    canvas = Image.new("RGB", (3 * width + GAP + panels.width, 2 * height), "white")
    for i, image in enumerate(chosen):
        canvas.paste(image.resize((width, height)), ((i % 3) * width, (i // 3) * height))
    canvas.paste(panels, (3 * width + GAP, 0))
    save(canvas, "photographs")


def comparison(file: Path, scene: Scene) -> None:
    """A file, its export, and their difference."""
    camera = scene.test_views[0].camera
    ours = to_8bit(compgs.render(compgs.decode(file), camera).image)
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / f"{file.stem}.spz"
        compgs.export(file, other, refine=0, progress=False)
        theirs = to_8bit(compgs.render(compgs.open_scene(other), camera).image)
        captions = [f"{path.name}, {size(path.stat().st_size)}" for path in (file, other)]
    difference = np.clip(8 * np.abs(ours.astype(int) - theirs), 0, 255).astype(np.uint8)
    captions.append(f"difference times 8; {psnr(ours, theirs):.1f} dB")
    save(beside([Image.fromarray(image) for image in (ours, theirs, difference)], captions), "compare")


def lines_of_python(file: Path, scene: Scene) -> None:
    """A photograph, its view rendered from a file, and their difference."""
    view = scene.train_views[0]
    rendered = to_8bit(compgs.render(compgs.decode(file), view.camera).image)
    difference = np.clip(4 * np.abs(rendered.astype(int) - view.image), 0, 255).astype(np.uint8)
    captions = ["view.image", "compgs.render(model, view.camera).image", "difference times 4"]
    save(beside([Image.fromarray(image) for image in (view.image, rendered, difference)], captions), "python")


def exports(file: Path) -> None:
    """The bytes of a file and of its exports."""
    sizes = {".cgs": file.stat().st_size}
    with tempfile.TemporaryDirectory() as folder:
        splats = Path(folder) / f"{file.stem}.ply"  # baked once
        compgs.export(file, splats, refine=0, progress=False)
        for suffix in (".spz", ".sog", ".glb", ".ply"):
            other = splats.with_suffix(suffix)
            if other != splats:
                compgs.export(splats, other, progress=False)
            sizes[suffix] = other.stat().st_size
    save(bars([f"{file.stem}{suffix}" for suffix in sizes], list(sizes.values())), "export")


def faults(file: Path, scene: Scene) -> None:
    """A file from three places: near the photographs, where none was taken, and far outside."""
    model, camera = compgs.decode(file), scene.test_views[0].camera
    up = np.array([0.0, 0.0, 1.0])
    poses = [
        camera.world_to_camera,
        look_at(np.array([0.0, -3.4, 0.3]), np.array([0.0, 0.0, 0.3]), up),
        look_at(np.array([0.0, -14.0, 2.0]), np.array([0.0, 0.0, 0.3]), up),
    ]
    pictures = [
        Image.fromarray(to_8bit(compgs.render(model, replace(camera, world_to_camera=pose)).image))
        for pose in poses
    ]
    captions = ["near the photographs", "in a street, where none was taken", "far outside"]
    save(beside(pictures, captions), "remedies")


def bars(names: list[str], sizes: list[int]) -> Image.Image:
    """A bar for each file, with its size; .cgs files stand out."""
    figure, axis = plt.subplots(figsize=(6, 0.6 + 0.3 * len(names)), layout="constrained")
    colors = ["#d62728" if ".cgs" in name else "#9db4c8" for name in names[::-1]]
    drawn_bars = axis.barh(names[::-1], sizes[::-1], color=colors)
    axis.bar_label(drawn_bars, labels=[size(count) for count in sizes[::-1]], padding=4, fontsize=9)
    axis.set_xticks([])
    axis.set_xlim(0, 1.15 * max(sizes))
    axis.spines[["top", "right", "bottom"]].set_visible(False)
    return drawn(figure)


def processes(scene: Scene) -> None:
    """Four processes, each with its view, whose gradients are added up."""
    views = scene.train_views[:: max(1, len(scene.train_views) // 4)][:4]
    figure, axes = plt.subplots(1, 4, figsize=(9, 2.6))
    figure.subplots_adjust(left=0.01, right=0.99, top=0.88, bottom=0.3, wspace=0.05)
    for number, (view, axis) in enumerate(zip(views, axes, strict=True)):
        axis.imshow(view.image)
        axis.axis("off")
        axis.set_title(f"process {number}: its view", fontsize=10)
        figure.text(0.13 + 0.247 * number, 0.22, "gradients ↓", ha="center", fontsize=9)
    figure.text(
        0.5, 0.06, "sum  →  the same step of the same model in every process", ha="center", fontsize=11
    )
    save(drawn(figure), "scale")


def tiles(scene: Scene) -> None:
    """The points of a capture from above, colored by their tile."""
    plan = plan_tiles(scene, 2, 2)
    places = plan.ground.places(scene.points.positions)
    low, high = np.quantile(places, [0.03, 0.97], axis=0)
    figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for tile in plan.tiles:
        inside = contains(tile.core, places)
        axis.scatter(*places[inside].T, s=3, label=f"tile {tile.name}")
    centers = plan.ground.places(np.stack([view.camera.center for view in scene.train_views]))
    axis.scatter(*centers.T, s=24, marker="^", color="black", label="cameras")
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[], aspect="equal")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    save(drawn(figure), "tiles")


def rates() -> None:
    """PSNR over bytes of the default preset, from the tables of all methods."""
    figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
    for scene in ("plush", "fox", "brighton"):
        with (ROOT / "docs" / "results" / f"methods_{scene}.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["method"] == "compgs default"]
        axis.plot(
            [int(row["bytes"]) / 1e3 for row in rows], [float(row["psnr"]) for row in rows], "o-", label=scene
        )
    axis.set(xscale="log", xlabel="kB of the file", ylabel="PSNR on held-out views, dB")
    marks = [2, 5, 10, 20, 50, 100, 200]
    axis.set_xticks(marks, [str(mark) for mark in marks])
    axis.minorticks_off()
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False)
    save(drawn(figure), "rates")


def compress() -> None:
    """Bytes of splats as .spz, .sog and .cgs, from the page of results."""
    text = (ROOT / "docs" / "results" / "compress.md").read_text(encoding="utf-8")
    names: list[str] = []
    sizes: list[int] = []
    scene = ""
    for line in text.partition("## 8 000 steps")[2].splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) == 7 and cells[1].strip("`") in (".spz", ".sog", ".cgs"):
            scene = cells[0] or scene
            names.append(f"{scene}, {cells[1].strip('`')}")
            sizes.append(int(cells[2].replace(" ", "")))
        elif sizes and line.startswith("## "):
            break
    save(bars(names, sizes), "compress")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("scene", type=Path)
    asked = parser.parse_args()
    rates()
    compress()
    photographs(asked.scene)
    scene = compgs.load_scene(asked.scene)
    tiles(scene)
    processes(scene)
    comparison(asked.file, scene)
    lines_of_python(asked.file, scene)
    exports(asked.file)
    faults(asked.file, scene)


if __name__ == "__main__":
    main()
