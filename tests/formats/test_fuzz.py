"""Whatever a file holds, a reader refuses it by an error of the family or gives splats that can be rendered."""

from pathlib import Path

import numpy as np
import pytest

from compgs.errors import CompGSError
from compgs.formats import SplatArrays, encoded, ply_compressed, ply_text
from compgs.formats import glb as glb_format
from compgs.formats import gltf as gltf_format
from compgs.formats import ksplat as ksplat_format
from compgs.formats import ply as ply_format
from compgs.formats import sog as sog_format
from compgs.formats import splat as splat_format
from compgs.formats import spz as spz_format
from compgs.formats.arrays import drawable
from compgs.opening import FORMATS

from .foreign import CompressedPly, gltf_file, ksplat_file, sog_first_files, text_ply, zipped

READERS = {
    "ply": ply_format,
    "spz": spz_format,
    "spz4": spz_format,
    "sog": sog_format,
    "glb": glb_format,
    "splat": splat_format,
    "text": ply_text,
    "compressed": ply_compressed,
    "ksplat": ksplat_format,
    "gltf": gltf_format,
    "sog1": sog_format,
}
ROUNDS = 250


def whole(made, name: str) -> bytes:
    if name == "splat":
        row = np.array([0, 0, 1, 0.1, 0.1, 0.1], "<f4").tobytes() + bytes([9, 9, 9, 255, 255, 128, 128, 128])
        return row * 9
    if name == "text":
        return text_ply(encoded(made(9, 1), "ply"))
    if name == "compressed":
        return CompressedPly(300, 1).content()
    if name == "sog1":
        return zipped(sog_first_files(2))
    if name == "gltf":
        return gltf_file(encoded(made(9, 1), "glb"))
    if name == "ksplat":
        return ksplat_file(1)
    if name == "spz4":
        pytest.importorskip("zstandard")
        return spz_format.encoded(made(30, 1), 4)
    return encoded(made(30, 1), name)


def damaged(data: bytes, chance: np.random.Generator) -> bytes:
    """Some bytes changed, most often near the beginning, where lengths are; or cut; or with bytes put in."""
    array = bytearray(data)
    kind = chance.integers(4)
    if kind == 0:
        return bytes(array[: chance.integers(len(array))])
    if kind == 1:
        place = int(chance.integers(len(array)))
        return bytes(array[:place]) + chance.bytes(int(chance.integers(1, 40))) + bytes(array[place:])
    for _ in range(int(chance.integers(1, 6))):
        limit = len(array) if kind == 2 else min(len(array), 200)
        array[int(chance.integers(limit))] = int(chance.choice([0, 1, 127, 128, 255, chance.integers(256)]))
    return bytes(array)


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_or_read(made, tmp_path: Path, name: str) -> None:
    data, chance, module = whole(made, name), np.random.default_rng(0), READERS[name]
    path = tmp_path / "a"
    refused = 0
    for _ in range(ROUNDS):
        path.write_bytes(damaged(data, chance))
        try:
            arrays: SplatArrays = module.read(path)
        except CompGSError as error:
            refused += 1
            assert str(path) in str(error)
            continue
        assert drawable(path, arrays) is arrays
        assert sum(module.component_bytes(path).values()) == path.stat().st_size
    assert refused > ROUNDS / 10


def test_first_bytes_of_any_kind_are_looked_at_without_harm() -> None:
    chance = np.random.default_rng(0)
    starts = [b"", b"\x1f\x8b", b"PK\x03\x04", b"{", b"ply\n", b"glTF", b"NGSP"]
    for _ in range(200):
        head = starts[chance.integers(len(starts))] + chance.bytes(int(chance.integers(100)))
        assert all(each.begins(head) in (True, False) for each in FORMATS)
