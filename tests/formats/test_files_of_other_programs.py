"""Files as other programs write them, which this one read wrongly or refused once: what is in each by hand.

They lie outside of the repository; where they are missing the tests beside this one make such files themselves.
"""

import gzip
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.exporting import export
from compgs.formats import read_ply
from compgs.formats.arrays import Y0, SplatArrays
from compgs.model.splats import SplatModel
from compgs.opening import open_scene

CASES = Path(__file__).parents[3] / "shared" / "cases"


def case(name: str) -> Path:
    found = sorted((CASES / name).glob("scene.*"))
    if not found:
        pytest.skip(f"no {CASES / name}")
    return found[0]


def read(name: str) -> SplatArrays:
    model = open_scene(case(name))
    assert isinstance(model, SplatModel)
    return model.splats


def table(file: Path) -> np.ndarray:
    """The vertices of a .ply of float and uchar, by its header alone."""
    content = file.read_bytes()
    end = content.index(b"end_header\n") + len(b"end_header\n")
    lines = [line.split() for line in content[:end].decode().splitlines()]
    count = next(int(words[2]) for words in lines if words[:2] == ["element", "vertex"])
    start = next(i for i, words in enumerate(lines) if words[:2] == ["element", "vertex"])
    kinds = {"float": "<f4", "uchar": "u1"}
    columns = []
    for words in lines[start + 1 :]:
        if words[0] != "property":
            break
        columns.append((words[2], kinds[words[1]]))
    return np.frombuffer(content, np.dtype(columns), count, end)


def test_brush_says_that_splats_are_antialiased(tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    assert export(case("ply_brush_render_mode_mip"), out).splats == 24
    assert b"\ncomment SplatRenderMode: mip\n" in out.read_bytes()
    assert open_scene(out).antialiased


def test_spz_keeps_its_flag(tmp_path: Path) -> None:
    out = tmp_path / "out.spz"
    export(case("spz_antialiased_flag"), out)
    assert gzip.decompress(out.read_bytes())[14] == 1
    assert read("spz_antialiased_flag").antialiased


def test_the_filter_of_mip_splatting_is_folded_in() -> None:
    rows, found = table(case("ply_mip_filter_3d")), read("ply_mip_filter_3d")
    scales = np.exp(np.column_stack([rows[f"scale_{i}"] for i in range(3)]).astype(float))
    wider = np.sqrt(scales**2 + rows["filter_3D"][:, None].astype(float) ** 2)
    opacities = 1 / (1 + np.exp(-rows["opacity"].astype(float))) * (scales / wider).prod(1)
    np.testing.assert_allclose(np.exp(found.log_scales), wider, rtol=1e-5)
    np.testing.assert_allclose(found.opacities, opacities, atol=2e-6)
    assert found.antialiased


def test_the_axes_of_an_spz_are_those_it_declares() -> None:
    pytest.importorskip("zstandard")
    np.testing.assert_allclose(
        read("spz_v4_coordinate_system_rdf").means[0], [2.0410, 2.5566, -0.4180], atol=1e-4
    )


def test_both_places_of_a_mesh_are_read() -> None:
    assert len(read("glb_two_nodes_one_mesh")) == 48


def test_infinite_logits_are_opaque_and_invisible() -> None:
    rows, found = table(case("ply_opacity_infinite")), read("ply_opacity_infinite")
    with np.errstate(over="ignore"):
        expected = 1 / (1 + np.exp(-rows["opacity"].astype(float)))
    assert len(found) == 24 and np.isinf(rows["opacity"]).any()
    np.testing.assert_allclose(found.opacities, expected, atol=2e-6)


def test_a_file_of_zeros_says_how_many_and_why() -> None:
    rows = table(case("ply_zero_filled_rows"))
    zero = sum(not any(row[name] for name in ("rot_0", "rot_1", "rot_2", "rot_3")) for row in rows)
    with pytest.raises(
        SplatFileError, match=f"{zero} of 24 splats cannot be drawn: {zero} without a rotation"
    ):
        read("ply_zero_filled_rows")


def test_an_odd_rotation_is_normalized() -> None:
    found = read("splat_one_odd_rotation")
    assert len(found) == 24
    assert abs(np.linalg.norm(found.quaternions[3]) - 1) > 0.1  # normalized where it is drawn and written


def test_display_colors_are_read() -> None:
    rows, found = table(case("ply_rgb_colors")), read("ply_rgb_colors")
    shown = np.column_stack([rows[name] for name in ("red", "green", "blue")]) / 255
    np.testing.assert_allclose(0.5 + Y0 * found.dc, shown, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("spz_bytes_after_gzip", "16 bytes after the end of the compressed data"),
        ("ply_elements_after_vertices_passes", "elements extrinsic, intrinsic, version"),
    ],
)
def test_what_is_not_used_is_told(name: str, told: str, caplog: pytest.LogCaptureFixture) -> None:
    assert len(read(name)) == 24
    assert f"not used: {told}" in caplog.text


def test_one_far_splat_is_left_out_of_an_spz(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = case("export_spz_one_floater")
    done = export(file, tmp_path / "out.spz")
    assert done.splats == 23 and done.mean > 45
    assert "without 1 of 24 splats: up to 100000 world units from the origin" in caplog.text
    assert len(read_ply(file)) == export(file, tmp_path / "out.ply").splats == 24
