"""A .gltf holds what the .glb file of the same content does, wherever its columns are."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats import SplatArrays, encoded, glb, gltf
from compgs.opening import component_bytes, format_of, open_scene

from .foreign import glb_parts, gltf_file

CASE = Path(__file__).parents[3] / "shared" / "cases" / "gltf_text" / "scene.gltf"
Gltf = dict[str, Any]


@pytest.fixture
def binary(made, tmp_path: Path) -> Path:
    path = tmp_path / "scene.glb"
    path.write_bytes(encoded(made(9, 2), "glb"))
    return path


def same(one: SplatArrays, other: SplatArrays) -> None:
    for name, values in one.columns.items():
        assert np.array_equal(values, other.columns[name]), name


@pytest.mark.parametrize("name", ["scene.bin", "data/my scene.bin"])
def test_columns_in_a_file_below_the_folder_are_read(binary: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / "scene.gltf"
    path.write_bytes(gltf_file(binary.read_bytes(), quote(name)))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(glb_parts(binary.read_bytes())[1])
    assert format_of(path).name == "gltf"
    same(gltf.read(path), glb.read(binary))
    sizes = component_bytes(path)
    assert sum(sizes.values()) == path.stat().st_size + (tmp_path / name).stat().st_size
    assert sizes["harmonics"] == 9 * 8 * 12
    assert open_scene(path).counts == {"splats": 9}


def test_columns_within_the_text_are_read(binary: Path, tmp_path: Path) -> None:
    path = tmp_path / "scene.gltf"
    path.write_bytes(gltf_file(binary.read_bytes()))
    same(gltf.read(path), glb.read(binary))
    assert sum(component_bytes(path).values()) == path.stat().st_size


def test_every_column_may_have_a_buffer_of_its_own(binary: Path, tmp_path: Path) -> None:
    content, data = glb_parts(binary.read_bytes())
    buffers = []
    for i, view in enumerate(content["bufferViews"]):
        start, end = view["byteOffset"], view["byteOffset"] + view["byteLength"]
        (tmp_path / f"{i}.bin").write_bytes(b"x" * i + data[start:end] + b"more than is promised")
        buffers.append({"uri": f"{i}.bin", "byteLength": i + end - start})
        view.update(buffer=i, byteOffset=i)
    path = tmp_path / "scene.gltf"
    path.write_text(json.dumps({**content, "buffers": buffers}))
    same(gltf.read(path), glb.read(binary))


@pytest.mark.skipif(not CASE.is_file(), reason=f"no {CASE}")
def test_a_file_of_another_program_holds_the_numbers_beside_it() -> None:
    read, data = gltf.read(CASE), (CASE.parent / "scene.bin").read_bytes()
    assert (len(read), read.degree) == (24, 1)
    x, y, z = struct.unpack_from("<3f", data, 5 * 12)  # left, up, forward
    np.testing.assert_array_equal(read.means[5], [-x, -y, z])


def changed(change: Callable[[Gltf], object]) -> Callable[[bytes], bytes]:
    def edit(data: bytes) -> bytes:
        content = json.loads(data)
        change(content)
        return json.dumps(content).encode()

    return edit


def uri(value: object) -> Callable[[bytes], bytes]:
    return changed(lambda g: g["buffers"][0].update(uri=value))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-9], "JSON"),
        (lambda data: b'{"buffers":' + b"[" * 100_000, "not JSON"),
        (lambda data: b'["buffers"]', "does not describe splats"),
        (changed(lambda g: g["buffers"][0].pop("uri")), "a buffer without 'uri'"),
        (uri("gone.bin"), "gone.bin, which it names, is missing"),
        (uri("../scene.bin"), "is not the name of a file below its folder"),
        (uri("%2e%2e/scene.bin"), "is not the name of a file below its folder"),
        (uri("/etc/passwd"), "is not the name of a file below its folder"),
        (uri("file:///etc/passwd"), "is not the name of a file below its folder"),
        (uri("https://example.org/scene.bin"), "is not the name of a file below its folder"),
        (uri("..%5cscene.bin"), "is not the name of a file below its folder"),
        (uri(7), "does not describe splats"),
        (uri("data:,abc"), "expected data:...;base64,..."),
        (uri("data:;base64,a$c"), "is no base64"),
        (uri("data:;base64,AAAA"), "bytes are promised, found 3"),
        (changed(lambda g: g["buffers"][0].update(byteLength=10**9)), "1000000000 bytes are promised, found"),
        (changed(lambda g: g["buffers"][0].update(byteLength=-1)), "-1 bytes are promised"),
        (changed(lambda g: g["bufferViews"][0].update(buffer=1)), "is not within buffer 1"),
        (changed(lambda g: g["bufferViews"][0].update(byteOffset=-4)), "is not within buffer 0"),
        (changed(lambda g: g["bufferViews"][0].update(byteLength=10**9)), "is not within buffer 0"),
        (changed(lambda g: g["accessors"][0].update(count=10**9)), "reaches beyond"),
        (changed(lambda g: g["meshes"].clear()), "holds no splats"),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(
    binary: Path, tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "scene.gltf"
    (tmp_path / "scene.bin").write_bytes(glb_parts(binary.read_bytes())[1])
    path.write_bytes(damage(gltf_file(binary.read_bytes(), "scene.bin")))
    for look in (gltf.check, gltf.read):
        with pytest.raises(SplatFileError, match=message) as caught:
            look(path)
        assert str(caught.value).startswith(f"{path}: ")
