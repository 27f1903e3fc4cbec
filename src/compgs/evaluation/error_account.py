"""Where the error of a decoded file is: in which part of the picture, at which scale, how far away, in which views.

All figures are of the squared error of 8-bit images over the pixels that count, and add up to 1: what is 0.4 holds four
tenths of the error. PSNR beside it says how large the error is there.

- Region: the picture in ROWS x COLUMNS fields of equal size.
- Scale: averaging rendering and photograph over squares of n x n pixels takes away what is finer than n pixels. What
  2 x 2 takes away is *finer than 2*, what 4 x 4 takes away beyond that is *2 to 4*, and so on; what 16 x 16 leaves is
  coarse: wrong colors of whole things, not missing detail.
- Distance: along the camera's axis, of what the rendering shows there (`compgs.render.depth`), in world units. The
  bounds are chosen so that each part has about as many pixels; where the background shows, there is no distance.
- View: each held-out view.

`errors.json` (one object):

| key | meaning |
|---|---|
| schema | "compgs errors 1" |
| psnr | dB, of the mean squared error over all pixels of all views: not the mean of the views' PSNR |
| regions | ROWS lists of COLUMNS fields, from the top left: `share`, `psnr` |
| scales | finest first: `finer_than`: pixels, or null of what is coarser; `share`; `left`: what averaging leaves |
| distances | nearest first: `from`, `to`: world units, null of the background; `pixels`: their share; `share`, `psnr` |
| views | worst first: `name`, `share`, `psnr` |

A PSNR is null where there is no error, or no pixel.
"""

import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from PIL import Image

from compgs.evaluation.reports.pictures import levels_between, reduced

SCHEMA = "compgs errors 1"
ROWS, COLUMNS = 4, 4
SCALES = (2, 4, 8, 16)  # pixels, sides of the squares that are averaged over
PARTS = 6  # of the distances
# Distances are counted in eighths of an octave, so that views need not be kept: 2^-24 to 2^40 world units.
OCTAVE, LEAST_OCTAVE, OCTAVES = 8, -24, 64
BINS = OCTAVE * OCTAVES + 1  # the last is the background
SHOWN_WIDTH = 480  # pixels, of the pictures that are kept
SHOWN_VIEWS = 6  # views that are kept as pictures, the worst


@dataclass(frozen=True)
class Part:
    """Is a part of the squared error."""

    share: float  # of all of it
    psnr: float | None  # dB; None where there is no error, or no pixel


@dataclass(frozen=True)
class DistancePart(Part):
    """What is so far away."""

    near: float | None  # world units; None: the background
    far: float | None
    pixels: float  # share of all pixels


@dataclass(frozen=True)
class ScalePart:
    """What is so fine."""

    finer_than: int | None  # pixels; None: coarser than all that were averaged over
    share: float
    left: float  # share of the error after averaging over so many pixels


@dataclass(frozen=True)
class ViewPart(Part):
    """A view."""

    name: str


@dataclass(frozen=True, eq=False)
class ViewPictures:
    """A view to be looked at, at most SHOWN_WIDTH pixels wide."""

    name: str
    photograph: np.ndarray  # [H, W, 3] uint8
    rendering: np.ndarray  # [H, W, 3] uint8
    levels: (
        np.ndarray
    )  # [H, W] of 255: mean absolute difference of the channels, 0 where a pixel does not count
    depth: np.ndarray  # [H, W] world units, infinite where the background shows
    squared: float  # error of the whole view


@dataclass(frozen=True, eq=False)
class ErrorAccount:
    """Where the error is."""

    psnr: float | None  # dB, over all pixels of all views
    regions: tuple[tuple[Part, ...], ...]  # ROWS of COLUMNS
    scales: tuple[ScalePart, ...]  # finest first
    distances: tuple[DistancePart, ...]  # nearest first, then the background
    views: tuple[ViewPart, ...]  # worst first
    mean_levels: (
        np.ndarray
    )  # [H, W] of 255: root of the mean squared error over the views, by place in the picture
    pictures: tuple[ViewPictures, ...]  # of the worst views

    def to_dict(self) -> dict[str, Any]:
        """The content of `errors.json`."""
        return {
            "schema": SCHEMA,
            "psnr": self.psnr,
            "regions": [[{"share": p.share, "psnr": p.psnr} for p in row] for row in self.regions],
            "scales": [{"finer_than": p.finer_than, "share": p.share, "left": p.left} for p in self.scales],
            "distances": [
                {"from": p.near, "to": p.far, "pixels": p.pixels, "share": p.share, "psnr": p.psnr}
                for p in self.distances
            ],
            "views": [{"name": p.name, "share": p.share, "psnr": p.psnr} for p in self.views],
        }


