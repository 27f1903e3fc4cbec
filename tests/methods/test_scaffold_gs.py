"""Scaffold-GS: anchors with view-dependent networks, uncompressed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compgs.formats.packed import read
from compgs.methods import settings_of, train, write
from compgs.opening import component_bytes, open_scene
from compgs.render import Renderable, render
from compgs.scene.views import Scene

GROWTH: dict[str, Any] = {
    "start": 0.2,
    "stop": 0.9,
    "every": 0.2,
    "gradient_threshold": 1e-6,
    "minimum_views": 1,
}
GROWTH["variant"] = "default"  # the blobs leave no coarse cell empty


def quick(steps: int = 40, **control: Any) -> Any:
    config: Any = settings_of("scaffold-gs")
    return replace(
        config,
        # Offsets begin at zero, and must leave their anchor's voxel before anything can grow.
        anchors=replace(config.anchors, offset_lr=(0.1, 0.1)),
        control=replace(config.control, **{**GROWTH, **control}),
        training=replace(config.training, steps=steps, seed=3),
    )


@pytest.fixture(scope="module")
def trained(blob_scene: Scene) -> Any:
    return train(blob_scene, quick(), method="scaffold-gs", device="cpu")


@pytest.fixture(scope="module")
def file(trained: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scaffold") / "a.packed"
    assert write(trained, path, method="scaffold-gs") == path.stat().st_size
    return path


def test_an_anchor_takes_316_bytes_beside_the_networks(trained: Any, file: Path) -> None:
    parts = component_bytes(file)
    assert parts["anchors"] == 316 * trained.anchors
    networks = 3 * (36 * 32 + 32) + 33 * (10 + 30 + 70)
    assert sum(parts.values()) - parts["anchors"] - parts["header"] == 4 * networks


def test_columns_are_in_the_published_order(trained: Any, file: Path) -> None:
    rows, n = read(file).arrays["anchors"], 7
    with torch.no_grad():
        np.testing.assert_array_equal(rows[n, :3], trained.positions()[n])
        assert not rows[:, 3:6].any()
        offsets = trained.offsets.view(-1, 10, 3)[n]
        for axis in range(3):
            np.testing.assert_array_equal(rows[n, 6 + 10 * axis : 16 + 10 * axis], offsets[:, axis])
        np.testing.assert_array_equal(rows[n, 36:68], trained.features[n])
        scales = trained.log_scales[n].exp() * trained.voxel_size
        np.testing.assert_allclose(np.exp(rows[n, 69:75]), scales, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-rows[:, 68])), 0.1, rtol=1e-6)
    assert rows[:, 75:].tolist() == [[1, 0, 0, 0]] * len(rows)


def test_what_is_opened_renders_what_was_trained(trained: Any, file: Path, blob_scene: Scene) -> None:
    again = open_scene(file, background=blob_scene.background)
    assert isinstance(again, Renderable)
    assert again.counts == {"anchors": trained.anchors, "coupled_primitives": 10 * trained.anchors}
    camera = blob_scene.test_views[0].camera
    image = render(trained, camera).image
    assert image.std() > 0.01, "nothing is drawn: the test is too weak"
    np.testing.assert_allclose(render(again, camera).image, image, atol=1e-4)


def test_a_run_that_was_stopped_continues_exactly(check_continues: Any) -> None:
    check_continues("scaffold-gs", quick(), (10, 30))


def test_anchors_grow_where_the_gradient_is_large(blob_scene: Scene, trained: Any) -> None:
    few = train(blob_scene, quick(gradient_threshold=1e-2), method="scaffold-gs", device="cpu")
    assert few.anchors < trained.anchors


def test_settings_are_those_of_the_release() -> None:
    config = settings_of("scaffold-gs")
    c, m = config.control, config.model
    assert (m.coupled_primitives, m.reference_dim, m.width) == (10, 32, 32)
    assert (c.start * 30_000, c.stop * 30_000, round(c.every * 30_000)) == (1_500, 15_000, 100)
    assert (c.gradient_threshold, c.opacity_threshold) == (2e-4, 0.005)
    assert config.training.scale_weight == 0.01
    assert settings_of("scaffold-gs", "paper") == config
    quick = settings_of("scaffold-gs", "quick").training
    assert replace(quick, steps=30_000) == config.training and quick.steps == 4_000
    scaled = settings_of("scaffold-gs", "scaled")
    assert (scaled.model, scaled.control) == (m, c) and scaled.training != config.training


def test_what_holds_no_lasting_splats_is_neither_exported_nor_compressed(
    file: Path, check_not_converted: Callable[[Path], None]
) -> None:
    check_not_converted(file)


@pytest.mark.parametrize(
    ("facts", "arrays", "message"),
    [
        ({"offsets": 0}, {}, "offsets: expected 1 to 64, found 0"),
        ({"offsets": 9}, {}, r"opacity_weight1: expected float32 of shape \(39, 32\)"),
        ({"offsets": 64}, {}, "anchors: expected 241 columns of 64 offsets and 32 features"),
        ({"width": 31}, {}, r"opacity_weight1: expected float32 of shape \(36, 31\)"),
        ({"distance_unit": 0}, {}, "distance_unit: expected above 0"),
        ({"offset": None}, {}, "offset: expected three numbers"),
        ({}, {"anchors": np.zeros((0, 79), np.float32)}, "found 0 rows of 79"),
        ({}, {"anchors": np.full((1, 79), np.inf, np.float32)}, "anchors: hold what is not a finite number"),
        ({}, {"anchors": np.full((1, 79), 89.0, np.float32)}, "a log scale of 89, expected up to 88"),
        ({}, {"color_bias2": np.full(30, np.nan, np.float32)}, "color_bias2: hold what is not"),
        ({}, {"color_bias2": np.zeros(29, np.float32)}, r"color_bias2: expected float32 of shape \(30\)"),
    ],
)
def test_damaged_files_are_refused(
    facts: dict[str, Any],
    arrays: dict[str, np.ndarray],
    message: str,
    file: Path,
    check_refused: Callable[..., None],
) -> None:
    check_refused(file, facts, arrays, message)
