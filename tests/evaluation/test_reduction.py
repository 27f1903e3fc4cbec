"""Smaller files of a made-up model: which primitives go, what is reported, what is refused."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from compgs import metrics
from compgs.cameras import Camera
from compgs.codec.decoder import from_latents
from compgs.codec.encoder import to_content
from compgs.codec.reader import read_content, read_latents
from compgs.codec.writer import write_content
from compgs.config import Config, ModelConfig
from compgs.errors import ConfigError
from compgs.evaluation.camera_path import orbit, surround
from compgs.evaluation.importance import importance, splat_importance
from compgs.evaluation.reduction import most_important, reduce_file
from compgs.model.hybrid_model import HybridModel
from compgs.model.splats import SplatArrays, SplatModel
from compgs.render import render
from compgs.scene.views import View
from compgs.trained_model import TrainedModel


@pytest.fixture(scope="module")
def data() -> bytes:
    """A file of 120 anchors with plausible latents."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    coordinates = np.unique(rng.integers(-20, 20, (120, 3)), axis=0).astype(np.int32)
    config = Config(model=ModelConfig(coupled_primitives=4, reference_dim=8, residuals=True, width=16))
    model = TrainedModel(config, torch.from_numpy(coordinates), 0.05, 3.0, (0.0, 0.0, 0.0))
    with torch.no_grad():
        model.references.normal_(0, 4)
        model.residuals.add_(3 * torch.randn_like(model.residuals))
        model.log_scales.normal_(0.5, 0.5)
        model.entropy.fit_covariance_prior(model.log_scales)
    return write_content(to_content(model))


def decoded(data: bytes) -> HybridModel:
    return from_latents(*read_latents(data))


@pytest.fixture(scope="module")
def cameras(data: bytes) -> list[Camera]:
    positions = decoded(data).primitives.positions
    return [camera for _, camera in orbit(positions, frames=5, width=48, height=36)]


def test_importance_of_splats_sums_over_cameras_and_shares_the_pixels(cameras: list[Camera]) -> None:
    chance = np.random.default_rng(0)
    splats = SplatArrays(
        means=chance.normal(0, 0.3, (40, 3)),
        log_scales=np.full((40, 3), -2.0),
        quaternions=chance.normal(size=(40, 4)),
        opacity_logits=chance.normal(size=40),
        dc=np.zeros((40, 3)),
        rest=np.zeros((40, 0, 3)),
    ).each(np.float32)
    model, calls = SplatModel(splats, (0.0, 0.0, 0.0)), []
    found = splat_importance(model, cameras, lambda: calls.append(None))
    covered = sum(float((1 - render(model, c).transmittance).sum()) for c in cameras)
    assert float(found.sum()) == pytest.approx(covered, rel=1e-4)
    assert len(calls) == len(cameras)
    far = SplatModel(replace(splats, world_offset=(1e5, 0.0, 0.0)), (0.0, 0.0, 0.0))
    moved = [camera.moved((-1e5, 0.0, 0.0)) for camera in cameras]
    np.testing.assert_allclose(splat_importance(far, moved), found, rtol=1e-3, atol=1e-3)


def image(model: HybridModel, camera: Camera) -> np.ndarray:
    return metrics.to_8bit(render(model, camera).image)


def test_importance_sums_over_cameras_and_shares_the_pixels(data: bytes, cameras: list[Camera]) -> None:
    model = decoded(data)
    covered = sum(float((1 - render(model, c).transmittance).sum()) for c in cameras)
    together = importance(model, cameras)
    assert together.shape == (model.coupled,)
    assert float(together.sum()) == pytest.approx(covered, rel=1e-3)
    apart = sum(importance(model, [camera]) for camera in cameras)
    assert np.allclose(together, apart)


