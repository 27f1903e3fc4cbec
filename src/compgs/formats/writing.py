"""Writing splats: the format is chosen by the ending of the name."""

from collections.abc import Callable
from pathlib import Path

from compgs.errors import OutputError, SplatFileError
from compgs.formats import glb, ply, sog, spz
from compgs.formats.arrays import SplatArrays

# Content of a file of splats, by what the name ends in. `spz` is version 3, which needs nothing to be installed.
WRITERS: dict[str, Callable[[SplatArrays], bytes]] = {
    "ply": ply.encoded,
    "spz": spz.encoded,
    "sog": sog.encoded,
    "glb": glb.encoded,
}
# What becomes of splats that a format cannot hold as they are, in words.
TOLD: dict[str, Callable[[SplatArrays], str | None]] = {"spz": spz.told, "glb": glb.told}
# Formats that say where positions count from, or whose positions are of the world.
KEEP_WORLD_OFFSET = ("ply", "glb")


def writer_of(path: Path) -> str:
    """The format that a name asks for, a key of `WRITERS`. Raises OutputError."""
    name = path.suffix.lower().removeprefix(".")
    if name not in WRITERS:
        raise OutputError(f"{path}: expected a name that ends in {', '.join(f'.{each}' for each in WRITERS)}")
    return name


def encoded(arrays: SplatArrays, name: str) -> bytes:
    """Content of a file of one of `WRITERS`. Raises SplatFileError for what the format cannot hold."""
    if not len(arrays):
        raise SplatFileError(f".{name}: there are no splats to write")
    return WRITERS[name](arrays)


def told(arrays: SplatArrays, name: str) -> str | None:
    """What one of `WRITERS` makes of splats that it cannot hold as they are, in words; None: nothing worth telling."""
    return TOLD[name](arrays) if name in TOLD else None
