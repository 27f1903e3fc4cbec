"""Niantic's .spz: bytes written by hand from the description, round trips within the steps, damage that is named."""

import gzip
import struct
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import MissingDependency, SplatFileError
from compgs.formats import spz
from compgs.formats.arrays import SplatArrays, normalized
from compgs.formats.frames import basis
from compgs.numerics.rotations import rotation_from_quaternion

try:
    import zstandard
except ImportError:
    zstandard = None  # type: ignore[assignment]

WRITTEN_VERSIONS = [
    3,
    pytest.param(4, marks=pytest.mark.skipif(zstandard is None, reason="zstandard is not installed")),
]
VERSIONS = [1, 2, *WRITTEN_VERSIONS]
# One splat, degree 1, 12 fractional bits; axes right, up, back. Position (1, -0.5, 2), opacity 51/255 = 0.2,
# color bytes, log scales (16/16 - 10, ...), rotation of 3: w largest, and coefficients 128 + (0 ... 8).
COLUMNS = {
    "positions": struct.pack("<i", 4096)[:3] + struct.pack("<i", -2048)[:3] + struct.pack("<i", 8192)[:3],
    "opacities": bytes([51]),
    "colors": bytes([0, 255, 102]),
    "scales": bytes([16, 80, 160]),
    # x = 1/4, y = -1/2, z = 0 of 1/sqrt(2) in 511 steps; w left out (index 3 of x, y, z, w).
    "rotations": struct.pack("<I", 3 << 30 | 128 << 20 | (1 << 9 | 256) << 10 | 0),
    "harmonics": bytes(range(128, 137)),
}
SHORT_ROTATION = bytes([191, 64, 128])  # versions 1 and 2: x, y, z = byte / 127.5 - 1
HALF_POSITION = struct.pack("<3e", 1, -0.5, 2)  # version 1


def by_hand(version: int) -> bytes:
    columns = {**COLUMNS, "rotations": SHORT_ROTATION} if version <= 2 else COLUMNS
    columns = {**columns, "positions": HALF_POSITION} if version == 1 else columns
    start = b"NGSP" + struct.pack("<IIBBBB", version, 1, 1, 12, 0, 6 if version == 4 else 0)
    if version < 4:
        return gzip.compress(start + b"".join(columns.values()))
    packed = [zstandard.ZstdCompressor().compress(column) for column in columns.values()]
    table = b"".join(
        struct.pack("<QQ", len(p), len(c)) for p, c in zip(packed, columns.values(), strict=True)
    )
    return start + struct.pack("<I12x", 32) + table + b"".join(packed)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_file_made_by_hand_holds_the_splat_it_describes(tmp_path: Path, version: int) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(by_hand(version))
    splat = spz.read(path)
    # Right, up, back becomes right, down, forward: y and z change their signs.
    np.testing.assert_array_equal(splat.means, [[1, 0.5, -2]])
    np.testing.assert_array_equal(splat.log_scales, [[-9, -5, 0]])
    np.testing.assert_allclose(splat.opacities, [0.2], atol=1e-6)
    np.testing.assert_allclose(splat.dc, np.array([[-0.5, 0.5, -0.1]]) / 0.15, atol=1e-6)
    if version <= 2:
        x, y, z = 191 / 127.5 - 1, 64 / 127.5 - 1, 128 / 127.5 - 1
    else:
        x, y, z = 128 / 511 / 2**0.5, -256 / 511 / 2**0.5, 0
    w = (1 - x * x - y * y - z * z) ** 0.5
    np.testing.assert_allclose(splat.quaternions, [[w, x, -y, -z]], atol=1e-6)
    # Degree 1 is -y, z, -x: the first two change their signs.
    steps = np.arange(9).reshape(3, 3) / 128
    np.testing.assert_array_equal(splat.rest[0], steps * np.array([[-1], [-1], [1]]))
    assert sum(spz.component_bytes(path).values()) == path.stat().st_size