@dataclass(eq=False)
class ErrorSums:
    """Adds up the squared errors of one view after the other; keeps sums and the worst views' pictures alone."""

    _views: list[tuple[str, float, int]] = field(default_factory=list)  # name, squared error, pixels
    _regions: np.ndarray = field(
        default_factory=lambda: np.zeros((ROWS, COLUMNS, 2))
    )  # squared error, pixels
    _averaged: np.ndarray = field(default_factory=lambda: np.zeros(len(SCALES)))  # squared error that is left
    _distances: np.ndarray = field(default_factory=lambda: np.zeros((BINS, 2)))  # squared error, pixels
    _places: np.ndarray | None = None  # [H, W, 2] squared error, pixels
    _pictures: list[ViewPictures] = field(default_factory=list)

    def add(
        self,
        name: str,
        rendering: np.ndarray,  # [H, W, 3] uint8
        photograph: np.ndarray,  # [H, W, 3] uint8
        mask: np.ndarray | None,  # [H, W] bool, True where a pixel counts
        depth: np.ndarray,  # [H, W] world units, infinite where the background shows
    ) -> None:
        """Add the error of one view."""
        difference = (rendering.astype(np.float64) - photograph) / 255
        counted = np.ones(depth.shape) if mask is None else mask.astype(np.float64)
        difference *= counted[:, :, None]
        squared = np.square(difference).mean(2)
        both = np.stack([squared, counted], 2)
        self._views.append((name, float(squared.sum()), int(counted.sum())))
        self._regions += _fields(both)
        self._averaged += [_after_averaging(difference, counted, side) for side in SCALES]
        index = _bins(depth).reshape(-1)
        for i in range(2):
            self._distances[:, i] += np.bincount(index, both[..., i].reshape(-1), BINS)
        places = np.stack([_resized(both[..., i], self._places) for i in range(2)], 2)
        self._places = places if self._places is None else self._places + places
        levels = levels_between(rendering, photograph) * counted
        self._pictures.append(
            ViewPictures(
                name,
                reduced(photograph, SHOWN_WIDTH),
                reduced(rendering, SHOWN_WIDTH),
                _narrow(levels),
                _nearest(depth),
                float(squared.sum() / counted.sum()),
            )
        )
        self._pictures = sorted(self._pictures, key=lambda kept: -kept.squared)[:SHOWN_VIEWS]

    def account(self) -> ErrorAccount:
        """Return the account of all views so far, one at least."""
        assert self._places is not None, "a view comes first"
        total = sum(squared for _, squared, _ in self._views)
        pixels = sum(count for _, _, count in self._views)
        averaged = [total, *self._averaged]

        def part(squared: float, count: float) -> tuple[float, float | None]:
            return squared / total if total else 0.0, _psnr(squared, count)

        views = [ViewPart(*part(squared, count), name=name) for name, squared, count in self._views]
        return ErrorAccount(
            psnr=_psnr(total, pixels),
            regions=tuple(tuple(Part(*part(*field)) for field in row) for row in self._regions.tolist()),
            scales=tuple(
                ScalePart(side, (before - after) / total if total else 0.0, after / total if total else 0.0)
                for side, before, after in zip((*SCALES, None), averaged, (*averaged[1:], 0.0), strict=True)
            ),
            distances=tuple(
                DistancePart(*part(squared, count), near, far, count / pixels)
                for near, far, squared, count in _parts(self._distances)
            ),
            views=tuple(sorted(views, key=lambda view: math.inf if view.psnr is None else view.psnr)),
            mean_levels=255 * np.sqrt(self._places[..., 0] / np.maximum(self._places[..., 1], 1e-9)),
            pictures=tuple(self._pictures),
        )


