"""KHR_gaussian_splatting in binary glTF: taken apart by hand, and read from what other writers may do."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats import glb
from compgs.formats.arrays import SplatArrays, normalized
from compgs.formats.frames import LEFT_UP_FORWARD, basis, transformed, turned
from compgs.numerics.rotations import rotation_from_quaternion

PREFIX = "KHR_gaussian_splatting:"


def taken_apart(data: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk, by the description of glTF alone."""
    magic, version, length, text_length, text_type = struct.unpack_from("<4sIIII", data)
    assert (magic, version, length, text_type) == (b"glTF", 2, len(data), 0x4E4F534A)
    binary_length, binary_type = struct.unpack_from("<II", data, 20 + text_length)
    assert binary_type == 0x004E4942 and text_length % 4 == binary_length % 4 == 0
    assert 28 + text_length + binary_length == len(data)
    return json.loads(data[20 : 20 + text_length]), data[28 + text_length :]


def put_together(gltf: Any, binary: bytes) -> bytes:
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    body = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def attribute(gltf: dict[str, Any], binary: bytes, name: str) -> np.ndarray:
    accessor = gltf["accessors"][gltf["meshes"][0]["primitives"][0]["attributes"][name]]
    view = gltf["bufferViews"][accessor["bufferView"]]
    parts = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    return np.frombuffer(binary, dtype, accessor["count"] * parts, view["byteOffset"]).reshape(-1, parts)