@pytest.mark.parametrize("version", WRITTEN_VERSIONS)
@pytest.mark.parametrize("degree", range(4))
def test_a_round_trip_is_off_by_half_a_step_at_most(made, tmp_path: Path, version: int, degree: int) -> None:
    arrays = made(500, degree)
    path = tmp_path / "a.spz"
    path.write_bytes(spz.encoded(arrays, version))
    again = spz.read(path)
    assert again.degree == degree and len(again) == 500
    step = 2.0 ** -spz.fractional_bits(arrays)
    assert step < np.exp(np.median(arrays.log_scales)) / 8
    np.testing.assert_allclose(again.means, arrays.means, atol=0.5001 * step)
    np.testing.assert_allclose(again.log_scales, arrays.log_scales, atol=0.5001 / 16)
    np.testing.assert_allclose(again.opacities, arrays.opacities, atol=0.5001 / 255)
    inside = np.abs(arrays.dc) < 0.5 / 0.15
    assert inside.mean() > 0.99
    np.testing.assert_allclose(again.dc[inside], arrays.dc[inside], atol=0.5001 / 255 / 0.15)
    one, other = normalized(arrays.quaternions), normalized(again.quaternions)
    angles = 2 * np.arccos(np.minimum(np.abs((one * other).sum(1)), 1))
    assert (
        angles.max() < 0.004
    )  # radians: half a step of 1/511 of sqrt(1/2) in three parts, twice, and the root
    for columns, bits in ((slice(0, 3), 7), (slice(3, 15), 6)):
        kept = np.abs(arrays.rest[:, columns]) < 0.95
        error = np.abs(again.rest - arrays.rest)[:, columns][kept]
        assert not error.size or error.max() < 0.5001 * 2 ** (1 - bits)


def test_the_same_splats_give_the_same_bytes_and_zero_stays_zero(made, tmp_path: Path) -> None:
    arrays = replace(made(9), rest=np.zeros((9, 15, 3), np.float32))
    assert spz.encoded(arrays) == spz.encoded(arrays)
    path = tmp_path / "a.spz"
    path.write_bytes(spz.encoded(arrays))
    assert not spz.read(path).rest.any()


@pytest.mark.parametrize("largest", range(4))
@pytest.mark.parametrize("sign", [1, -1])
def test_every_part_of_a_quaternion_may_be_the_largest(made, tmp_path: Path, largest: int, sign: int) -> None:
    quaternion = np.array([0.3, -0.2, 0.1, -0.25], np.float32)
    quaternion[largest] = sign * 0.9
    arrays = replace(made(1), quaternions=quaternion[None])
    path = tmp_path / "a.spz"
    path.write_bytes(spz.encoded(arrays))
    one, other = normalized(arrays.quaternions)[0], normalized(spz.read(path).quaternions)[0]
    assert abs(one @ other) > 1 - 5e-6


def test_positions_beyond_24_bits_are_refused_and_far_ones_get_fewer_digits(made) -> None:
    arrays = made(5)
    near = spz.fractional_bits(arrays)
    assert spz.fractional_bits(replace(arrays, means=arrays.means * 1e5)) < near
    with pytest.raises(SplatFileError, match=r"positions reach .* write \.ply or \.glb"):
        spz.encoded(replace(arrays, means=arrays.means * 1e8))


def small(made, count: int = 500) -> SplatArrays:
    """Splats of a hundredth of a unit, within some units."""
    return replace(made(count, 0), log_scales=np.full((count, 3), np.log(0.01), np.float32))


def at_distance(arrays: SplatArrays, row: int, distance: float, scale: float = 0.01) -> SplatArrays:
    means, scales = arrays.means.copy(), arrays.log_scales.copy()
    means[row, 1], scales[row] = -distance, np.log(scale)
    return replace(arrays, means=means, log_scales=scales)


