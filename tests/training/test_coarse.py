"""Coarse photographs at the beginning of a run, and whole ones at its end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.config import Config
from compgs.losses import Target, photometric_loss
from compgs.scene.views import Scene
from compgs.training.shortcuts import coarse
from compgs.training.shortcuts.coarse import CoarseViews, halvings, smaller
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def small_photographs_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' have 48 x 36 pixels: they are halved twice."""
    monkeypatch.setattr(coarse, "COARSEST_PIXELS", 48 * 36 // 16)


@pytest.mark.parametrize(
    ("width", "height", "found"),
    [
        (240, 179, [0, 0, 0, 0]),
        (480, 359, [1, 1, 1, 0]),
        (960, 717, [2, 2, 1, 0]),
        (1920, 1434, [3, 2, 1, 0]),
        (7680, 5736, [5, 3, 2, 0]),
        (1, 1, [0, 0, 0, 0]),
    ],
)
def test_photographs_are_halved_in_equal_parts_of_the_run_as_long_as_forty_thousand_pixels_are_left(
    monkeypatch: pytest.MonkeyPatch, width: int, height: int, found: list[int]
) -> None:
    monkeypatch.undo()
    assert [halvings(at, 0.7, width, height) for at in (0.0, 0.3, 0.5, 0.7)] == found
    assert [halvings(at, 0.0, width, height) for at in (0.0, 1.0)] == [0, 0]
    finest = halvings(0.0, 0.7, width, height)
    assert width * height / 4**finest >= 40_000 or finest == 0


def test_a_smaller_photograph_is_means_of_the_large_one() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[:2, :2], image[2, 4] = 200, 100
    mask = np.zeros((4, 6), bool)
    mask[:2, :2] = mask[2, 2:4] = mask[3, 5] = True
    small = smaller(Target.from_image(image, mask=mask), 3, 2)
    assert small.image[..., 0].tolist() == [[200, 0, 0], [0, 0, 25]]
    assert small.counted is not None and small.counted.tolist() == [
        [True, False, False],
        [False, True, False],
    ]


def test_a_coarse_view_shows_the_same_field(blob_scene: Scene, tiny_config: Config) -> None:
    """A point of the world is at the same share of the image's width and height."""
    views = CoarseViews(Trainer(blob_scene, tiny_config, CPU).views, 0.7)
    full = blob_scene.train_views[1].camera
    small, target = views.look(1, full, 0.1)
    assert (small.width, small.height) == (12, 9) == tuple(target.image.shape[1::-1])
    point = full.rotation @ np.array([0.2, -0.1, 0.3]) + full.translation
    for axis, side in ((0, "width"), (1, "height")):
        shares = [
            ((c.fx, c.fy)[axis] * point[axis] / point[2] + (c.cx, c.cy)[axis]) / getattr(c, side)
            for c in (full, small)
        ]
        assert shares[0] == pytest.approx(shares[1])
    again = views.look(1, full, 0.2)
    assert again[0] is small  # a new camera in every step would fill what is kept for each
    assert views.look(1, full, 0.7)[0] is full


def test_a_step_renders_and_compares_as_coarsely_as_its_share_of_the_run_asks(
    blob_scene: Scene, tiny_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compgs.training.plan.COARSE_PIXELS", 48 * 36)
    config = replace(tiny_config, training=replace(tiny_config.training, steps=20))
    trainer = Trainer(blob_scene, config, CPU)
    assert trainer.coarse.until == 0.4
    trainer.coarse.until = 0.5
    sizes = []
    for _ in range(20):
        view = trainer.views.order[-1] if trainer.views.order else None
        result = trainer.train_step()
        assert result.image.shape == result.photograph.image.shape
        sizes.append(result.image.shape[1])
        if view is not None:
            whole = Target.from_image(blob_scene.train_views[view].image)
            expected = smaller(whole, result.image.shape[1], result.image.shape[0])
            assert torch.equal(result.photograph.image, expected.image)
            assert float(photometric_loss(result.image, result.photograph)) < float(result.loss)
    assert sizes == [12] * 5 + [24] * 5 + [48] * 10


def test_a_run_that_was_stopped_among_coarse_steps_continues_exactly(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compgs.training.plan.COARSE_PIXELS", 48 * 36)
    path = tmp_path / "checkpoint.safetensors"
    whole, first = (Trainer(blob_scene, tiny_config, CPU) for _ in range(2))
    for _ in range(12):
        assert first.train_step().image.shape[1] < 48
    first.save(path)
    second = Trainer.resumed(blob_scene, path, tiny_config, CPU)
    for _ in range(30):
        whole.train_step()
    for _ in range(18):
        second.train_step()
    for (name, a), (_, b) in zip(
        whole.model.named_parameters(), second.model.named_parameters(), strict=True
    ):
        assert torch.equal(a, b), name


def test_coarse_photographs_are_kept_within_a_bound(blob_scene: Scene, tiny_config: Config) -> None:
    views = CoarseViews(Trainer(blob_scene, tiny_config, CPU).views, 0.7)
    views.photographs.most_bytes = 3 * 3 * 12 * 9
    for view in range(8):
        views.look(view, blob_scene.train_views[view].camera, 0.0)
        kept = views.photographs.targets
        assert len(kept) == min(3, view + 1) and (view, 2) in kept
