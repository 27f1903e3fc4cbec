"""Similarity of splats to their neighbours, against cases that can be worked out by hand."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import similarity
from similarity_measures import (
    NEIGHBOURS,
    attributes,
    cosine_similarities,
    measure,
    nearest,
    normalized,
    random_others,
    stretch,
    variance_left,
)

from compgs.formats import write_ply
from compgs.model.splats import SplatArrays


def splats(count: int, degree: int = 1, seed: int = 0) -> SplatArrays:
    """Independent of one another in everything."""
    chance = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return chance.normal(size=(count, *shape)).astype(np.float32)

    rest = (degree + 1) ** 2 - 1
    return SplatArrays(normal(3), normal(3) - 4, normal(4), normal(), normal(3), normal(rest, 3))


def test_neighbours_are_the_nearest_others_even_where_splats_coincide() -> None:
    line = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0]], np.float32)
    assert nearest(line, 2).tolist() == [[1, 2], [0, 2], [1, 0], [2, 1]]
    same = np.zeros((6, 3), np.float32)
    found = nearest(same, 2)
    assert found.shape == (6, 2)
    assert not (found == np.arange(6)[:, None]).any()
    with pytest.raises(SystemExit, match="more than 4 splats, found 4"):
        nearest(line, 4)


def test_random_partners_are_all_others_equally_often_and_never_oneself() -> None:
    drawn = random_others(4, 6000)
    for splat in range(4):
        counts = np.bincount(drawn[splat], minlength=4)
        assert counts[splat] == 0
        assert counts.sum() == 6000
        others = np.delete(counts, splat)
        assert abs(others - 2000).max() < 200  # 5.5 standard deviations


def test_the_cosine_is_that_of_the_angle_and_zero_without_length() -> None:
    x = np.array([[2, 0], [0, 3], [5, 5], [-1, 0], [0, 0]], np.float32)
    partners = np.array([[1, 2], [1, 1], [0, 1], [0, 0], [0, 1]])
    expected = [math.sqrt(0.5) / 2, 1, math.sqrt(0.5), -1, 0]
    assert cosine_similarities(x, partners) == pytest.approx(expected)


def test_variance_left_is_what_the_partners_mean_misses() -> None:
    x = np.array([[2.0], [-2.0], [1.0], [-1.0]], np.float32)
    # Predicted 0, 1.5, 0, 0: residuals 2, -3.5, 1, -1 against 2, -2, 1, -1.
    partners = np.array([[1, 0], [0, 2], [0, 1], [2, 3]])
    assert variance_left(x, partners) == pytest.approx((4 + 12.25 + 1 + 1) / (4 + 4 + 1 + 1))
    assert variance_left(np.zeros((4, 2), np.float32), partners) is None


def test_partners_that_say_nothing_leave_one_and_a_kth() -> None:
    x = np.random.default_rng(0).standard_normal((20_000, 3)).astype(np.float32)
    assert variance_left(x, random_others(20_000, 5)) == pytest.approx(1.2, abs=0.02)


def test_attributes_weigh_the_same_after_normalization() -> None:
    values = np.random.default_rng(0).uniform(5, 9, (1000, 4)).astype(np.float32)
    x = normalized(values)
    assert x.mean(0) == pytest.approx(np.zeros(4), abs=1e-6)
    assert (x**2).sum(1).mean() == pytest.approx(1)
    assert not normalized(np.full((5, 2), 3, np.float32)).any()


def test_orientation_does_not_depend_on_how_a_splat_is_written() -> None:
    half = math.sqrt(0.5)
    log_scales = torch.tensor([[1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 1.0, -1.0], [3.0, 2.0, 1.0]])
    # The same ellipsoid four times: as it is, negated, its first two axes exchanged by a quarter turn, and larger.
    quaternions = torch.tensor([[1.0, 0, 0, 0], [-2.0, 0, 0, 0], [half, 0, 0, half], [1.0, 0, 0, 0]])
    assert torch.allclose(stretch(log_scales, quaternions), stretch(log_scales, quaternions)[:1], atol=1e-5)


def test_orientations_compare_as_the_logarithms_of_covariances_do() -> None:
    made = splats(2)
    logarithms = []
    for log_scales, (w, x, y, z) in zip(
        made.log_scales.astype(np.float64),
        made.quaternions / np.linalg.norm(made.quaternions.astype(np.float64), axis=1, keepdims=True),
        strict=True,
    ):
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        values, vectors = np.linalg.eigh(rotation @ np.diag(np.exp(2 * log_scales)) @ rotation.T)
        logarithm = vectors @ np.diag(np.log(values)) @ vectors.T
        logarithms.append(logarithm - np.eye(3) * np.trace(logarithm) / 3)
    expected = np.sum(logarithms[0] * logarithms[1])
    a, b = stretch(torch.from_numpy(made.log_scales), torch.from_numpy(made.quaternions))
    assert float(a @ b) == pytest.approx(expected, rel=1e-3)


def test_the_order_of_a_splats_axes_does_not_change_its_scales() -> None:
    made = splats(30)
    turned = replace(made, log_scales=made.log_scales[:, ::-1].copy())
    assert np.array_equal(attributes(made)["scales"], attributes(turned)["scales"])
    assert "harmonics" not in attributes(splats(30, degree=0))


def test_independent_splats_are_like_their_neighbours_as_like_any() -> None:
    measured = measure(splats(3000))
    together = next(row for row in measured.rows if row.attribute == "all together")
    assert together.neighbours == pytest.approx(0, abs=0.01)
    assert together.left == pytest.approx(1 + 1 / NEIGHBOURS, abs=0.02)
    assert measured.beyond_random == pytest.approx(0.01, abs=0.01)


def test_splats_that_vary_slowly_in_space_are_like_their_neighbours() -> None:
    made = splats(3000, degree=0)
    color = np.sin(made.means)  # position decides
    measured = measure(replace(made, dc=color))
    rows = {row.attribute: row for row in measured.rows}
    assert rows["color"].neighbours > 0.8
    assert rows["color"].left < 0.2
    assert rows["color"].random == pytest.approx(0, abs=0.01)
    assert rows["scales"].left == pytest.approx(1 + 1 / NEIGHBOURS, abs=0.02)
    assert rows["opacity"].neighbours is None
    assert measured.beyond_random > 0.05


def test_table_and_figure_of_a_file_are_written(tmp_path: Path) -> None:
    write_ply(splats(50), tmp_path / "made.ply")
    similarity.main([str(tmp_path / "made.ply"), "-o", str(tmp_path), "--note", "Made up."])
    text = (tmp_path / "similarity_made.md").read_text()
    assert "50 splats, commit " in text
    assert ". Made up.\n" in text
    assert "| opacity | 1 | none | none |" in text
    content = json.loads((tmp_path / "similarity_made.json").read_text())
    assert [row["attribute"] for row in content["rows"]][-2:] == ["all together", "all, as stored"]
    assert (tmp_path / "similarity_made.png").read_bytes().startswith(b"\x89PNG")


def test_a_scene_is_trained_by_plain_3dgs_and_its_file_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = []

    def run(arguments: list[str]) -> None:
        commands.append(arguments)
        folder = Path(arguments[arguments.index("-o") + 1])
        write_ply(splats(50), folder / "trained.ply")
        (folder / "results.json").write_text(json.dumps({"file": "trained.ply"}))

    monkeypatch.setattr(similarity, "run_compgs", run)
    (tmp_path / "scene").mkdir()
    runs = ["--runs", str(tmp_path / "runs"), "--steps", "60", "-r", "8"]
    similarity.main([str(tmp_path / "scene"), "-o", str(tmp_path), *runs])
    (command,) = commands
    assert command[command.index("--method") + 1] == "3dgs"
    assert (command[command.index("--steps") + 1], command[command.index("-r") + 1]) == ("60", "8")
    assert "50 splats" in (tmp_path / "similarity_scene.md").read_text()