@pytest.mark.parametrize("distance", [1e5, 1e30])
def test_one_far_splat_does_not_cost_the_others_their_digits(made, tmp_path: Path, distance: float) -> None:
    arrays, path = small(made), tmp_path / "a.spz"
    path.write_bytes(spz.encoded(at_distance(arrays, 7, distance)))
    again = spz.read(path)
    np.testing.assert_allclose(again.means, np.delete(arrays.means, 7, axis=0), atol=0.01 / 16)
    said = spz.told(at_distance(arrays, 7, distance))
    assert said is not None and said.startswith(f"without 1 of 500 splats: up to {distance:g} world")
    assert spz.told(arrays) is None


def test_what_is_far_and_seen_stays_and_what_that_costs_is_told(made, tmp_path: Path) -> None:
    """A sky of large splats, and many far ones, are no floaters."""
    path = tmp_path / "a.spz"
    sky = at_distance(small(made), 7, 1e5, scale=1e4)
    many = small(made)
    for row in range(10):
        many = at_distance(many, row, 1e5)
    for arrays in (sky, many):
        path.write_bytes(spz.encoded(arrays))
        assert len(spz.read(path)) == 500
        said = spz.told(arrays)
        assert said is not None and "steps of 0.015625 world units, 1.6 times the size of a splat" in said


def test_splats_a_little_far_stay_without_a_word(made) -> None:
    """A bit less than wanted is no loss to see: 524 288 sizes of a splat use all 24."""
    arrays = at_distance(small(made), 7, 6000.0)
    assert spz.without_floaters(arrays) is arrays and spz.told(arrays) is None


def test_version_4_without_zstandard_names_the_remedy(made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "zstandard", None)
    with pytest.raises(MissingDependency, match=r"pip install '\.\[spz\]'.*version 3 needs nothing"):
        spz.encoded(made(2), 4)
    assert spz.encoded(made(2), 3)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_same_without_gzip_holds_the_same_splat(tmp_path: Path, version: int) -> None:
    packed, raw = tmp_path / "packed.spz", tmp_path / "raw.spz"
    packed.write_bytes(by_hand(version))
    raw.write_bytes(gzip.decompress(by_hand(version)))
    assert spz.begins(raw.read_bytes())
    one, other = spz.read(packed), spz.read(raw)
    for name, values in vars(one).items():
        assert np.array_equal(values, getattr(other, name)), name
    assert spz.component_bytes(raw) == {"splats": raw.stat().st_size}
    for damaged in (raw.read_bytes()[:-1], raw.read_bytes() + b"x"):
        raw.write_bytes(damaged)
        with pytest.raises(SplatFileError, match=r"1 splats are .* copy it again"):
            spz.read(raw)


def test_of_harmonics_of_degree_4_those_up_to_3_are_kept(made, tmp_path: Path) -> None:
    """Coefficient by coefficient: the nine of degree 4 are the last 27 bytes of a splat."""
    path = tmp_path / "a.spz"
    content = gzip.decompress(spz.encoded(made(6, 3)))
    path.write_bytes(gzip.compress(content))
    three = spz.read(path)
    splats, harmonics = content[: -6 * 45], np.frombuffer(content[-6 * 45 :], np.uint8).reshape(6, 45)
    longer = np.hstack([harmonics, np.full((6, 27), 255, np.uint8)])
    path.write_bytes(gzip.compress(splats[:12] + b"\x04" + splats[13:] + longer.tobytes()))
    four = spz.read(path)
    assert four.degree == 3
    for name, values in vars(three).items():
        assert np.array_equal(values, getattr(four, name)), name


