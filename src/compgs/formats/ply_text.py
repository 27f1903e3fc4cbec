"""Splats as a .ply file of text: the properties of `ply`, a number after the other, in place of bytes."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats import ply
from compgs.formats.arrays import SplatArrays

FORMAT = "format ascii 1.0"
_LEAST_BYTES = 2  # of a number: a digit, and a blank before the next
_BLOCK = 1 << 20  # bytes of text that are split into words at once


def begins(head: bytes) -> bool:
    """Whether a file begins as a .ply of text does."""
    return ply.begins(head) and head.split(b"\n")[1].split() == FORMAT.encode().split()


def check(path: Path) -> None:
    """Raises SplatFileError for what can be known without reading the splats."""
    _header(path)


def read(path: Path) -> SplatArrays:
    """Raises SplatFileError."""
    header = _header(path)
    names = header.row.names or ()
    before = header.before.numbers
    numbers = np.empty(before + header.count * len(names), np.float32)
    with open(path, "rb") as file:
        file.seek(header.start)
        _fill(numbers, path, file, names, before)
    table = numbers[before:].view([(name, np.float32) for name in names])
    return ply.splats_of(path, header, table)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size. What a number takes is not told apart."""
    header = _header(path)
    return {"header": header.start, "splats": header.bytes - header.start}


def _header(path: Path) -> ply.PlyHeader:
    """Checked against the size of the file."""
    header = ply.described(path, FORMAT)
    count, size, width = header.count, header.bytes - header.start, len(header.row.names or ())
    least = _LEAST_BYTES * (header.before.numbers + count * width) - 1  # nothing need follow the last number
    if size < least:
        raise SplatFileError(
            f"{path}: {count} splats of {width} numbers are at least {least} bytes of text, the file has {size}; "
            "copy it again"
        )
    return header


def _fill(numbers: np.ndarray, path: Path, file: BinaryIO, names: tuple[str, ...], before: int) -> None:
    """Fill an array with a text's first numbers, `before` the first of a splat; others follow of other elements.

    Raises SplatFileError.
    """
    done, cut = 0, b""
    while done < len(numbers):
        block = file.read(_BLOCK)
        words = (cut + block).split()
        # The last word may go on in the next block, unless this is the end, or a blank ends it.
        cut = words.pop() if words and block and not block[-1:].isspace() else b""
        if len(cut) > _BLOCK or (not block and not words):
            raise SplatFileError(
                f"{path}: ends after {done} of {len(numbers)} numbers, or is not text; copy it again"
            )
        words = words[: len(numbers) - done]
        with np.errstate(over="ignore"):  # what is too large becomes infinite, as in a binary file
            numbers[done : done + len(words)] = _parsed(path, words, done - before, names)
        done += len(words)


def _parsed(path: Path, words: list[bytes], first: int, names: tuple[str, ...]) -> np.ndarray:
    """[len(words)] float64; `first` counts from the first number of a splat.

    Raises SplatFileError, naming the first word that is no number.
    """
    try:
        return np.fromiter(map(float, words), np.float64, len(words))
    except ValueError:
        for i, word in enumerate(words, first):
            try:
                float(word)
            except ValueError:
                splat, column = divmod(i, len(names))
                what = f"{names[column]} of splat {splat}" if i >= 0 else "a number before the splats"
                found = word[:20].decode("ascii", errors="replace")
                raise SplatFileError(
                    f"{path}: {what} is {found!r}, expected a number; copy it again"
                ) from None
        raise