def test_importance_is_the_same_wherever_the_scene_lies(data: bytes, cameras: list[Camera]) -> None:
    """Cameras are the world's."""
    model = decoded(data)
    far = replace(model, world_offset=(1e5, -2e4, 0.0))
    moved = [camera.moved((-1e5, 2e4, 0.0)) for camera in cameras]
    np.testing.assert_allclose(importance(far, moved), importance(model, cameras), rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("drop", [0.05, 0.5, 0.99])
def test_the_least_important_share_goes(data: bytes, cameras: list[Camera], drop: float) -> None:
    model = decoded(data)
    weights = importance(model, cameras)
    kept = most_important(model, cameras, drop)
    assert (~kept).sum() == math.floor(drop * model.coupled)
    assert weights[~kept].max() <= weights[kept].min()
    result, reduction = reduce_file(data, drop=drop, cameras=cameras)
    assert reduction.after.coupled_primitives == kept.sum() == decoded(result).coupled
    assert reduction.after.bytes == len(result) < reduction.before.bytes == len(data)


def test_of_primitives_that_contribute_alike_the_later_go(monkeypatch: pytest.MonkeyPatch) -> None:
    found = np.array([1.0, 0.0, 0.0, 2.0, 0.0, 3.0])
    monkeypatch.setattr("compgs.evaluation.reduction.importance", lambda *_: found)
    model = SimpleNamespace(coupled=6)
    assert most_important(model, [], 0.34).tolist() == [True, True, False, True, False, True]


def test_dropping_what_contributes_least_loses_less_than_dropping_any(
    data: bytes, cameras: list[Camera]
) -> None:
    from compgs.codec.reduce import without_coupled

    model = decoded(data)
    _, reduction = reduce_file(data, drop=0.4, cameras=cameras)
    any_kept = np.random.default_rng(0).permutation(model.coupled) >= 0.4 * model.coupled
    other = decoded(write_content(without_coupled(read_content(data), any_kept)))
    loss = np.mean([metrics.psnr(image(other, c), image(model, c)) for c in cameras])
    assert reduction.psnr > loss + 3


def test_what_is_reported_is_what_the_files_decode_to(data: bytes, cameras: list[Camera]) -> None:
    model = decoded(data)
    photographs = tuple(View(f"{i}", c, image(model, c) // 2) for i, c in enumerate(cameras[:2]))
    result, reduction = reduce_file(data, drop=0.5, coarser=2.0, cameras=cameras, held_out=photographs)
    new = decoded(result)
    against_old = np.mean([metrics.psnr(image(new, c), image(model, c)) for c in cameras])
    assert reduction.psnr == pytest.approx(against_old)
    for side, shown in ((reduction.before, model), (reduction.after, new)):
        exact = np.mean([metrics.psnr(image(shown, v.camera), v.image) for v in photographs])
        assert side.held_out_psnr == pytest.approx(exact)
    assert read_content(result).metadata["reduced"] == "drop 0.5, coarser 2"
    again, _ = reduce_file(result, drop=0.5, cameras=cameras)
    assert read_content(again).metadata["reduced"] == "drop 0.5, coarser 2, drop 0.5"


def test_the_same_file_is_reduced_to_the_same_file(data: bytes, cameras: list[Camera]) -> None:
    assert reduce_file(data, drop=0.3, cameras=cameras)[0] == reduce_file(data, drop=0.3, cameras=cameras)[0]


@pytest.mark.parametrize(
    ("drop", "coarser", "words"),
    [
        (-0.1, 1.0, "drop = -0.1"),
        (1.0, 1.0, "drop = 1"),
        (math.nan, 1.0, "drop = nan"),
        (0.0, 0.5, "coarser = 0.5"),
        (0.0, math.inf, "coarser = inf"),
        (0.0, 1.0, "nothing would change"),
        (1e-9, 1.0, "would take"),
    ],
)
def test_values_that_mean_nothing_are_refused(
    data: bytes, cameras: list[Camera], drop: float, coarser: float, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        reduce_file(data, drop=drop, coarser=coarser, cameras=cameras)


def test_cameras_around_a_scene_come_from_its_positions_alone() -> None:
    positions = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    first, second = surround(positions), surround(positions)
    assert len(first) == 72 == len({name for name, _ in first})
    for (_, a), (_, b) in zip(first, second, strict=True):
        assert np.array_equal(a.world_to_camera, b.world_to_camera)
