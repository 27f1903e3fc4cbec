import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import OutputError, SplatFileError
from compgs.formats import read_ply, write_ply
from compgs.formats.ply import ply_size, read_ply_header
from compgs.model.splats import SplatArrays, sigmoid

REAL = Path(__file__).parents[3] / "shared" / "splats"


def made(count: int = 5, degree: int = 3) -> SplatArrays:
    draw = np.random.default_rng(degree).normal
    shapes = (count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, (degree + 1) ** 2 - 1, 3)
    return SplatArrays(*(draw(size=shape).astype(np.float32) for shape in shapes))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    write_ply(made(), path)
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_again_bit_by_bit(tmp_path: Path, degree: int) -> None:
    splats = made(7, degree)
    written = write_ply(splats, tmp_path / "scene.ply")
    again = read_ply(tmp_path / "scene.ply")
    assert again.degree == degree
    for name, tensor in vars(splats).items():
        assert np.array_equal(getattr(again, name), tensor), name
    assert written == (tmp_path / "scene.ply").stat().st_size == ply_size(7, degree)


def test_the_layout_is_that_of_3dgs(file: Path) -> None:
    """Read by hand, from the description of the layout alone."""
    splats, data = made(), file.read_bytes()
    header, body = data.split(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float")]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(45)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == expected
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 5\n")
    second = dict(zip(names, struct.unpack_from("<62f", body, 4 * 62), strict=True))
    assert second["y"] == splats.means[1, 1] and second["nx"] == 0
    assert second["f_dc_2"] == splats.dc[1, 2]
    assert second["f_rest_0"] == splats.rest[1, 0, 0]  # red, first harmonic
    assert second["f_rest_14"] == splats.rest[1, 14, 0]  # red, last harmonic
    assert second["f_rest_17"] == splats.rest[1, 2, 1]  # green, third harmonic
    assert second["f_rest_30"] == splats.rest[1, 0, 2]  # blue, first harmonic
    assert second["rot_0"] == splats.quaternions[1, 0] and second["opacity"] == splats.opacity_logits[1]


def test_an_existing_file_is_kept_unless_asked(file: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(OutputError, match="overwrite"):
        write_ply(made(2), file)
    assert file.read_bytes() == before
    write_ply(made(2), file, overwrite=True)
    assert len(read_ply(file)) == 2
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_properties_may_come_in_any_order_and_precision_and_with_others(tmp_path: Path) -> None:
    splats = made(3, 0)
    names = ["rot_3", "rot_0", "rot_1", "rot_2", "opacity", "f_dc_2", "f_dc_0", "f_dc_1", "x", "y", "z"]
    names += ["scale_2", "scale_1", "scale_0"]
    table = np.zeros(3, [("label", "u1"), *((name, "<f8") for name in names), ("time", "<i4")])
    for stem, values in {"rot": splats.quaternions, "f_dc": splats.dc, "scale": splats.log_scales}.items():
        for i in range(values.shape[1]):
            table[f"{stem}_{i}"] = values[:, i]
    table["x"], table["y"], table["z"] = splats.means.T
    table["opacity"] = splats.opacity_logits
    header = "ply\r\nformat binary_little_endian 1.0\r\ncomment made elsewhere\r\nelement vertex 3\r\n"
    header += "property uchar label\r\n" + "".join(f"property double {name}\r\n" for name in names)
    header += "property int time\r\nelement camera 1\r\nproperty list uchar int ids\r\nend_header\r\n"
    path = tmp_path / "other.ply"
    path.write_bytes(header.encode() + table.tobytes() + b"\x01\x00\x00\x00\x00")
    again = read_ply(path)
    for name, tensor in vars(splats).items():
        assert np.array_equal(getattr(again, name), tensor), name


def edited(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data.replace(old, new, 1)


def with_number(column: int, value: float) -> Callable[[bytes], bytes]:
    """In the third row."""

    def change(data: bytes) -> bytes:
        start = data.index(b"end_header\n") + 11 + 4 * (2 * 62 + column)
        return data[:start] + struct.pack("<f", value) + data[start + 4 :]

    return change


def without_rotation(data: bytes) -> bytes:
    start = data.index(b"end_header\n") + 11 + 4 * (62 + 58)
    return data[:start] + bytes(16) + data[start + 16 :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"", "does not begin"),
        (lambda data: b"PK" + data, "does not begin"),
        (lambda data: data[:300], "ends after 300 bytes, within its header; copy it again"),
        (edited(b"end_header", b"comment " + b"x" * 70_000), "header does not end within 65536 bytes"),
        (lambda data: data[:-1], "copy it again"),
        (lambda data: data + b"x", "copy it again"),
        (edited(b"vertex 5", b"vertex 6"), "copy it again"),
        (edited(b"vertex 5", b"vertex 999999999999"), "copy it again"),
        (edited(b"vertex 5", b"vertex 9999999999999"), "element vertex COUNT"),
        (edited(b"vertex 5", b"vertex -5"), "element vertex COUNT"),
        (edited(b"vertex 5", b"vertex"), "element vertex COUNT"),
        (edited(b"element vertex 5", b"element chunk 5"), "no vertices"),
        (edited(b"element vertex 5\n", b""), "no vertices"),
        (edited(b"binary_little", b"binary_middle"), "binary_little_endian"),
        (edited(b"property float f_rest_44\n", b""), "44 properties f_rest"),
        (edited(b"f_rest_44", b"f_rest_45"), "'f_rest_44' is missing"),
        (edited(b"float opacity", b"float transparency"), "'opacity' is missing"),
        (edited(b"float opacity", b"int opacity"), "'opacity' is of type int32"),
        (edited(b"float opacity", b"float x"), "'x' is there twice"),
        (edited(b"float opacity", b"list uchar int opacity"), "not a property"),
        (edited(b"float opacity", b"half opacity"), "not a property"),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(
    file: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(SplatFileError, match=message) as caught:
        read_ply(file)
    assert str(caught.value).startswith(f"{file}: ")


@pytest.mark.parametrize(
    ("damage", "left"),
    [
        (with_number(1, float("nan")), [0, 1, 3, 4]),
        (with_number(20, float("-inf")), [0, 1, 3, 4]),
        (with_number(55, 1000.0), [0, 1, 3, 4]),
        (without_rotation, [0, 2, 3, 4]),
    ],
)
def test_a_splat_that_cannot_be_drawn_is_left_out_and_counted(
    file: Path, damage: Callable[[bytes], bytes], left: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    file.write_bytes(damage(file.read_bytes()))
    np.testing.assert_array_equal(read_ply(file).means, made().means[left])
    (record,) = caplog.records
    assert record.getMessage().startswith(f"{file}: 1 of 5 splats were left out: 1 without a ")


def test_infinite_opacities_are_opaque_or_invisible(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    for value, opacity in ((float("inf"), 1), (float("-inf"), 0)):
        file.write_bytes(with_number(54, value)(file.read_bytes()))
        assert read_ply(file).opacities[2] == pytest.approx(opacity, abs=1e-6)
    assert not caplog.records


def with_comments(*comments: bytes) -> Callable[[bytes], bytes]:
    text = b"".join(b"comment " + comment + b"\n" for comment in comments)
    return edited(b"element vertex", text + b"element vertex")


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        ([], False),
        ([b"SplatRenderMode: mip"], True),
        ([b"splatrendermode: MIP"], True),
        ([b"SplatRenderMode: default"], False),
        ([b"antialiased 1"], True),
        ([b"antialiased 0"], False),
        ([b"SplatRenderMode: mip", b"antialiased 0"], False),
        ([b"antialiased 0", b"SplatRenderMode: mip"], True),
        ([b"antialiased", b"is antialiased 1", b"SplatRenderMode:"], False),
    ],
)
def test_comments_say_whether_splats_are_antialiased(
    file: Path, comments: list[bytes], antialiased: bool
) -> None:
    file.write_bytes(with_comments(*comments)(file.read_bytes()))
    assert read_ply(file).antialiased is antialiased


def test_antialiased_splats_are_written_as_such(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(replace(made(), antialiased=True), path)
    assert b"\ncomment SplatRenderMode: mip\n" in path.read_bytes()
    assert read_ply(path).antialiased
    write_ply(made(), path, overwrite=True)
    assert b"comment" not in path.read_bytes()


def other_layout(
    path: Path, splats: SplatArrays, extra: dict[str, np.ndarray], left_out: tuple[str, ...] = ()
) -> None:
    """A file in which some properties are missing and others are there."""
    columns = {"x": splats.means[:, 0], "y": splats.means[:, 1], "z": splats.means[:, 2]}
    columns |= {f"f_dc_{i}": splats.dc[:, i] for i in range(3)} | {"opacity": splats.opacity_logits}
    columns |= {f"scale_{i}": splats.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": splats.quaternions[:, i] for i in range(4)} | extra
    columns = {name: column for name, column in columns.items() if name not in left_out}
    kinds = {"u1": "uchar", "u2": "ushort", "f4": "float"}
    table = np.zeros(len(splats), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    properties = (f"property {kinds[c.dtype.str[1:]]} {name}\n" for name, c in columns.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(splats)}\n{''.join(properties)}end_header\n"
    path.write_bytes(header.encode() + table.tobytes())


COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")
RGB = ("red", "green", "blue")


@pytest.mark.parametrize(
    ("kind", "whole"), [(np.uint8, 255), (np.uint16, 65535), (np.float32, 1), (np.float32, 255)]
)
def test_display_colors_stand_for_harmonics_of_degree_0(tmp_path: Path, kind: type, whole: int) -> None:
    splats, path = made(3, 0), tmp_path / "a.ply"
    shares = np.array([[0.2, 0.4, 1], [0, 0.6, 0.8], [1, 0, 0.2]])
    rgb = {name: (shares[:, i] * whole).round(6).astype(kind) for i, name in enumerate(RGB)}
    other_layout(path, splats, rgb, COLORS)
    found = read_ply(path)
    np.testing.assert_allclose(0.5 + 0.28209479 * found.dc, shares, atol=1 / 65535 + 1e-6)
    np.testing.assert_array_equal(found.means, splats.means)


@pytest.mark.parametrize(
    ("left_out", "message"),
    [
        (
            COLORS,
            "its splats have no colors: expected properties f_dc_0, f_dc_1, f_dc_2, or red, green, blue",
        ),
        (("f_dc_1",), "'f_dc_1' is missing; export the scene again"),
        (("rot_2",), "'rot_2' is missing; export the scene again"),
        (("scale_0", "scale_1", "scale_2"), "'scale_0' is missing; export the scene again"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, left_out: tuple[str, ...], message: str) -> None:
    path = tmp_path / "a.ply"
    other_layout(path, made(3, 0), {}, left_out)
    with pytest.raises(SplatFileError, match=message):
        read_ply(path)


def test_the_smoothing_filter_of_mip_splatting_widens_and_dilutes(tmp_path: Path) -> None:
    """Against the volume of the Gaussian, which a convolution keeps: opacity times the product of the extents."""
    splats, path = made(6, 0), tmp_path / "a.ply"
    widths = np.float32([0.5, 0, 0.01, 3, 1e-3, 0.2])
    splats = replace(splats, opacity_logits=np.float32([2, np.inf, -1, 0, 3, 30]))
    other_layout(path, splats, {"filter_3D": widths})
    found = read_ply(path)
    scales, before = np.exp(found.log_scales.astype(float)), np.exp(splats.log_scales.astype(float))
    np.testing.assert_allclose(scales**2, before**2 + widths[:, None] ** 2, rtol=1e-5)
    volumes = found.opacities * scales.prod(1), splats.opacities * before.prod(1)
    np.testing.assert_allclose(*volumes, rtol=1e-4)
    assert found.antialiased


def test_properties_and_elements_that_are_not_used_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, count = tmp_path / "a.ply", np.zeros(3, np.uint8)
    other_layout(path, made(3, 0), {"time": count, "label": count, "red": count, "nx": count})
    content = path.read_bytes().replace(b"end_header", b"element camera 1\nproperty float f\nend_header")
    path.write_bytes(content + bytes(4))
    assert len(read_ply(path)) == 3
    (record,) = caplog.records
    assert record.getMessage() == f"{path}: not used: properties time, label; elements camera"


def test_elements_before_the_vertices_are_passed_over(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    header, rows = file.read_bytes().split(b"end_header\n", 1)
    camera = b"element camera 2\nproperty float f\nproperty uchar kind\nelement vertex"
    file.write_bytes(header.replace(b"element vertex", camera) + b"end_header\n" + bytes(10) + rows)
    np.testing.assert_array_equal(read_ply(file).means, made().means)
    assert "not used: elements camera" in caplog.text
    file.write_bytes(file.read_bytes() + b"x")
    with pytest.raises(SplatFileError, match="copy it again"):
        read_ply(file)
    listed = header.replace(b"element vertex", b"element faces 1\nproperty list uchar int v\nelement vertex")
    file.write_bytes(listed + b"end_header\n" + bytes(1) + rows)
    with pytest.raises(
        SplatFileError, match="'property list uchar int v' is not a property that a splat has"
    ):
        read_ply(file)


def test_big_endian_numbers_are_read(file: Path) -> None:
    header, rows = file.read_bytes().split(b"end_header\n", 1)
    swapped = np.frombuffer(rows, "<f4").astype(">f4").tobytes()
    file.write_bytes(header.replace(b"little", b"big") + b"end_header\n" + swapped)
    for name, column in made().columns.items():
        np.testing.assert_array_equal(read_ply(file).columns[name], column)


def test_a_mode_of_drawing_that_is_not_known_is_told(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    file.write_bytes(with_comments(b"SplatRenderMode: 2dgs")(file.read_bytes()))
    assert not read_ply(file).antialiased
    assert "not used: SplatRenderMode 2dgs (drawn as plain splats)" in caplog.text


def test_points_are_not_taken_for_splats(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    path.write_bytes(header + b"property float z\nend_header\n" + bytes(12))
    with pytest.raises(SplatFileError, match="points, not splats"):
        read_ply(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SplatFileError, match=r"none\.ply: cannot be read"):
        read_ply(tmp_path / "none.ply")


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real splats in {REAL}")
def test_real_splats_of_another_program_are_read() -> None:
    path = REAL / "playbot_lod3.ply"
    header, splats = read_ply_header(path), read_ply(path)
    assert len(splats) == header.count == 31_000
    assert splats.degree == 2
    assert 0.3 < sigmoid(splats.opacity_logits).mean() <= 1
    assert np.median(np.exp(splats.log_scales)) < np.ptp(splats.means, axis=0).max()


def test_positions_in_the_file_are_world_coordinates(tmp_path: Path) -> None:
    splats, offset = made(7), (4.2e6, -5.1e5, 3000.25)
    write_ply(replace(splats, world_offset=offset), tmp_path / "scene.ply")
    again = read_ply(tmp_path / "scene.ply")
    assert np.array_equal(again.means, (splats.means + np.array(offset)).astype(np.float32))
    for name in ("log_scales", "quaternions", "opacity_logits", "dc", "rest"):
        assert np.array_equal(getattr(again, name), getattr(splats, name)), name
