"""Scenes of many .sog files at several levels of detail (PlayCanvas's streamed SOG): `lod-meta.json`.

`sog_streamed_writer` writes them.

| field | what |
|---|---|
| lodLevels | how many levels there are; 0 is the finest |
| counts | splats of each level; older files have none |
| filenames | the `meta.json`, or .sog file, of each part, below the folder of this file |
| environment | one that belongs to every level, such as a sky, or null |
| tree | a node: `children`, nodes; or `lods`, for some levels the rows of a part: `file`, `offset`, `count` |

A level is the rows that the tree names for it, and the environment. A viewer takes the level of each node by its
distance; here a whole scene is of one level.
"""

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from compgs.errors import ConfigError, SplatFileError
from compgs.formats import sog
from compgs.formats.arrays import SplatArrays, drawable, joined
from compgs.notes import note

NAME = "lod-meta.json"
FINEST = 0
MOST_BYTES = 1 << 28  # of this file
_MOST_LEVELS = 1 << 10
_KNOWN = {"version", "asset", "count", "counts", "lodLevels", "environment", "filenames", "tree"}
_MARKS = (b'"lodLevels"', b'"filenames"')
_COPY = "copy the whole folder again"


@dataclass(frozen=True)
class Rows:
    """Some splats of a part."""

    start: int
    end: int


@dataclass(frozen=True)
class StreamedScene:
    """What the file says, checked without a look at its parts."""

    place: Path
    levels: int
    environment: str | None
    rows: tuple[dict[str, list[Rows]], ...]  # of each level, by the name of the part; they do not overlap
    unused: tuple[str, ...]  # what the file says, and nothing here uses

    @property
    def counts(self) -> tuple[int, ...]:
        """Splats of each level, without the environment."""
        return tuple(
            sum(rows.end - rows.start for part in level.values() for rows in part) for level in self.rows
        )