def unpacked(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    return lambda data: gzip.compress(change(gzip.decompress(data)))


def at(position: int, value: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data[:position] + value + data[position + len(value) :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:4], "ends within its header"),
        (lambda data: data[:-12], "damaged|unpacked, the file holds"),
        (lambda data: data[:20] + bytes([data[20] ^ 255]) + data[21:], "a.spz"),
        (unpacked(at(4, b"\x00")), "version 0 inside gzip"),
        (unpacked(at(4, b"\x01")), "40 splats are"),
        (unpacked(at(4, b"\x04")), "version 4 inside gzip"),
        (unpacked(at(8, struct.pack("<I", 41))), "41 splats are"),
        (unpacked(at(8, struct.pack("<I", 39))), "39 splats are"),
        (unpacked(at(8, struct.pack("<I", 0))), "holds no splats"),
        (unpacked(at(8, struct.pack("<I", 1 << 31))), "promises 2147483648 splats"),
        (unpacked(at(12, b"\x05")), "degree 5"),
        (unpacked(at(13, b"\x19")), "25 fractional bits"),
        (unpacked(lambda data: data + bytes(1 << 16)), "the file holds more than"),
        (
            unpacked(lambda data: at(14, b"\x80")(data) + bytes(80)),
            "its flags 0x80 are not known here: export it as",
        ),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(
    made, tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(damage(spz.encoded(made(40))))
    with pytest.raises(SplatFileError, match=message) as caught:
        spz.read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_file_that_unpacks_to_more_than_it_says_is_not_unpacked_to_its_end(made, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(gzip.decompress(spz.encoded(made(40))) + bytes(1 << 27)))
    tracemalloc.start()
    with pytest.raises(SplatFileError, match="the file holds more than"):
        spz.read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 24


def test_bytes_after_the_end_of_the_compressed_data_are_told(
    made, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(spz.encoded(made(4)) + bytes(16))
    assert len(spz.read(path)) == 4
    (record,) = caplog.records
    assert record.getMessage() == f"{path}: not used: 16 bytes after the end of the compressed data"


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content


def with_extensions(data: bytes, records: bytes, flags: int = 2) -> bytes:
    """A file of version 3 or 4 with extensions where its version has them."""
    if data.startswith(b"NGSP"):
        (table,) = struct.unpack_from("<I", data, 16)
        begin = at(16, struct.pack("<I", table + len(records)))(at(14, bytes([flags]))(data[:table]))
        return begin + records + data[table:]
    content = gzip.decompress(data)
    return gzip.compress(content[:14] + bytes([flags]) + content[15:] + records)


VERSIONS = [
    3,
    pytest.param(4, marks=pytest.mark.skipif(zstandard is None, reason="zstandard is not installed")),
]


@pytest.mark.parametrize("version", VERSIONS)
def test_extensions_that_are_not_known_are_told(
    made, tmp_path: Path, caplog: pytest.LogCaptureFixture, version: int
) -> None:
    path = tmp_path / "a.spz"
    records = record(0xADBE0002, bytes(12)) + record(0x12340001, b"")
    path.write_bytes(with_extensions(spz.encoded(made(4), version), records, flags=2 | 0x80))
    assert len(spz.read(path)) == 4
    (told,) = caplog.records
    expected = "flags 0x80, extension 0xadbe0002 of 12 bytes, extension 0x12340001 of 0 bytes"
    assert told.getMessage() == f"{path}: not used: {expected}"


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    ("records", "message"),
    [
        (b"short", "an extension promises"),
        (struct.pack("<II", 0xADBE0003, 9) + bytes(4), "an extension promises 9 bytes, 4 are there"),
        (record(0xADBE0003, struct.pack("<I", 17)), "axes number 17; expected 1 to 16"),
        (record(0xADBE0003, struct.pack("<I", 0)), "axes number 0"),
    ],
)
def test_extensions_that_are_not_whole_are_refused(
    made, tmp_path: Path, version: int, records: bytes, message: str
) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(with_extensions(spz.encoded(made(4), version), records))
    with pytest.raises(SplatFileError, match=message):
        spz.read(path)


# By the number in the file: the directions of x, y and z, from the extension's description.
AXES = [
    "LDB",
    "RDB",
    "LUB",
    "RUB",
    "LDF",
    "RDF",
    "LUF",
    "RUF",
    "LFD",
    "RFD",
    "LFU",
    "RFU",
    "LBD",
    "RBD",
    "LBU",
    "RBU",
]
HERE = {"R": [1, 0, 0], "L": [-1, 0, 0], "D": [0, 1, 0], "U": [0, -1, 0], "F": [0, 0, 1], "B": [0, 0, -1]}


@pytest.mark.parametrize("number", range(1, 17))
@pytest.mark.parametrize("version", VERSIONS)
def test_axes_that_a_file_declares_are_those_of_its_splats(
    made, tmp_path: Path, version: int, number: int
) -> None:
    """Means, covariances and colors of a file with other axes, by the matrix between the axes alone."""
    path = tmp_path / "a.spz"
    data = spz.encoded(made(5), version)
    path.write_bytes(data)
    usual = spz.read(path)  # right, up, back
    path.write_bytes(with_extensions(data, record(0xADBE0003, struct.pack("<I", number))))
    found = spz.read(path)
    here = [np.array([HERE[letter] for letter in letters]).T for letters in (AXES[number - 1], "RUB")]
    change = here[0] @ here[1].T  # from where the usual axes put something to where these do
    np.testing.assert_allclose(found.means, usual.means @ change.T, atol=1e-6)
    np.testing.assert_allclose(covariances(found), change @ covariances(usual) @ change.T, atol=1e-6)
    directions = np.random.default_rng(0).normal(size=(9, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = np.einsum("nk,mkc->nmc", basis(directions @ change.T, 3)[:, 1:], found.rest)
    expected = np.einsum("nk,mkc->nmc", basis(directions, 3)[:, 1:], usual.rest)
    np.testing.assert_allclose(seen, expected, atol=1e-5)


def covariances(arrays: SplatArrays) -> np.ndarray:
    """[M, 3, 3], float64."""
    turns = np.stack([rotation_from_quaternion(q) for q in normalized(arrays.quaternions)])
    factors = turns * np.exp(arrays.log_scales.astype(np.float64))[:, None]
    return factors @ factors.transpose(0, 2, 1)


@pytest.mark.parametrize("version", VERSIONS)
def test_the_flag_of_antialiased_splats_is_written_and_read(made, tmp_path: Path, version: int) -> None:
    path = tmp_path / "a.spz"
    for antialiased in (False, True):
        data = spz.encoded(replace(made(3), antialiased=antialiased), version)
        path.write_bytes(data)
        header = data if version == 4 else gzip.decompress(data)
        assert header[14] == antialiased
        assert spz.read(path).antialiased is antialiased


@pytest.mark.skipif(zstandard is None, reason="zstandard is not installed")
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (at(4, struct.pack("<I", 3)), "40 splats are 2616 bytes unpacked"),
        (at(4, struct.pack("<I", 5)), "version 5 outside gzip"),
        (at(8, struct.pack("<I", 41)), "positions: 360 bytes, expected 369 for 41 splats"),
        (at(15, b"\x05"), "5 columns, expected 6"),
        (at(16, struct.pack("<I", 31)), "byte 31, outside the file"),
        (at(16, struct.pack("<I", 1 << 30)), "outside the file"),
        (at(32, struct.pack("<Q", 1 << 40)), "do not end where the file does"),
        (lambda data: data + b"x", "do not end where the file does"),
        (lambda data: data[:-1], "do not end where the file does"),
        (at(32 + 96, b"\x00"), "positions: damaged"),
    ],
)
def test_damage_of_version_4_is_named(
    made, tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(damage(spz.encoded(made(40), 4)))
    with pytest.raises(SplatFileError, match=message):
        spz.read(path)


@pytest.mark.skipif(zstandard is None, reason="zstandard is not installed")
def test_a_column_that_unpacks_to_more_than_it_says_is_not_unpacked_to_its_end(made, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    data = spz.encoded(made(40), 4)
    first = struct.unpack_from("<Q", data, 32)[0]
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 28))
    table = struct.pack("<Q", len(bomb)) + data[40:128]
    path.write_bytes(data[:32] + table + bomb + data[128 + first :])
    with pytest.raises(SplatFileError, match="positions: 361 bytes, expected 360"):
        spz.read(path)


def test_arrays_are_read_as_they_are_for_a_model(made, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(spz.encoded(made(3, 2)))
    arrays: SplatArrays = spz.read(path)
    assert {array.dtype for array in arrays.columns.values()} == {np.dtype(np.float32)}
