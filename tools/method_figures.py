"""The figures of docs/method.md, of a file and the capture that it was made from.

    python tools/method_figures.py runs/plush/plush.cgs ../shared/scenes/plush_480 -r 2

Writes docs/images/method_*.jpg and .png.
"""

import argparse
import io
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from compgs.cameras import Camera
from compgs.codec import decode
from compgs.codec.content import FileContent, Role, surroundings, walk
from compgs.codec.reader import file_info, read_content
from compgs.gaussians import Gaussians
from compgs.metrics import psnr, to_8bit
from compgs.model.hybrid_model import HybridModel
from compgs.outputs import write_bytes
from compgs.render import RasterSettings, local_camera, render, settings_of
from compgs.render.rasterize import rasterize
from compgs.scene import load_scene

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
GAP = 6  # pixels between two pictures
ZOOM = 2  # pictures are small
WHITE = RasterSettings(background=(1.0, 1.0, 1.0))


def beside(images: list[np.ndarray], captions: list[str]) -> Image.Image:
    """Pictures [H, W, 3] uint8 in a row, each with a line below."""
    height, width = ZOOM * images[0].shape[0], ZOOM * images[0].shape[1]
    canvas = Image.new("RGB", (len(images) * (width + GAP) - GAP, height + 22), "white")
    draw = ImageDraw.Draw(canvas)
    for i, (image, caption) in enumerate(zip(images, captions, strict=True)):
        canvas.paste(
            Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS), (i * (width + GAP), 0)
        )
        draw.text((i * (width + GAP) + 2, height + 5), caption, fill="black", font_size=13)
    return canvas


def save(image: Image.Image, name: str) -> None:
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=88)
    write_bytes(IMAGES / name, buffer.getvalue())


def solid(g: Gaussians, colors: np.ndarray) -> Gaussians:
    """Opaque and small: a primitive's middle, where it can be told from its neighbours."""
    return replace(g, opacities=np.full_like(g.opacities, 0.98), scales=0.45 * g.scales, colors=colors)


def primitives(model: HybridModel, camera: Camera, photograph: np.ndarray) -> Image.Image:
    local = local_camera(model, camera)
    g, _ = model.drawn(local)
    shown = g.opacities > 0.15  # fainter ones would hide what carries the picture
    some = Gaussians(
        g.means[shown], g.quaternions[shown], g.scales[shown], g.opacities[shown], g.colors[shown]
    )
    ellipsoids = to_8bit(rasterize(solid(some, some.colors), local, WHITE).image)
    picture = Image.fromarray(ellipsoids).resize((ZOOM * camera.width, ZOOM * camera.height))
    draw = ImageDraw.Draw(picture)
    centers = model.bounds[0].astype(np.float64)
    seen = (local.world_to_camera[:3, :3] @ centers.T).T + local.world_to_camera[:3, 3]
    seen = seen[seen[:, 2] > 0]
    for x, y in zip(
        ZOOM * (camera.fx * seen[:, 0] / seen[:, 2] + camera.cx),
        ZOOM * (camera.fy * seen[:, 1] / seen[:, 2] + camera.cy),
        strict=True,
    ):
        draw.ellipse([x - 0.8, y - 0.8, x + 0.8, y + 0.8], fill="black")
    dotted = np.asarray(picture.resize((camera.width, camera.height), Image.Resampling.BOX))
    return beside(
        [photograph, dotted, to_8bit(render(model, camera).image)],
        [
            "photograph",
            f"{model.anchors:,} anchors, and what is predicted from them",
            "rendering of the file",
        ],
    )


def bits_of_anchors(content: FileContent) -> np.ndarray:
    """[N] of the symbols of each anchor, under the file's own tables."""
    total = np.zeros(len(content.mask))
    owner = np.repeat(np.arange(len(content.mask)), content.mask.sum(1))
    for group, coded in zip(
        content.groups,
        walk(content.groups, content.mask, surroundings(content.coordinates, content.levels)),
        strict=True,
    ):
        t = coded.tables
        place = coded.symbols - t.lowest[coded.table_index]
        place = np.where(
            (place >= 0) & (place < t.counts[coded.table_index]), place, t.counts[coded.table_index]
        )
        bits = t.costs()[t.offsets[coded.table_index] + place].sum(1)
        if group.shape.role == Role.RESIDUAL:
            np.add.at(total, owner, bits)
        else:
            total += bits
    return total