@pytest.mark.parametrize("degree", range(4))
def test_the_attributes_are_those_of_the_extension(made, degree: int) -> None:
    arrays = made(6, degree)
    gltf, binary = taken_apart(glb.encoded(arrays))
    assert gltf["extensionsUsed"] == ["KHR_gaussian_splatting"]
    primitive = gltf["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension["kernel"] == "ellipse" and extension["colorSpace"] == "srgb_rec709_display"
    coefficients = [(l, n) for l in range(degree + 1) for n in range(2 * l + 1)]
    expected = {f"{PREFIX}SH_DEGREE_{l}_COEF_{n}" for l, n in coefficients}
    expected |= {f"{PREFIX}{name}" for name in ("ROTATION", "SCALE", "OPACITY")} | {"POSITION", "COLOR_0"}
    assert primitive["attributes"].keys() == expected

    # Right, down, forward becomes left, up, forward.
    positions = attribute(gltf, binary, "POSITION")
    np.testing.assert_array_equal(positions, arrays.means * [-1, -1, 1])
    place = gltf["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose([place["min"], place["max"]], [positions.min(0), positions.max(0)], rtol=1e-6)
    w, x, y, z = normalized(arrays.quaternions).T
    np.testing.assert_allclose(
        attribute(gltf, binary, f"{PREFIX}ROTATION"), np.column_stack([-x, -y, z, w]), atol=1e-7
    )
    np.testing.assert_allclose(
        attribute(gltf, binary, f"{PREFIX}SCALE"), np.exp(arrays.log_scales), rtol=1e-6
    )
    np.testing.assert_allclose(attribute(gltf, binary, f"{PREFIX}OPACITY")[:, 0], arrays.opacities, rtol=1e-6)
    np.testing.assert_array_equal(attribute(gltf, binary, f"{PREFIX}SH_DEGREE_0_COEF_0"), arrays.dc)
    if degree:  # degree 1 is -y, z, -x
        for n, sign in enumerate((-1, 1, -1)):
            values = attribute(gltf, binary, f"{PREFIX}SH_DEGREE_1_COEF_{n}")
            np.testing.assert_array_equal(values, sign * arrays.rest[:, n])
    colors = attribute(gltf, binary, "COLOR_0") / 255
    np.testing.assert_allclose(colors[:, :3], np.clip(0.5 + 0.28209479 * arrays.dc, 0, 1), atol=0.5001 / 255)
    np.testing.assert_allclose(colors[:, 3], arrays.opacities, atol=0.5001 / 255)


@pytest.mark.parametrize("degree", range(4))
def test_a_round_trip_is_off_by_rounding_alone(made, tmp_path: Path, degree: int) -> None:
    arrays = replace(made(50, degree), world_offset=(4.2e6, -51.5, 3.0))
    path = tmp_path / "a.glb"
    path.write_bytes(glb.encoded(arrays))
    again = glb.read(path)
    for name in ("means", "dc", "rest"):
        np.testing.assert_array_equal(getattr(again, name), getattr(arrays, name))
    np.testing.assert_allclose(again.log_scales, arrays.log_scales, atol=1e-6)
    np.testing.assert_allclose(again.opacities, arrays.opacities, atol=1e-6)
    np.testing.assert_allclose(again.quaternions, normalized(arrays.quaternions), atol=1e-6)
    assert again.world_offset == arrays.world_offset
    sizes = glb.component_bytes(path)
    assert sum(sizes.values()) == path.stat().st_size and sizes["positions"] == 600


def edited(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
    def edit(data: bytes) -> bytes:
        gltf, binary = taken_apart(data)
        changed = change(gltf)
        return put_together(changed if isinstance(changed, list) else gltf, binary)

    return edit


def test_nodes_that_turn_move_and_scale_are_obeyed(made, tmp_path: Path) -> None:
    arrays = made(5)
    quaternion = np.array([0.5, -0.1, 0.7, 0.3])
    quaternion /= np.linalg.norm(quaternion)

    def nest(gltf: dict[str, Any]) -> None:
        w, x, y, z = quaternion.tolist()
        up = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 7, 8, 9, 1]  # column by column
        gltf["nodes"] = [
            {"mesh": 0, "scale": [2, 2, 2], "rotation": [x, y, z, w], "translation": [1, 2, 3]},
            {"matrix": up, "children": [0]},
        ]
        gltf["scenes"] = [{"nodes": [1]}]

    path = tmp_path / "a.glb"
    path.write_bytes(edited(nest)(glb.encoded(arrays)))
    found = glb.read(path)
    inner, outer = np.eye(4), np.eye(4)
    inner[:3, :3] = 2 * rotation_from_quaternion(quaternion)
    inner[:3, 3] = [1, 2, 3]
    outer[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    outer[:3, 3] = [7, 8, 9]
    expected = turned(transformed(turned(arrays, LEFT_UP_FORWARD), outer @ inner), LEFT_UP_FORWARD)
    for name in ("means", "log_scales", "dc", "rest"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-5)
    np.testing.assert_allclose(found.quaternions, normalized(expected.quaternions), atol=1e-5)
    np.testing.assert_allclose(found.world_offset, expected.world_offset)


def test_columns_of_smaller_integers_and_rows_with_room_are_read(made, tmp_path: Path) -> None:
    arrays = made(4, 0)
    gltf, binary = taken_apart(glb.encoded(arrays))
    attributes = gltf["meshes"][0]["primitives"][0]["attributes"]
    opacities = np.array([0, 51, 102, 255], np.uint8)
    rotations = np.array([[127, 0, 0, 0], [0, 127, 0, 0], [0, 0, -127, 0], [90, 0, 0, 90]], np.int8)
    rows = np.zeros((4, 12), np.uint8)
    rows[:, 4:8], rows[:, 8] = rotations.view(np.uint8), opacities
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": 48, "byteStride": 12}
    gltf["bufferViews"].append(view)
    gltf["buffers"][0]["byteLength"] += 48
    number = len(gltf["bufferViews"]) - 1
    common = {"bufferView": number, "count": 4, "normalized": True}
    gltf["accessors"][attributes[f"{PREFIX}ROTATION"]] = {
        **common,
        "componentType": 5120,
        "type": "VEC4",
        "byteOffset": 4,
    }
    gltf["accessors"][attributes[f"{PREFIX}OPACITY"]] = {
        **common,
        "componentType": 5121,
        "type": "SCALAR",
        "byteOffset": 8,
    }
    gltf["extensionsRequired"] = ["KHR_gaussian_splatting", "KHR_mesh_quantization"]
    path = tmp_path / "a.glb"
    path.write_bytes(put_together(gltf, binary + rows.tobytes()))
    found = glb.read(path)
    np.testing.assert_allclose(found.opacities, opacities / 255, atol=2e-6)
    # x-y-z-w in the file, half a turn about z: x and y change their signs.
    expected = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, -1], [90 / 127, -90 / 127, 0, 0]])
    np.testing.assert_allclose(found.quaternions, expected, atol=1e-6)


def primitive(gltf: dict[str, Any]) -> dict[str, Any]:
    return gltf["meshes"][0]["primitives"][0]


