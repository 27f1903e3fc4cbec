"""Writes a scene at several levels of detail as streamed SOG: `lod-meta.json`, and a folder for each part.

    levels of a scene ──kd-tree──► leaves ──the runs of one level, side by side──► parts of some 100 000 splats

A viewer takes each leaf at the level that its distance asks for, and loads the parts that hold it. The layout is
PlayCanvas's, version 1; `sog_streamed` has its fields, and reads what is written here.

    lod-meta.json    0_0/meta.json 0_0/*.webp    0_1/...    1_0/...        LEVEL_NUMBER, 0 is the finest level
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats import sog
from compgs.formats.arrays import SplatArrays, joined, normalized
from compgs.formats.sog_files import META
from compgs.formats.sog_streamed import NAME
from compgs.outputs import filling

MOST_IN_LEAF = 1 << 14  # splats of the finest level: what a viewer draws at one level
MOST_IN_PART = 1 << 17  # splats: what it loads at once, but for one leaf
DIGITS = 7  # of bounds: all that float32 knows
PART = re.compile(r"\d+_\d+")  # name of a part's folder

Tree = dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Leaf:
    """The splats of one place, from the finest level to the coarsest."""

    levels: list[SplatArrays]

    @property
    def bound(self) -> Tree:
        """The box of all levels' splats, each as far as one standard deviation."""
        boxes = [_box(level) for level in self.levels]
        low, high = np.min([low for low, _ in boxes], 0), np.max([high for _, high in boxes], 0)
        return {"min": _short(low), "max": _short(high)}


@dataclass(eq=False)
class _Parts:
    """The parts of one level. A leaf's splats are in one of them, in one run."""

    folder: Path
    level: int
    names: list[str]  # of the parts of all levels
    runs: list[SplatArrays] = field(default_factory=list)  # of the part that is being filled
    count: int = 0  # splats of it
    number: int = 0

    def add(self, splats: SplatArrays) -> Tree:
        """Where a viewer finds them."""
        if self.count and self.count + len(splats) > MOST_IN_PART:
            self.close()
        if not self.count:
            self.names.append(f"{self.level}_{self.number}/{META}")
            self.file = len(self.names) - 1
        run = {"file": self.file, "offset": self.count, "count": len(splats)}
        self.runs.append(splats)
        self.count += len(splats)
        return run

    def close(self) -> None:
        """Write the part, if there is one."""
        if not self.count:
            return
        place = self.folder / f"{self.level}_{self.number}"
        place.mkdir()
        files, meta = sog.images(joined(self.runs))
        for name, content in files.items():
            (place / name).write_bytes(content)
        (place / META).write_text(json.dumps(meta), encoding="utf-8")
        self.runs, self.count, self.number = [], 0, self.number + 1


class LevelsWriter:
    """Takes a scene place by place: what has been written need not be in memory."""

    def __init__(self, folder: Path, levels: int) -> None:
        """`folder`: empty."""
        self._folder = folder
        self._names: list[str] = []
        self._parts = [_Parts(folder, level, self._names) for level in range(levels)]
        self._counts = [0] * levels
        self._trees: list[Tree] = []

    def add(self, levels: Sequence[SplatArrays]) -> None:
        """Splats of one place, in the frame of all, from the finest level to the coarsest. Raises SplatFileError."""
        if len(levels) != len(self._parts) or not all(map(len, levels)):
            raise SplatFileError(f"{NAME}: expected splats of {len(self._parts)} levels")
        self._trees.append(self._tree(_Leaf(list(levels))))

    def finish(self) -> None:
        """Write the last parts, and the list of all."""
        for parts in self._parts:
            parts.close()
        meta = {
            "version": 1,
            "asset": {"generator": "compgs"},
            "count": sum(self._counts),
            "counts": self._counts,
            "lodLevels": len(self._parts),
            "filenames": self._names,
            "tree": _paired(self._trees),
        }
        (self._folder / NAME).write_text(json.dumps(meta, separators=(",", ":")), encoding="utf-8")

    def _tree(self, leaf: _Leaf) -> Tree:
        if len(leaf.levels[0]) > MOST_IN_LEAF:
            halves = _halves(leaf)
            if halves:
                return _paired([self._tree(half) for half in halves])
        lods = {}
        for level, splats in enumerate(leaf.levels):
            ordered = splats.rows(sog.morton_order(splats.means))
            lods[str(level)] = self._parts[level].add(ordered)
            self._counts[level] += len(splats)
        return {"bound": leaf.bound, "lods": lods}


def write_levels(path: Path, levels: int, places: Iterator[Sequence[SplatArrays]]) -> None:
    """Write `path`, a lod-meta.json, and its parts beside it; those of an earlier one there go.

    Whatever happens, the folder is as it was, or whole. Raises SplatFileError, OutputError.
    """
    with filling(path.parent) as folder:
        writer = LevelsWriter(folder, levels)
        for place in places:
            writer.add(place)
        writer.finish()
        new = {part.name for part in folder.iterdir()}
    for old in path.parent.iterdir():
        if PART.fullmatch(old.name) and old.name not in new and (old / META).is_file():
            for file in old.iterdir():
                file.unlink()
            old.rmdir()


def _halves(leaf: _Leaf) -> list[_Leaf]:
    """Two leaves, each with half of the finest splats; none where all are in one place.

    A side without splats of a level has those of the next finer one in their place: a viewer that wants the level
    would else show nothing there.
    """
    means = leaf.levels[0].means
    axis = int(np.ptp(means, axis=0).argmax())
    edge = float(np.median(means[:, axis]))
    sides: list[list[SplatArrays]] = [[], []]
    for splats in leaf.levels:
        is_low = splats.means[:, axis] < edge
        for side, mask in zip(sides, (is_low, ~is_low), strict=True):
            if mask.any():
                side.append(splats.rows(mask))
            elif side:
                side.append(side[-1])
            else:  # no finest splats on this side
                return []
    return [_Leaf(side) for side in sides]


def _paired(trees: list[Tree]) -> Tree:
    """One tree of nodes with two children each; neighbours in the list are neighbours in the tree."""
    while len(trees) > 1:
        pairs = [trees[i : i + 2] for i in range(0, len(trees), 2)]
        trees = [pair[0] if len(pair) == 1 else _node(pair) for pair in pairs]
    return trees[0]


def _node(children: list[Tree]) -> Tree:
    bounds = [child["bound"] for child in children]
    low = np.min([bound["min"] for bound in bounds], 0).tolist()
    high = np.max([bound["max"] for bound in bounds], 0).tolist()
    return {"bound": {"min": low, "max": high}, "children": children}


def _box(splats: SplatArrays) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest coordinates of the splats' boxes of one standard deviation."""
    w, x, y, z = normalized(splats.quaternions).T
    rotations = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    scales = np.exp(splats.log_scales.astype(np.float64))
    reach = np.sqrt(np.einsum("abm,mb->ma", rotations**2, scales**2))
    return (splats.means - reach).min(0), (splats.means + reach).max(0)


def _short(corner: np.ndarray) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in corner]