def bits(model: HybridModel, content: FileContent, camera: Camera, components: dict[str, int]) -> Image.Image:
    local = local_camera(model, camera)
    g, index = model.drawn(local)
    owner = np.repeat(np.arange(model.anchors), content.mask.sum(1))
    per_anchor = bits_of_anchors(content)
    low, high = np.quantile(per_anchor, [0.05, 0.95])
    scaled = np.clip((per_anchor - low) / (high - low), 0, 1)
    colors = matplotlib.colormaps["viridis"](scaled[owner[index]])[:, :3].astype(np.float32)
    colored = to_8bit(rasterize(replace(g, colors=colors), local, settings_of(model)).image)
    pictures = beside(
        [to_8bit(render(model, camera).image), colored],
        ["rendering", f"bits of the anchor: dark {low:.0f}, bright {high:.0f}"],
    )
    figure, axis = plt.subplots(figsize=(3.4, pictures.height / 100), dpi=100)
    names = sorted(components, key=lambda name: components[name])
    axis.barh(names, [components[name] / 1000 for name in names], color="#31688e")
    axis.set_xlabel("kB of the file")
    axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    chart = Image.open(buffer).convert("RGB")
    canvas = Image.new("RGB", (pictures.width + chart.width, max(pictures.height, chart.height)), "white")
    canvas.paste(pictures, (0, 0))
    canvas.paste(chart, (pictures.width, 0))
    return canvas


def component_sizes(data: bytes) -> dict[str, int]:
    """Bytes by section, those of all ranges together."""
    sizes: dict[str, int] = {}
    for section in file_info(data).sections:
        sizes[section.name] = sizes.get(section.name, 0) + section.bytes
    return sizes


def symbols(content: FileContent) -> bytes:
    """Two channels of the references: how often each symbol comes, and how often the tables expect it."""
    coded = dict(
        zip(
            [group.shape.role for group in content.groups],
            walk(content.groups, content.mask, surroundings(content.coordinates, content.levels)),
            strict=True,
        )
    )[Role.REFERENCE]
    t = coded.tables
    costs = t.costs()
    spread = coded.symbols.std(0)
    order = np.argsort(-spread)
    figure, axes = plt.subplots(1, 3, figsize=(9, 2.6), dpi=110)
    chosen = [order[0], order[len(order) // 4], order[len(order) // 2]]
    for axis, channel in zip(axes, chosen, strict=True):
        found, tables = coded.symbols[:, channel], coded.table_index[:, channel]
        reach = int(max(3, np.quantile(np.abs(found), 0.995)))
        values = np.arange(-reach, reach + 1)
        expected = np.zeros(len(values))
        for table, count in zip(*np.unique(tables, return_counts=True), strict=True):
            place = values - t.lowest[table]
            inside = (place >= 0) & (place < t.counts[table])
            expected[inside] += count * 2.0 ** -costs[t.offsets[table] + place[inside]]
        axis.bar(
            values, [(found == value).sum() for value in values], color="#b0c4d4", label="symbols in the file"
        )
        axis.plot(values, expected, "o-", ms=3, lw=1, color="#d62728", label="expected by its tables")
        place = found - t.lowest[tables]
        place = np.where((place >= 0) & (place < t.counts[tables]), place, t.counts[tables])
        mean_bits = costs[t.offsets[tables] + place].mean()
        axis.set_title(f"channel {channel}: {mean_bits:.2f} bits a symbol", fontsize=9)
        axis.set_xlabel("steps from the predicted mean", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(fontsize=7, frameon=False)
    axes[0].set_ylabel("anchors", fontsize=8)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    return buffer.getvalue()


def prefixes(path: Path, camera: Camera, photograph: np.ndarray) -> Image.Image:
    """Four beginnings of the file, the last being all of it."""
    ends = [part.bytes for part in file_info(path.read_bytes()).ranges]
    chosen = sorted({ends[0], *[ends[round(i * (len(ends) - 1) / 3)] for i in range(1, 4)]})
    images, captions = [], []
    for end in chosen:
        image = to_8bit(render(decode(path, prefix=end), camera).image)
        images.append(image)
        captions.append(f"first {end / 1000:.1f} kB: {psnr(image, photograph):.1f} dB")
    return beside(images, captions)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-r", "--downscale", type=int, default=1)
    parser.add_argument("--view", type=int, default=4, help="of the held-out ones")
    options = parser.parse_args()
    view = load_scene(options.scene, downscale=options.downscale).test_views[options.view]
    model = decode(options.file)
    assert isinstance(model, HybridModel)
    data = options.file.read_bytes()
    content = read_content(data)
    save(primitives(model, view.camera, view.image), "method_primitives.jpg")
    save(bits(model, content, view.camera, component_sizes(data)), "method_bits.jpg")
    save(prefixes(options.file, view.camera, view.image), "method_prefix.jpg")
    write_bytes(IMAGES / "method_symbols.png", symbols(content))


if __name__ == "__main__":
    main()