def accessor(gltf: dict[str, Any], name: str) -> dict[str, Any]:
    return gltf["accessors"][primitive(gltf)["attributes"][name]]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:19], "ends within its header"),
        (lambda data: data[:-4], "copy it again"),
        (lambda data: data[:4] + b"\x01" + data[5:], "version 1"),
        (lambda data: data[:20] + b"]" + data[21:], "not JSON"),
        (edited(lambda g: []), "does not describe splats"),
        (edited(lambda g: g.update(meshes=[])), "holds no splats"),
        (edited(lambda g: g.update(meshes="none")), "does not describe splats"),
        (edited(lambda g: g.update(extensionsRequired=["EXT_small"])), "needs the extension EXT_small"),
        (
            edited(lambda g: primitive(g)["extensions"]["KHR_gaussian_splatting"].update(colorSpace="other")),
            "colors in other",
        ),
        (edited(lambda g: primitive(g)["attributes"].pop(f"{PREFIX}SCALE")), "SCALE is missing"),
        (
            edited(lambda g: primitive(g)["attributes"].pop(f"{PREFIX}SH_DEGREE_2_COEF_1")),
            "COEF_1 is missing",
        ),
        (edited(lambda g: primitive(g)["attributes"].update(POSITION="x")), "expected numbers of accessors"),
        (edited(lambda g: primitive(g)["attributes"].update(POSITION=999)), "does not describe splats"),
        (edited(lambda g: accessor(g, "POSITION").update(count=41)), "beyond its part|one number of splats"),
        (edited(lambda g: accessor(g, "POSITION").update(count=1 << 40)), "beyond its part"),
        (edited(lambda g: accessor(g, "POSITION").update(count=-1)), "expected whole numbers"),
        (edited(lambda g: accessor(g, "POSITION").update(byteOffset=4)), "beyond its part"),
        (edited(lambda g: accessor(g, "POSITION").update(type="VEC4")), "beyond its part|has 4 parts"),
        (edited(lambda g: accessor(g, "POSITION").update(sparse={})), "sparse"),
        (edited(lambda g: g["bufferViews"][0].update(byteLength=1 << 40)), "beyond its part"),
        (edited(lambda g: g["buffers"][0].update(uri="other.bin")), "in another file"),
        (edited(lambda g: g.update(nodes=[{"children": [0]}])), "not a tree"),
        (edited(lambda g: g.update(nodes=[{"children": [1, 1]}, {}])), "not a tree"),
        (edited(lambda g: g.update(nodes=[{}])), "in no scene"),
        (edited(lambda g: g["nodes"][0].update(scale=[1, 2, 1])), "stretches the splats"),
        (edited(lambda g: g["nodes"][0].update(scale=[0, 0, 0])), "stretches the splats"),
        (edited(lambda g: g["nodes"][0].update(rotation=[0, 0, 0, 0])), "does not describe splats"),
        (edited(lambda g: g["nodes"][0].update(translation=[1, 2])), "does not describe splats"),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(
    made, tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(damage(glb.encoded(made(40))))
    with pytest.raises(SplatFileError, match=message) as caught:
        glb.read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_splat_without_a_place_is_left_out(made, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.glb"
    arrays: SplatArrays = made(3)
    gltf, binary = taken_apart(glb.encoded(arrays))
    start = gltf["bufferViews"][accessor(gltf, "POSITION")["bufferView"]]["byteOffset"]
    path.write_bytes(
        put_together(gltf, binary[: start + 12] + struct.pack("<f", np.inf) + binary[start + 16 :])
    )
    np.testing.assert_array_equal(glb.read(path).means, arrays.means[[0, 2]])
    assert "1 of 3 splats were left out" in caplog.text


def test_a_mesh_that_two_nodes_place_is_there_twice(made, tmp_path: Path) -> None:
    arrays = made(5)
    move = {"mesh": 0, "translation": [10, 0, 0]}
    path = tmp_path / "a.glb"
    data = edited(lambda g: g.update(nodes=[{"mesh": 0}, move], scenes=[{"nodes": [0, 1]}]))(
        glb.encoded(arrays)
    )
    path.write_bytes(data)
    found = glb.read(path)
    np.testing.assert_array_equal(found.means[:5], arrays.means)
    np.testing.assert_allclose(
        found.means[5:], arrays.means - np.float32([10, 0, 0]), rtol=1e-6
    )  # left is -x
    np.testing.assert_array_equal(found.rest[5:], arrays.rest)
    sizes = glb.component_bytes(path)
    assert sum(sizes.values()) == len(data) and sizes["positions"] == 60  # there once


def test_several_meshes_and_primitives_are_read_and_what_no_scene_shows_is_not(made, tmp_path: Path) -> None:
    arrays = made(4, 1)

    def more(gltf: dict[str, Any]) -> None:
        gltf["meshes"] = [
            {"primitives": [primitive(gltf)]},
            {"primitives": [primitive(gltf), primitive(gltf)]},
            {"primitives": [primitive(gltf)]},
        ]
        hidden = {"KHR_node_visibility": {"visible": False}}
        gltf["nodes"] = [
            {"mesh": 0, "children": [1]},
            {"mesh": 1, "translation": [0, 3, 0]},
            {"mesh": 2},
            {"mesh": 2, "extensions": hidden},
        ]
        gltf["scenes"] = [{"nodes": [2]}, {"nodes": [0, 3]}]
        gltf["scene"] = 1

    path = tmp_path / "a.glb"
    path.write_bytes(edited(more)(glb.encoded(arrays)))
    found = glb.read(path)
    expected = np.concatenate([arrays.means, *[arrays.means - np.float32([0, 3, 0])] * 2])  # up is -y
    np.testing.assert_allclose(found.means, expected, atol=1e-6)


def test_a_mirroring_node_mirrors_the_splats(made, tmp_path: Path) -> None:
    arrays = made(6)
    path = tmp_path / "a.glb"
    path.write_bytes(edited(lambda g: g["nodes"][0].update(scale=[2, -2, 2]))(glb.encoded(arrays)))
    found, mirror = glb.read(path), np.diag([2.0, -2.0, 2.0])
    np.testing.assert_allclose(found.means, arrays.means @ mirror, rtol=1e-6)
    np.testing.assert_allclose(
        covariances(found), mirror @ covariances(arrays) @ mirror, rtol=1e-4, atol=1e-7
    )
    directions = np.random.default_rng(0).normal(size=(9, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = np.einsum("nk,mkc->nmc", basis(directions, 3)[:, 1:], found.rest)
    mirrored = np.einsum("nk,mkc->nmc", basis(directions * [1, -1, 1], 3)[:, 1:], arrays.rest)
    np.testing.assert_allclose(seen, mirrored, atol=1e-5)


def covariances(arrays: SplatArrays) -> np.ndarray:
    """[M, 3, 3], float64."""
    turns = np.stack([rotation_from_quaternion(q) for q in normalized(arrays.quaternions)])
    factors = turns * np.exp(arrays.log_scales.astype(np.float64))[:, None]
    return factors @ factors.transpose(0, 2, 1)


def test_nodes_may_not_make_more_splats_than_a_file_can_hold(made, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    for nodes, message in ((5000, "more than 4096 times"), (4000, "promises 160000 splats")):
        every = edited(
            lambda g, n=nodes: g.update(nodes=[{"mesh": 0}] * n, scenes=[{"nodes": list(range(n))}])
        )
        content = every(glb.encoded(made(40, 0)))
        path.write_bytes(content)
        if nodes == 4000 and 8 * len(content) > 160_000:
            continue
        with pytest.raises(SplatFileError, match=message):
            glb.read(path)


def extended(gltf: dict[str, Any]) -> dict[str, Any]:
    return primitive(gltf)["extensions"]["KHR_gaussian_splatting"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda g: extended(g).update(kernel="box"), "kernel 'box' (drawn as ellipse)"),
        (lambda g: extended(g).update(projection="fisheye"), "projection 'fisheye' (drawn as perspective)"),
        (lambda g: extended(g).update(sortingMethod="zDepth"), "sortingMethod 'zDepth'"),
        (lambda g: extended(g).update(extensions={"EXT_more": {}}), "extension EXT_more"),
        (lambda g: primitive(g)["attributes"].update(_TIME=0), "attribute _TIME"),
        (lambda g: g["meshes"].append({"primitives": [{"attributes": {}}]}), "1 meshes of triangles"),
        (lambda g: g.update(animations=[{}]), "animations"),
    ],
)
def test_what_is_not_used_is_told(
    made, tmp_path: Path, caplog: pytest.LogCaptureFixture, change: Callable[[dict[str, Any]], Any], told: str
) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(edited(lambda g: change(g) and None)(glb.encoded(made(4))))
    assert len(glb.read(path)) == 4
    (record,) = caplog.records
    assert record.getMessage().startswith(f"{path}: not used: ") and told in record.getMessage()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda g: g["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}}),
            "node 0 places its mesh by EXT_mesh_gpu_instancing",
        ),
        (
            lambda g: (primitive(g).update(attributes={}), extended(g).update(extensions={"SPZ_packed": {}})),
            "packed by the extension SPZ_packed",
        ),
    ],
)
def test_what_would_change_the_picture_is_refused(
    made, tmp_path: Path, change: Callable[[dict[str, Any]], Any], message: str
) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(edited(lambda g: change(g) and None)(glb.encoded(made(4))))
    with pytest.raises(SplatFileError, match=message):
        glb.read(path)


def test_that_antialiased_splats_lose_that_is_told(made) -> None:
    assert glb.told(made(2)) is None
    said = glb.told(replace(made(2), antialiased=True))
    assert said is not None and "which .glb has no place for" in said
