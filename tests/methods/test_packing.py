"""The container of the comparison's methods: nothing in it is trusted."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats.packed import (
    MAGIC,
    Packed,
    check,
    encoded,
    packed_bits,
    read,
    unpacked_bits,
    write_packed,
)
from compgs.opening import component_bytes, open_scene

RNG = np.random.default_rng(0)
ARRAYS = {
    "zeros": np.zeros((40, 3), np.float32),
    "noise": RNG.integers(0, 256, 500).astype(np.uint8),
    "codes": RNG.integers(-9, 9, (20, 2)).astype(np.int16),
    "none": np.zeros((0, 4), np.float16),
    "one": np.array(3.5, np.float64),
}


def made(path: Path, **changed: object) -> Path:
    """A file with another header than `encoded` would give it."""
    header = {
        "version": 1,
        "method": "toy",
        "facts": {},
        "arrays": [["a", "|u1", [4], "raw", 4, zlib.crc32(b"abcd")]],
        **changed,
    }
    text = zlib.compress(json.dumps(header).encode())
    path.write_bytes(struct.pack("<8sII", MAGIC, len(text), zlib.crc32(text)) + text + b"abcd")
    return path


@pytest.mark.parametrize("codecs", [("raw",), ("deflate",), ("lzma",), ("raw", "deflate", "lzma")])
def test_what_is_packed_is_what_is_read(tmp_path: Path, codecs: tuple[str, ...]) -> None:
    path = tmp_path / "a.packed"
    facts = {"degree": 2, "scale": 0.5, "name": "x", "list": [1, 2]}
    written = write_packed(path, Packed("toy", facts, ARRAYS), codecs)
    again = read(path)
    assert (again.method, again.facts) == ("toy", facts)
    for name, array in ARRAYS.items():
        assert again.arrays[name].dtype == array.dtype and again.arrays[name].shape == array.shape
        np.testing.assert_array_equal(again.arrays[name], array)
    assert sum(component_bytes(path).values()) == path.stat().st_size == written
    check(path)


def test_each_array_is_as_small_as_any_codec_makes_it() -> None:
    sizes = {codec: len(encoded(Packed("toy", {}, ARRAYS), (codec,))) for codec in ("raw", "deflate", "lzma")}
    assert len(encoded(Packed("toy", {}, ARRAYS))) < min(sizes.values())


@pytest.mark.parametrize("bits", [1, 3, 8, 12, 31, 32])
def test_whole_numbers_take_as_many_bits_as_they_need(bits: int) -> None:
    values = RNG.integers(0, 1 << bits, 37)
    data = packed_bits(values, bits)
    text = "".join(f"{value:0{bits}b}" for value in values)
    assert data.tobytes() == int(text.ljust(8 * len(data), "0"), 2).to_bytes(-(-37 * bits // 8), "big")
    np.testing.assert_array_equal(unpacked_bits(data, bits, 37), values)


def test_a_flipped_bit_or_a_missing_end_is_noticed_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "a.packed"
    write_packed(path, Packed("toy", {"degree": 3}, ARRAYS))
    data = path.read_bytes()
    for place in range(0, len(data), 7):
        flipped = bytearray(data)
        flipped[place] ^= 4
        path.write_bytes(flipped)
        if place >= len(MAGIC):
            with pytest.raises(SplatFileError, match=r"a\.packed"):
                read(path)
        path.write_bytes(data[:place])
        with pytest.raises(SplatFileError, match=r"a\.packed"):
            check(path)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"version": 2}, "version 2, expected 1"),
        ({"method": "../toy"}, "not those of a method"),
        ({"facts": 3}, "not those of a method"),
        ({"arrays": [["a", "|u1", [4], "raw", 4, 7]]}, "a are damaged"),
        ({"arrays": [["a", "|O8", [4], "raw", 4, 7]]}, "array 'a'"),
        ({"arrays": [["a", "|u1", [-4], "raw", 4, 7]]}, "array 'a'"),
        ({"arrays": [["a", "|u1", [4], "pickle", 4, 7]]}, "array 'a'"),
        ({"arrays": [["a", "|u1", [4], "raw", 2, 7], ["a", "|u1", [4], "raw", 2, 7]]}, "array 'a'"),
        ({"arrays": [["a", "<f8", [1 << 32], "raw", 4, 7]]}, "more than 4294967296 bytes"),
        ({"arrays": [["a", "|u1", [4], "raw", 5, 7]]}, "promises"),
        ({"arrays": [["a", "|u1", [4]]]}, "cannot be read"),
        ({"arrays": [["a", "|u1", [9], "raw", 4, zlib.crc32(b"abcd")]]}, "expected 9 bytes, found 4"),
        ({"arrays": [["a", "|u1", [9], "lzma", 4, zlib.crc32(b"abcd")]]}, "a are damaged"),
    ],
)
def test_headers_that_lie_are_refused(tmp_path: Path, changed: dict[str, object], message: str) -> None:
    with pytest.raises(SplatFileError, match=message):
        read(made(tmp_path / "a.packed", **changed))


def test_an_array_that_unpacks_to_more_than_promised_is_not_unpacked(tmp_path: Path) -> None:
    bomb = zlib.compressobj(9, wbits=-15)
    data = bomb.compress(bytes(1 << 24)) + bomb.flush()
    entry = ["a", "|u1", [4], "deflate", len(data), zlib.crc32(data)]
    header = {"version": 1, "method": "toy", "facts": {}, "arrays": [entry]}
    text = zlib.compress(json.dumps(header).encode())
    path = tmp_path / "a.packed"
    path.write_bytes(struct.pack("<8sII", MAGIC, len(text), zlib.crc32(text)) + text + data)
    with pytest.raises(SplatFileError, match="expected 4 bytes, found 5"):
        read(path)


def test_arrays_and_facts_are_asked_for_by_what_they_must_be(tmp_path: Path) -> None:
    packed = Packed("toy", {"degree": 3, "scale": 0.5, "name": "x"}, ARRAYS, tmp_path / "a.packed")
    assert packed.array("codes", np.int16, (None, 2)) is ARRAYS["codes"]
    assert (packed.whole_number("degree", 0, 3), packed.number("scale")) == (3, 0.5)
    with pytest.raises(SplatFileError, match=r"a\.packed: there are no colors"):
        packed.array("colors", np.int16, (2,))
    for kind, shape in ((np.uint16, (None, 2)), (np.int16, (None, 3)), (np.int16, (20,))):
        with pytest.raises(SplatFileError, match=r"codes: expected .* found int16 of \(20, 2\)"):
            packed.array("codes", kind, shape)
    for name, low in (("degree", 4), ("scale", 0), ("name", 0), ("none", 0)):
        with pytest.raises(SplatFileError, match=f"{name}: expected"):
            packed.whole_number(name, low, 9)
    with pytest.raises(SplatFileError, match="name: expected a number"):
        packed.number("name")


def test_a_file_of_an_unknown_method_says_which_are_known(tmp_path: Path) -> None:
    with pytest.raises(SplatFileError, match=r"a file of method other; known here are those of .*toy"):
        open_scene(made(tmp_path / "a.packed", method="other"))
