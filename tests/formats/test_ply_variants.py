"""Binary .ply files that other trainings write in the layout of 3DGS: flat splats, and harmonics of degree 4."""

from pathlib import Path

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.evaluation.camera_path import surround
from compgs.formats import SplatArrays, encoded, read_ply
from compgs.opening import component_bytes, open_scene
from compgs.render import render


def rows_of(arrays: SplatArrays) -> dict[str, np.ndarray]:
    """Columns by name, in the order of the file that `encoded` writes."""
    header, _, body = encoded(arrays, "ply").partition(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property")]
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))


def write(path: Path, columns: dict[str, np.ndarray]) -> None:
    count = len(next(iter(columns.values())))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in columns]
    body = np.column_stack(list(columns.values())).astype("<f4").tobytes()
    path.write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode() + body)


def test_splats_of_two_scales_are_flat_across_their_third_axis(made, tmp_path: Path) -> None:
    arrays, path = made(30, 1), tmp_path / "2dgs.ply"
    columns = rows_of(arrays)
    write(path, {name: column for name, column in columns.items() if name != "scale_2"})
    read = read_ply(path)
    assert np.array_equal(read.log_scales[:, :2], arrays.log_scales[:, :2])
    assert (np.exp(read.log_scales[:, 2]) < 1e-30).all()
    for name in ("means", "quaternions", "opacity_logits", "dc", "rest"):
        assert np.array_equal(getattr(read, name), getattr(arrays, name)), name
    assert sum(component_bytes(path).values()) == path.stat().st_size


def test_flat_splats_are_drawn_as_very_thin_ones(made, tmp_path: Path) -> None:
    columns = rows_of(made(30, 1))
    flat, thin = tmp_path / "flat.ply", tmp_path / "thin.ply"
    write(flat, {name: column for name, column in columns.items() if name != "scale_2"})
    write(thin, columns | {"scale_2": np.full(30, np.log(1e-6))})
    for _, camera in surround(read_ply(thin).means)[::40]:
        pictures = [render(open_scene(path), camera).image for path in (flat, thin)]
        assert np.isfinite(pictures[0]).all() and pictures[0].max() > 0.05
        np.testing.assert_allclose(*pictures, atol=1e-3)


@pytest.mark.parametrize("missing", ["scale_0", "scale_1"])
def test_another_scale_may_not_be_missing(made, tmp_path: Path, missing: str) -> None:
    path = tmp_path / "a.ply"
    write(path, {name: column for name, column in rows_of(made(3)).items() if name != missing})
    with pytest.raises(SplatFileError, match=f"'{missing}' is missing"):
        read_ply(path)


def test_of_harmonics_of_degree_4_those_up_to_3_are_kept(made, tmp_path: Path) -> None:
    """24 coefficients a channel, the last nine of degree 4."""
    arrays, path = made(12, 3), tmp_path / "degree4.ply"
    columns = {name: column for name, column in rows_of(arrays).items() if not name.startswith("f_rest")}
    fourth = np.random.default_rng(0).normal(size=(12, 9, 3)).astype(np.float32)
    held = np.concatenate([arrays.rest, fourth], 1).transpose(0, 2, 1).reshape(12, 72)
    write(path, columns | {f"f_rest_{i}": held[:, i] for i in range(72)})
    read = read_ply(path)
    assert read.degree == 3
    assert np.array_equal(read.rest, arrays.rest)
    assert component_bytes(path)["harmonics"] == 12 * 72 * 4
    assert sum(component_bytes(path).values()) == path.stat().st_size