def _psnr(squared: float, count: float) -> float | None:
    return -10 * math.log10(squared / count) if squared > 0 and count else None


def _fields(sums: np.ndarray) -> np.ndarray:
    """[H, W, 2] -> [ROWS, COLUMNS, 2], fields that differ by a pixel at most."""
    rows = np.linspace(0, sums.shape[0], ROWS + 1).round().astype(int)
    columns = np.linspace(0, sums.shape[1], COLUMNS + 1).round().astype(int)
    return np.array(
        [
            [sums[top:bottom, left:right].sum((0, 1)) for left, right in itertools.pairwise(columns)]
            for top, bottom in itertools.pairwise(rows)
        ]
    )


def _after_averaging(difference: np.ndarray, counted: np.ndarray, side: int) -> float:
    """The squared error that is left where both pictures are averaged over squares, those at the edge cut off by it.

    `difference` [H, W, 3] is zero where a pixel does not count; a square is averaged over those that do.
    """
    rows, columns = (np.arange(0, length, side) for length in counted.shape)

    def sums(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1)

    return float((np.square(sums(difference)).mean(2) / np.maximum(sums(counted), 1)).sum())


def _bins(depth: np.ndarray) -> np.ndarray:
    """Which bin of distances each pixel belongs to."""
    shown = np.isfinite(depth) & (depth > 0)
    octaves = np.log2(np.where(shown, depth, 1)) - LEAST_OCTAVE
    return np.where(shown, np.clip(np.floor(OCTAVE * octaves), 0, BINS - 2), BINS - 1).astype(np.int64)


def _parts(bins: np.ndarray) -> list[tuple[float | None, float | None, float, float]]:
    """PARTS of about as many pixels, nearest first, then the background, if it shows: from, to, error, pixels."""
    shown, behind = bins[:-1], bins[-1]
    reached = np.cumsum(shown[:, 1])
    result: list[tuple[float | None, float | None, float, float]] = []
    start = 0
    for i in range(PARTS):
        end = int(np.searchsorted(reached, reached[-1] * (i + 1) / PARTS * (1 - 1e-12))) + 1
        found = np.flatnonzero(shown[start:end, 1]) + start
        if len(found):
            near, far = (2.0 ** (edge / OCTAVE + LEAST_OCTAVE) for edge in (found[0], found[-1] + 1))
            error, pixels = shown[start:end].sum(0)
            result.append((near, far, float(error), float(pixels)))
        start = max(start, end)
    if behind[1]:
        result.append((None, None, float(behind[0]), float(behind[1])))
    return result


def _resized(values: np.ndarray, like: np.ndarray | None) -> np.ndarray:
    """[H, W] as wide as what is kept, or as the pictures' first; means, not sums."""
    if like is None:
        return _narrow(values)
    picture = Image.fromarray(values.astype(np.float32))
    return np.asarray(picture.resize((like.shape[1], like.shape[0]), Image.Resampling.BOX), np.float64)


def _narrow(values: np.ndarray) -> np.ndarray:
    """[H, W] averaged down to SHOWN_WIDTH."""
    if values.shape[1] <= SHOWN_WIDTH:
        return values.astype(np.float64)
    height = max(1, round(values.shape[0] * SHOWN_WIDTH / values.shape[1]))
    picture = Image.fromarray(values.astype(np.float32))
    return np.asarray(picture.resize((SHOWN_WIDTH, height), Image.Resampling.BOX), np.float64)


def _nearest(depth: np.ndarray) -> np.ndarray:
    """[H, W] down to SHOWN_WIDTH, by taking pixels: distances of two things have no mean."""
    width = min(SHOWN_WIDTH, depth.shape[1])
    height = max(1, round(depth.shape[0] * width / depth.shape[1]))
    rows, columns = (
        ((np.arange(count) + 0.5) * length / count).astype(int)
        for count, length in zip((height, width), depth.shape, strict=True)
    )
    return depth[np.ix_(rows, columns)]