def begins(head: bytes) -> bool:
    """Whether a file begins as a lod-meta.json does."""
    return head.lstrip().startswith(b"{") and any(mark in head for mark in _MARKS)


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without decoding an image of the finest level."""
    scene = read_meta(path)
    for name in _parts(scene, FINEST):
        sog.check(_part(scene, name))


def read(path: Path, level: int = FINEST) -> SplatArrays:
    """The splats of a level. Raises SplatFileError; ConfigError for a level that is not there."""
    scene = read_meta(path)
    check_level(scene, level)
    if scene.unused:
        note(path, f"not used: {', '.join(scene.unused)}")
    found: list[SplatArrays] = []
    says_antialiased: dict[str, bool] = {}
    for name, ranges in scene.rows[level].items():
        part = sog.splats(_part(scene, name))
        last = max(rows.end for rows in ranges)
        if last > len(part):
            raise SplatFileError(f"{path}: names {last} splats of {name}, which holds {len(part)}; {_COPY}")
        found += [part.rows(np.arange(rows.start, rows.end)) for rows in ranges]
        says_antialiased[name] = part.antialiased
    if scene.environment:
        found.append(sog.splats(_part(scene, scene.environment)))
        says_antialiased[scene.environment] = found[-1].antialiased
    _tell_of_disagreement(path, says_antialiased)
    return drawable(path, joined(found))


def _tell_of_disagreement(path: Path, says_antialiased: dict[str, bool]) -> None:
    """A scene is drawn in one way: as its first part says."""
    (first, drawn), *_ = says_antialiased.items()
    others = [name for name, says in says_antialiased.items() if says != drawn]
    if others:
        one, other = ("antialiased", "not antialiased") if drawn else ("not antialiased", "antialiased")
        named = others[0] if len(others) == 1 else f"{others[0]} and {len(others) - 1} more parts"
        note(path, f"{first} is {one}, {named} {other}: all of them are drawn {one}, as the first part says")


def parts(path: Path) -> list[Path]:
    """The meta.json, or .sog file, of each part of every level. Raises SplatFileError for one that is not there."""
    scene = read_meta(path)
    names = {name for level in range(scene.levels) for name in _parts(scene, level)}
    return [_part(scene, name) for name in sorted(names)]


def component_bytes(path: Path, level: int = FINEST) -> dict[str, int]:
    """Bytes of each component of a level; they sum to the size of this file and of the parts that it needs."""
    scene = read_meta(path)
    check_level(scene, level)
    sizes = {"container": path.stat().st_size}
    for name in _parts(scene, level):
        for component, size in sog.component_bytes(_part(scene, name)).items():
            sizes[component] = sizes.get(component, 0) + size
    return sizes


def check_level(scene: StreamedScene, level: int) -> None:
    """Raises ConfigError for a level that the scene does not have, or that is empty."""
    if not 0 <= level < scene.levels:
        raise ConfigError(
            f"{scene.place}: level {level}: expected 0, the finest, to {scene.levels - 1}, the coarsest"
        )
    if not scene.counts[level]:
        full = ", ".join(str(i) for i, count in enumerate(scene.counts) if count)
        raise SplatFileError(
            f"{scene.place}: level {level} holds no splats; there are some in {full or 'none'}"
        )


def read_meta(path: Path) -> StreamedScene:
    """Everything but the parts. Raises SplatFileError."""
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise SplatFileError(f"{path}: {size} bytes; expected at most {MOST_BYTES}")
    try:
        meta = json.loads(path.read_bytes())
        scene = _scene(path, meta)
    except (ValueError, RecursionError) as error:
        raise SplatFileError(f"{path}: is not JSON ({error}); copy it again") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise SplatFileError(
            f"{path}: does not describe a streamed SOG ({type(error).__name__}: {error})"
        ) from error
    return scene


def _scene(path: Path, meta: dict[str, Any]) -> StreamedScene:
    if meta.get("version", 1) != 1:
        raise SplatFileError(f"{path}: version {meta['version']!r} of streamed SOG; expected 1")
    levels, names = meta["lodLevels"], meta["filenames"]
    if not _whole(levels) or not 0 < levels <= _MOST_LEVELS:
        raise SplatFileError(f"{path}: {levels!r} levels; expected 1 to {_MOST_LEVELS}")
    for name in [*names, *([meta["environment"]] if meta.get("environment") else [])]:
        _check_name(path, name)
    names = [str(PurePosixPath(name)) for name in names]  # one name for one file
    rows: tuple[dict[str, list[Rows]], ...] = tuple({} for _ in range(levels))
    for level, file, start, count in _references(path, meta["tree"]):
        if not level < levels or not file < len(names):
            raise SplatFileError(
                f"{path}: names level {level} of {levels}, file {file} of {len(names)}; {_COPY}"
            )
        if count:
            rows[level].setdefault(names[file], []).append(Rows(start, start + count))
    for by_part in rows:
        for name, ranges in by_part.items():
            ranges.sort(key=lambda each: each.start)
            if any(one.end > other.start for one, other in itertools.pairwise(ranges)):
                raise SplatFileError(f"{path}: names splats of {name} twice; {_COPY}")
    unused = tuple(sorted(set(meta) - _KNOWN))
    scene = StreamedScene(path, levels, meta.get("environment") or None, rows, unused)
    promised = meta.get("counts")
    if promised is not None and list(promised) != list(scene.counts):
        raise SplatFileError(
            f"{path}: promises {promised} splats, its tree names {list(scene.counts)}; {_COPY}"
        )
    return scene


def _references(path: Path, tree: dict[str, Any]) -> Iterator[tuple[int, int, int, int]]:
    """Level, file, first row and number of rows, for each that a node names."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        for key, entry in node.get("lods", {}).items():
            numbers = (int(key), entry["file"], entry["offset"], entry["count"])
            if not all(_whole(number) and number >= 0 for number in numbers):
                raise SplatFileError(f"{path}: expected whole numbers in its tree, found {numbers}; {_COPY}")
            yield numbers
        waiting += reversed(node.get("children", []))


def _whole(number: object) -> bool:
    return isinstance(number, int) and not isinstance(number, bool)


def _check_name(path: Path, name: object) -> None:
    """Raises SplatFileError for what does not lie below the folder of the file."""
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or ".." in parts or parts[0] == "/" or "\\" in str(name) or ":" in str(name):
        raise SplatFileError(f"{path}: {name!r} is not the name of a file below its folder")


def _parts(scene: StreamedScene, level: int) -> list[str]:
    """Names of what a level needs."""
    return [*scene.rows[level], *([scene.environment] if scene.environment else [])]


def _part(scene: StreamedScene, name: str) -> Path:
    """Raises SplatFileError for a part that is not there."""
    file = scene.place.parent / name
    if not file.is_file():
        raise SplatFileError(f"{scene.place}: {name}, which it names, is missing; {_COPY}")
    return file
