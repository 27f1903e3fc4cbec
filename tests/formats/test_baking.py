"""A neural scene as plain splats: closed forms where the scene is simple, and our own pictures where it is not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from compgs import metrics
from compgs.cameras import Camera
from compgs.codec.decoder import from_latents
from compgs.codec.reader import read_latents
from compgs.errors import TrainingError
from compgs.evaluation.camera_path import between, look_at, orbit
from compgs.formats import baking
from compgs.formats.baking import Baked, bake
from compgs.formats.refining import Adam, _stride, refine
from compgs.gaussians import Gaussians
from compgs.model.hybrid_model import HybridModel
from compgs.model.spherical_harmonics import view_colors
from compgs.model.splats import SplatModel, sigmoid
from compgs.render import render


@pytest.fixture(scope="module")
def model(cgs_bytes: bytes) -> HybridModel:
    return from_latents(*read_latents(cgs_bytes))


@pytest.fixture(scope="module")
def cameras(model: HybridModel) -> list[Camera]:
    """Forty around the scene, high and low."""
    positions = model.bounds[0]
    rings = [orbit(positions, frames=20, width=64, height=48, elevation=e) for e in (10.0, 40.0)]
    return [camera for ring in rings for _, camera in ring]


def psnr(model: HybridModel, baked: Baked, cameras: list[Camera]) -> float:
    splats = SplatModel(baked.splats, model.background)
    pairs = [[metrics.to_8bit(render(m, c).image) for m in (model, splats)] for c in cameras]
    return float(np.mean([metrics.psnr(one, other) for one, other in pairs]))


class Painted:
    """A hybrid model whose primitives look as a function of the camera says: opacities [P] and colors [P, 3]."""

    def __init__(self, model: HybridModel, look) -> None:  # type: ignore[no-untyped-def]
        self.model, self.look = model, look

    def __getattr__(self, name: str):  # type: ignore[no-untyped-def]
        return getattr(self.model, name)

    def drawn(self, camera: Camera, visible: np.ndarray) -> tuple[Gaussians, np.ndarray]:
        rows = np.flatnonzero(visible[self.model.primitives.anchor_index])
        opacities, colors = self.look(camera)
        rows = rows[opacities[rows] > baking.CUTOFF]
        means, scales, quaternions = (array[rows] for array in self.model.geometry)
        return Gaussians(means, quaternions, scales, opacities[rows], colors[rows]), rows


def test_colors_that_are_harmonics_come_back_as_their_coefficients(
    model: HybridModel, cameras: list[Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baking, "PENALTY", 0.0)
    chance = np.random.default_rng(0)
    dc = chance.random((model.coupled, 3)).astype(np.float32)
    rest = (0.02 * chance.normal(size=(model.coupled, 3, 3))).astype(np.float32)
    opacities = np.full(model.coupled, 0.3, np.float32)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        return opacities, view_colors(model.geometry[0], dc, rest, camera.center)

    baked = bake(Painted(model, look), cameras, degree=1)  # type: ignore[arg-type]
    assert len(baked.splats) == model.coupled
    np.testing.assert_allclose(baked.splats.dc, dc, atol=2e-3, rtol=0)
    np.testing.assert_allclose(baked.splats.rest, rest, atol=2e-3, rtol=0)
    np.testing.assert_allclose(sigmoid(baked.splats.opacity_logits), opacities, atol=1e-5, rtol=0)


def test_opacity_is_the_mean_over_what_reaches_the_primitive_where_it_is_not_drawn_too(
    model: HybridModel, cameras: list[Camera]
) -> None:
    """Of one primitive alone, which is there from the front and not from behind."""
    p = model.primitives
    lone = replace(p, residuals=p.residuals[:1], anchor_index=p.anchor_index[:1])
    kept = slice(p.anchor_index[0], p.anchor_index[0] + 1)
    own = {name: getattr(lone, name)[kept] for name in ("positions", "log_scales", "references")}
    alone = replace(model, primitives=replace(lone, **own, anchor_index=np.zeros(1, np.int64)))
    mean = alone.geometry[0][0].astype(np.float64)
    away = np.array([0.6, -0.2, 0.5])
    poses = [look_at(mean + side * away, mean, np.array([0.0, -1.0, 0.0])) for side in (1, -1)]
    front, behind = (replace(cameras[0], world_to_camera=pose) for pose in poses)
    there, gray = np.array([0.6], np.float32), np.full((1, 3), 0.5, np.float32)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        return (there if camera is front else 0 * there), gray

    once = bake(Painted(alone, look), [front], degree=0)  # type: ignore[arg-type]
    twice = bake(Painted(alone, look), [front, behind], degree=0)  # type: ignore[arg-type]
    assert sigmoid(once.splats.opacity_logits).item() == pytest.approx(0.6, abs=1e-5)
    assert sigmoid(twice.splats.opacity_logits).item() == pytest.approx(0.3, abs=0.03)
    np.testing.assert_allclose(once.importance, twice.importance, rtol=1e-5)


class TwoBalls:
    """Balls at the origin and a unit before it, one anchor each; look(camera) gives opacities [2] and colors [2, 3]."""

    coupled = anchors = 2
    background = world_offset = (0.0, 0.0, 0.0)
    angular_dilation = None
    antialiased = False
    primitives = SimpleNamespace(anchor_index=np.arange(2), positions=np.zeros((2, 3), np.float32))
    geometry = (
        np.array([[0.0, 0, 0], [0, 0, -1]], np.float32),
        np.full((2, 3), 0.2, np.float32),
        np.array([[1.0, 0, 0, 0]] * 2, np.float32),
    )
    bounds = geometry[0], np.ones(2, np.float32)

    def __init__(self, look) -> None:  # type: ignore[no-untyped-def]
        self.look = look

    def drawn(self, camera: Camera, visible: np.ndarray) -> tuple[Gaussians, np.ndarray]:
        opacities, colors = self.look(camera)
        rows = np.flatnonzero(visible & (opacities > baking.CUTOFF))
        means, scales, quaternions = (array[rows] for array in self.geometry)
        return Gaussians(means, quaternions, scales, opacities[rows], colors[rows]), rows


def along_z(z: float) -> Camera:
    """Looks at the origin, from so far along z."""
    pose = look_at(np.array([0, 0, z]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return Camera(pose, 40.0, 40.0, 24.0, 24.0, 48, 48)


def test_a_primitive_that_is_not_drawn_hides_next_to_nothing_of_those_behind_it() -> None:
    front, behind = along_z(-4.0), along_z(4.0)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        return np.array([0.2 if camera is front else 0.6, 0.0], np.float32), np.zeros((2, 3), np.float32)

    baked = bake(TwoBalls(look), [front, behind], degree=0)  # type: ignore[arg-type]
    assert len(baked.splats) == 1
    assert sigmoid(baked.splats.opacity_logits).item() == pytest.approx(0.4, abs=0.01)


class BallAside(TwoBalls):
    """The second ball is far to the side, where `along_z` does not look."""

    geometry = np.array([[0.0, 0, 0], [90, 0, 0]], np.float32), *TwoBalls.geometry[1:]
    bounds = geometry[0], np.ones(2, np.float32)


def test_what_lies_outside_of_all_pictures_is_as_the_networks_say_from_their_cameras() -> None:
    front, behind = along_z(-4.0), along_z(4.0)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        from_front = camera.center[2] < 0
        aside = 0.2 if from_front else 0.6
        colors = np.array([[0.5] * 3, [0.3, 0.8, 0.1] if from_front else [0.5, 0.6, 0.1]], np.float32)
        return np.array([0.7, aside], np.float32), colors

    baked = bake(BallAside(look), [front, behind], degree=0)  # type: ignore[arg-type]
    np.testing.assert_allclose(sigmoid(baked.splats.opacity_logits), [0.7, 0.4], atol=1e-4)
    np.testing.assert_allclose(0.5 + 0.28209479 * baked.splats.dc[1], [0.4, 0.7, 0.1], atol=1e-4)
    assert baked.importance[0] > 1 and baked.importance[1] == 0


def test_what_is_not_there_from_any_camera_is_dropped_outside_of_their_pictures_too() -> None:
    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        return np.array([0.7, 0.0], np.float32), np.zeros((2, 3), np.float32)

    assert len(bake(BallAside(look), [along_z(-4.0)], degree=0).splats) == 1  # type: ignore[arg-type]


def test_a_camera_counts_by_the_pixels_that_it_sees_of_a_primitive() -> None:
    near, far = along_z(2.0), along_z(8.0)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        colors = np.full((2, 3), 0.9 if camera is near else 0.1, np.float32)
        return np.array([0.5, 0.0], np.float32), colors

    def seen(*cameras: Camera) -> Baked:
        return bake(TwoBalls(look), cameras, degree=0)  # type: ignore[arg-type]

    weights = [seen(camera).importance.item() + baking.HIDDEN_WEIGHT for camera in (near, far)]
    assert weights[0] > 8 * weights[1]
    expected = (0.9 * weights[0] + 0.1 * weights[1]) / sum(weights)
    color = 0.5 + 0.28209479 * seen(near, far).splats.dc
    np.testing.assert_allclose(color, np.full((1, 3), expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("degree", range(4))
def test_a_baked_scene_looks_as_the_scene_does_between_the_cameras_too(
    model: HybridModel, cameras: list[Camera], degree: int
) -> None:
    baked = bake(model, cameras, degree)
    assert baked.splats.degree == degree
    assert all(np.isfinite(array).all() for array in vars(baked.splats).values())
    assert psnr(model, baked, between(cameras, 6)) > (26, 30, 32, 32)[degree]


def test_geometry_is_that_of_the_scene(model: HybridModel, cameras: list[Camera]) -> None:
    baked = bake(model, cameras, 0)
    means, scales, quaternions = model.geometry
    rows = np.abs(baked.splats.means[:, None] - means).sum(2).argmin(1)
    assert np.array_equal(baked.splats.means, means[rows])
    assert np.array_equal(baked.splats.quaternions, quaternions[rows])
    np.testing.assert_allclose(np.exp(baked.splats.log_scales), scales[rows], rtol=1e-5)


def test_a_scene_of_which_no_camera_sees_anything_is_refused(
    model: HybridModel, cameras: list[Camera]
) -> None:
    away = cameras[0].moved(-1e3 * np.ones(3))
    with pytest.raises(TrainingError, match=rf"none of {model.coupled} primitives is seen from 1 cameras"):
        bake(model, [away], 0)


def test_a_model_far_from_the_origin_bakes_to_the_same_splats(
    model: HybridModel, cameras: list[Camera]
) -> None:
    offset = (4.2e6, -1e5, 3e3)
    far = replace(model, world_offset=offset)
    moved = [camera.moved(tuple(-x for x in offset)) for camera in cameras]
    near, same = bake(model, cameras, 1), bake(far, moved, 1)
    assert len(near.splats) == len(same.splats)
    np.testing.assert_allclose(same.splats.dc, near.splats.dc, atol=1e-3, rtol=0)
    assert np.array_equal(same.splats.means, near.splats.means)


def test_the_most_important_splats_stay_in_their_order(model: HybridModel, cameras: list[Camera]) -> None:
    baked = bake(model, cameras, 0)
    few = baked.most_important(10)
    assert few.importance.min() >= np.sort(baked.importance)[-10]
    rows = [int(np.flatnonzero((baked.splats.means == mean).all(1))[0]) for mean in few.splats.means]
    assert len(rows) == 10 and rows == sorted(rows)
    assert baked.most_important(10**6) is baked


def test_importance_is_what_the_pictures_are_made_of(model: HybridModel, cameras: list[Camera]) -> None:
    covered = sum(float((1 - render(model, camera).transmittance).sum()) for camera in cameras)
    baked = bake(model, cameras, 0)
    assert float(baked.importance.sum()) == pytest.approx(covered, rel=1e-3)


def test_progress_counts_cameras_and_steps(model: HybridModel, cameras: list[Camera]) -> None:
    calls: list[None] = []
    baked = bake(model, cameras[:3], 0, lambda: calls.append(None))
    refine(baked, model, cameras[:3], 5, lambda: calls.append(None))
    assert len(calls) == 8


def test_refining_comes_nearer_to_the_scene_where_nothing_was_fitted(
    model: HybridModel, cameras: list[Camera]
) -> None:
    baked = bake(model, cameras, 1)
    others = between(cameras, 6)
    refined = refine(baked, model, cameras, 80)
    assert psnr(model, refined, others) > psnr(model, baked, others) + 0.3
    assert np.array_equal(refined.splats.means, baked.splats.means)
    assert not np.array_equal(refined.splats.dc, baked.splats.dc)


def test_no_steps_change_nothing(model: HybridModel, cameras: list[Camera]) -> None:
    baked = bake(model, cameras, 0)
    again = refine(baked, model, cameras, 0)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(vars(baked.splats).values(), vars(again.splats).values(), strict=True)
    )


@pytest.mark.parametrize("count", [1, 2, 3, 10, 84, 96, 97])
def test_strides_come_by_every_camera(count: int) -> None:
    assert {step * _stride(count) % count for step in range(count)} == set(range(count))


def test_adam_makes_the_steps_of_torchs() -> None:
    chance = np.random.default_rng(0)
    start = chance.normal(size=(5, 3)).astype(np.float32)
    parameter = torch.nn.Parameter(torch.from_numpy(start.copy()))
    theirs = torch.optim.Adam([parameter], lr=0.02, eps=1e-15)
    ours = Adam(start)
    for _ in range(20):
        gradient = (1e-3 * chance.normal(size=(5, 3))).astype(np.float32)
        parameter.grad = torch.from_numpy(gradient)
        theirs.step()
        np.testing.assert_allclose(ours.moved(gradient, 0.02), parameter.detach(), rtol=1e-5, atol=1e-6)
    assert not np.allclose(ours.value, start)
