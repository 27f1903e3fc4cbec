"""A .compressed.ply holds what its ranges and packed words say: read by hand, one splat at a time.

The layout alone is followed, in numbers of Python.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats import ply_compressed
from compgs.opening import component_bytes, format_of, open_scene

from .foreign import CompressedPly


@pytest.mark.parametrize(
    ("count", "degree", "colors"), [(5, 0, True), (700, 0, False), (256, 1, True), (257, 3, True)]
)
def test_a_splat_is_what_its_words_say(tmp_path: Path, count: int, degree: int, colors: bool) -> None:
    path, file = tmp_path / "a.compressed.ply", CompressedPly(count, degree, colors=colors)
    path.write_bytes(file.content())
    assert format_of(path).name == "ply"
    read = ply_compressed.read(path)
    assert len(read) == count and read.degree == degree
    for index in {0, 1, 4, 255 % count, count // 2, count - 1}:
        for name, expected in file.splat(index).items():
            found = getattr(read, name)[index]
            found = found.T.reshape(-1) if name == "rest" else found  # in the file channel by channel
            np.testing.assert_allclose(found, expected if len(expected) != 1 else expected[0], atol=2e-6)
    assert sum(component_bytes(path).values()) == path.stat().st_size
    assert open_scene(path).counts == {"splats": count}


def edited(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data.replace(old, new)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-1], "the header promises .* bytes, the file has .* copy it again"),
        (lambda data: data + b"x", "the header promises"),
        (edited(b"element vertex 300", b"element vertex 999999999999"), "the header promises"),
        (edited(b"element vertex 300", b"element vertex 9999999999999"), "element NAME COUNT"),
        (edited(b"element sh 300", b"element vertex 300"), "element NAME COUNT"),
        (edited(b"uint packed_scale", b"float packed_scale"), "'packed_scale' of element 'vertex' is of type float32"),
        (edited(b"float max_scale_z", b"float max_scale_w"), "'max_scale_z' of element 'chunk' is missing"),
        (edited(b"float max_b", b"float max_a"), "'max_b' of element 'chunk' is missing"),
        (edited(b"uint packed_color", b"list uchar int packed_color"), "not a property"),
        (edited(b"uchar f_rest_8", b"uchar f_rest_7"), "not a property"),
        (edited(b"uchar f_rest_8", b"uchar f_rest_9"), "'f_rest_8' of element 'sh' is missing"),
        (edited(b"element sh 300\n", b"element sh 150\nproperty ushort two\n"), "the header promises"),
        (edited(b"binary_little", b"binary_big"), "expected 'format binary_little_endian"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_with_what_is_wrong(
    tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(damage(CompressedPly(300, 1).content()))
    assert ply_compressed.begins(path.read_bytes())
    for look in (ply_compressed.check, ply_compressed.read):
        with pytest.raises(SplatFileError, match=message) as caught:
            look(path)
        assert str(caught.value).startswith(f"{path}: ")


def test_a_count_of_chunks_that_is_not_that_of_the_splats_is_refused(tmp_path: Path) -> None:
    path, file = tmp_path / "a.ply", CompressedPly(300)
    file.words = file.words[:256]  # one chunk is enough
    path.write_bytes(file.content())
    with pytest.raises(SplatFileError, match="2 chunks for 256 splats, expected 1"):
        ply_compressed.check(path)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(CompressedPly(0).content())
    with pytest.raises(SplatFileError, match="holds no splats"):
        ply_compressed.check(path)


def test_gsply_reads_the_same(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply")
    path = tmp_path / "a.compressed.ply"
    path.write_bytes(CompressedPly(300, 2).content())
    theirs, ours = gsply.plyread(str(path)), ply_compressed.read(path)
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-5)
    np.testing.assert_allclose(theirs.quats, ours.quaternions, atol=1e-5)
