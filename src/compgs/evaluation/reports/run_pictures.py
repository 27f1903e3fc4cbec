"""Pictures of a report: the worst views of every scene as photographed and as some of its runs have them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from compgs.evaluation.reports import page, summary
from compgs.evaluation.reports.pictures import (
    difference_picture,
    levels_between,
    read_picture,
    reduced,
    scale_for,
    urls_within,
)
from compgs.evaluation.reports.summary import Point

PICTURE_BYTES = 4_000_000  # of all pictures in the page, at most
WIDTH = 480  # pixels of a picture, at most
SHOWN_VIEWS = 4  # of a scene, the worst
SHOWN_RUNS = 6  # of a scene, in its pictures


def pictures_of(
    points: Sequence[Point], views: int, progress: Callable[[int, int], None] | None = None
) -> tuple[list[str], list[str]]:
    """HTML of the worst views of every scene, and what is left out and why."""
    figures: list[_Figure] = []
    notes: list[str] = []
    scenes = summary.scenes(points)
    for i, scene in enumerate(scenes):
        found, reasons = _figures(scene, [point for point in points if point.scene == scene], views)
        figures += found
        notes += reasons
        if progress:
            progress(i + 1, len(scenes))
    if not figures:
        return [], notes
    images = [image for figure in figures for image in figure.images()]
    urls = urls_within(images, WIDTH, PICTURE_BYTES)
    parts = [
        page.heading("Pictures, worst views first"),
        page.paragraph(
            "Beside them the error of the picture on the right, the mean of the colors: black is none."
        ),
    ]
    scene = ""
    for figure in figures:
        if figure.scene != scene:
            scene = figure.scene
            parts.append(page.heading(scene, 3))
        mine, urls = urls[: len(figure.images())], urls[len(figure.images()) :]
        parts.append(figure.html(mine))
    return parts, notes


@dataclass(frozen=True, eq=False)
class _Layer:
    """What one run has of a view, reduced to WIDTH."""

    point: Point
    psnr: float  # dB
    rendering: np.ndarray  # [H, W, 3] uint8
    errors: np.ndarray  # [H, W, 3] uint8


@dataclass(frozen=True, eq=False)
class _Figure:
    """One view of a scene as photographed, and as some runs have it."""

    scene: str
    view: str
    width: int  # pixels, of the photograph
    height: int
    photograph: np.ndarray  # [H, W, 3] uint8, reduced to WIDTH
    layers: tuple[_Layer, ...]
    scale: int  # levels, of 255, at which errors are white

    def images(self) -> list[np.ndarray]:
        """The photograph, then rendering and errors of each layer."""
        return [
            self.photograph,
            *(image for layer in self.layers for image in (layer.rendering, layer.errors)),
        ]

    def html(self, urls: Sequence[str]) -> str:
        """Return the page with the data URLs of `images`."""
        pictures = [page.Picture("photograph", urls[0])]
        for layer, url, errors in zip(self.layers, urls[1::2], urls[2::2], strict=True):
            quality = "identical" if layer.psnr == float("inf") else f"{layer.psnr:.2f} dB"
            pictures.append(page.Picture(f"{named(layer.point)}: {quality}", url, errors))
        caption = f"{self.view}. Errors: white is {self.scale} of 255 levels or more."
        return page.slider(pictures, self.width, self.height, caption)


def named(point: Point) -> str:
    """Method and rate."""
    return f"{point.method}, {point.rate}" if point.rate else point.method


def _figures(scene: str, points: Sequence[Point], views: int) -> tuple[list[_Figure], list[str]]:
    """Draw the figures of one scene, the worst views first; and say what is left out."""
    chosen = shown_points(points)
    figures = []
    if views and chosen:
        for name in summary.worst_views(points):
            figure = _figure(scene, name, chosen)
            if figure:
                figures.append(figure)
            if len(figures) == views:
                break
    notes = []
    if len(chosen) < len(points) and figures:
        names = ", ".join(map(named, chosen))
        notes.append(f"{scene}: of {len(points)} results, pictures are shown of {len(chosen)}: {names}")
    return figures, notes


def shown_points(points: Sequence[Point]) -> list[Point]:
    """Choose at most SHOWN_RUNS of one scene's points with pictures: of each method the one whose size is nearest to
    that of all, then the others, the smallest first and the largest next.
    """
    pictured = [point for point in points if point.runs[0].folder and "pictures" not in point.runs[0].missing]
    if not pictured:
        return []
    sizes = {point: np.log(max(point.mean("bytes") or 1.0, 1.0)) for point in pictured}
    middle = median(sizes.values())
    queues = []
    for method in summary.methods(pictured):
        mine = sorted((p for p in pictured if p.method == method), key=lambda p: abs(sizes[p] - middle))
        first, others = mine[0], sorted(mine[1:], key=lambda p: sizes[p])
        turns = [others[i // 2] if i % 2 == 0 else others[-1 - i // 2] for i in range(len(others))]
        queues.append([first, *turns])
    rounds = [queue[i] for i in range(max(map(len, queues))) for queue in queues if i < len(queue)]
    kept = rounds[:SHOWN_RUNS]
    return sorted(kept, key=rounds.index if len(queues) > 1 else pictured.index)


def _figure(scene: str, view: str, points: Sequence[Point]) -> _Figure | None:
    """None if no photograph is there. A rendering that is missing, or of another size, is left out."""
    photograph: np.ndarray | None = None
    renderings: list[tuple[Point, float, np.ndarray]] = []
    for point in points:
        run = point.runs[0]
        entry: Any = next((each for each in run.per_view if each["name"] == view), None)
        pair = run.pictures(entry["file"]) if entry else None
        if pair is None:
            continue
        truth, rendering = map(read_picture, pair)
        photograph = truth if photograph is None else photograph
        if photograph is not None and rendering is not None and rendering.shape == photograph.shape:
            renderings.append((point, summary.psnr(entry), rendering))
    if photograph is None or not renderings:
        return None
    levels = [levels_between(rendering, photograph) for _, _, rendering in renderings]
    scale = scale_for(levels)
    layers = [
        _Layer(point, psnr, reduced(rendering, WIDTH), reduced(difference_picture(each, scale), WIDTH))
        for (point, psnr, rendering), each in zip(renderings, levels, strict=True)
    ]
    height, width = photograph.shape[:2]
    return _Figure(scene, view, width, height, reduced(photograph, WIDTH), tuple(layers), scale)
