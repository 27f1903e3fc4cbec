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
from compgs.formats.refining import _stride, refine
from compgs.gaussians import Gaussians
from compgs.model.hybrid_model import HybridModel
from compgs.model.primitives import select_anchors
from compgs.model.spherical_harmonics import view_colors
from compgs.model.splats import SplatModel
from compgs.render import render


@pytest.fixture(scope="module")
def model(cgs_bytes: bytes) -> HybridModel:
    return from_latents(*read_latents(cgs_bytes), torch.device("cpu"))


@pytest.fixture(scope="module")
def cameras(model: HybridModel) -> list[Camera]:
    """Forty around the scene, high and low."""
    positions = model.bounds[0].numpy()
    rings = [orbit(positions, frames=20, width=64, height=48, elevation=e) for e in (10.0, 40.0)]
    return [camera for ring in rings for _, camera in ring]


def psnr(model: HybridModel, baked: Baked, cameras: list[Camera]) -> float:
    splats = SplatModel(baked.splats, model.background, model.world_offset)
    pairs = [[metrics.to_8bit(render(m, c).image) for m in (model, splats)] for c in cameras]
    return float(np.mean([metrics.psnr(one, other) for one, other in pairs]))


class Painted:
    """A hybrid model whose primitives look as a function of the camera says: opacities [P] and colors [P, 3]."""

    def __init__(self, model: HybridModel, look) -> None:  # type: ignore[no-untyped-def]
        self.model, self.look = model, look

    def __getattr__(self, name: str):  # type: ignore[no-untyped-def]
        return getattr(self.model, name)

    def drawn(self, camera: Camera, visible: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
        rows = torch.nonzero(visible[self.model.primitives.anchor_index]).view(-1)
        opacities, colors = self.look(camera)
        rows = rows[opacities[rows] > baking.CUTOFF]
        means, scales, quaternions = (array[rows] for array in self.model.geometry)
        return Gaussians(means, quaternions, scales, opacities[rows], colors[rows]), rows


def test_colors_that_are_harmonics_come_back_as_their_coefficients(
    model: HybridModel, cameras: list[Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baking, "PENALTY", 0.0)
    chance = torch.Generator().manual_seed(0)
    dc = torch.rand(model.coupled, 3, generator=chance)
    rest = 0.02 * torch.randn(model.coupled, 3, 3, generator=chance)
    opacities = torch.full((model.coupled,), 0.3)

    def look(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        center = torch.tensor(camera.center, dtype=torch.float32)
        return opacities, view_colors(model.geometry[0], dc, rest, center, 1)

    baked = bake(Painted(model, look), cameras, degree=1)  # type: ignore[arg-type]
    assert len(baked.splats) == model.coupled
    torch.testing.assert_close(baked.splats.dc, dc, atol=2e-3, rtol=0)
    torch.testing.assert_close(baked.splats.rest, rest, atol=2e-3, rtol=0)
    torch.testing.assert_close(baked.splats.opacity_logits.sigmoid(), opacities, atol=1e-5, rtol=0)


def test_opacity_is_the_mean_over_what_reaches_the_primitive_where_it_is_not_drawn_too(
    model: HybridModel, cameras: list[Camera]
) -> None:
    """Of one primitive alone, which is there from the front and not from behind."""
    p = model.primitives
    lone = replace(p, residuals=p.residuals[:1], anchor_index=p.anchor_index[:1])
    alone = replace(model, primitives=select_anchors(lone, torch.arange(len(p)) == p.anchor_index[0]))
    mean = alone.geometry[0][0].double().numpy()
    away = np.array([0.6, -0.2, 0.5])
    poses = [look_at(mean + side * away, mean, np.array([0.0, -1.0, 0.0])) for side in (1, -1)]
    front, behind = (replace(cameras[0], world_to_camera=pose) for pose in poses)
    there, gray = torch.tensor([0.6]), torch.full((1, 3), 0.5)

    def look(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        return (there if camera is front else 0 * there), gray

    once = bake(Painted(alone, look), [front], degree=0)  # type: ignore[arg-type]
    twice = bake(Painted(alone, look), [front, behind], degree=0)  # type: ignore[arg-type]
    assert once.splats.opacity_logits.sigmoid().item() == pytest.approx(0.6, abs=1e-5)
    assert twice.splats.opacity_logits.sigmoid().item() == pytest.approx(0.3, abs=0.03)
    torch.testing.assert_close(once.importance, twice.importance)


class TwoBalls:
    """Balls at the origin and a unit before it, one anchor each; look(camera) gives opacities [2] and colors [2, 3]."""

    coupled = 2
    background = world_offset = (0.0, 0.0, 0.0)
    primitives = SimpleNamespace(anchor_index=torch.arange(2), positions=torch.zeros(2, 3))
    geometry = (
        torch.tensor([[0.0, 0, 0], [0, 0, -1]]),
        torch.full((2, 3), 0.2),
        torch.tensor([[1.0, 0, 0, 0]] * 2),
    )
    bounds = geometry[0], torch.ones(2)

    def __init__(self, look) -> None:  # type: ignore[no-untyped-def]
        self.look = look

    def drawn(self, camera: Camera, visible: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
        opacities, colors = self.look(camera)
        rows = torch.nonzero(visible & (opacities > baking.CUTOFF)).view(-1)
        means, scales, quaternions = (array[rows] for array in self.geometry)
        return Gaussians(means, quaternions, scales, opacities[rows], colors[rows]), rows


def along_z(z: float) -> Camera:
    """Looks at the origin, from so far along z."""
    pose = look_at(np.array([0, 0, z]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return Camera(pose, 40.0, 40.0, 24.0, 24.0, 48, 48)


def test_a_primitive_that_is_not_drawn_hides_next_to_nothing_of_those_behind_it() -> None:
    front, behind = along_z(-4.0), along_z(4.0)

    def look(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.tensor([0.2 if camera is front else 0.6, 0.0]), torch.zeros(2, 3)

    baked = bake(TwoBalls(look), [front, behind], degree=0)  # type: ignore[arg-type]
    assert len(baked.splats) == 1
    assert baked.splats.opacity_logits.sigmoid().item() == pytest.approx(0.4, abs=0.01)


def test_a_camera_counts_by_the_pixels_that_it_sees_of_a_primitive() -> None:
    near, far = along_z(2.0), along_z(8.0)

    def look(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.tensor([0.5, 0.0]), torch.full((2, 3), 0.9 if camera is near else 0.1)

    def seen(*cameras: Camera) -> Baked:
        return bake(TwoBalls(look), cameras, degree=0)  # type: ignore[arg-type]

    weights = [seen(camera).importance.item() + baking.HIDDEN_WEIGHT for camera in (near, far)]
    assert weights[0] > 8 * weights[1]
    expected = (0.9 * weights[0] + 0.1 * weights[1]) / sum(weights)
    color = 0.5 + 0.28209479 * seen(near, far).splats.dc
    torch.testing.assert_close(color, torch.full((1, 3), expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("degree", range(4))
def test_a_baked_scene_looks_as_the_scene_does_between_the_cameras_too(
    model: HybridModel, cameras: list[Camera], degree: int
) -> None:
    baked = bake(model, cameras, degree)
    assert baked.splats.degree == degree
    assert all(torch.isfinite(tensor).all() for tensor in vars(baked.splats).values())
    assert psnr(model, baked, between(cameras, 6)) > (26, 30, 32, 32)[degree]


def test_geometry_is_that_of_the_scene(model: HybridModel, cameras: list[Camera]) -> None:
    baked = bake(model, cameras, 0)
    means, scales, quaternions = model.geometry
    rows = torch.cdist(baked.splats.means.double(), means.double()).argmin(1)
    assert torch.equal(baked.splats.means, means[rows])
    assert torch.equal(baked.splats.quaternions, quaternions[rows])
    torch.testing.assert_close(baked.splats.log_scales.exp(), scales[rows])


def test_what_no_camera_sees_is_dropped(model: HybridModel, cameras: list[Camera]) -> None:
    assert 0 < len(bake(model, cameras, 0).splats) <= model.coupled
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
    torch.testing.assert_close(same.splats.dc, near.splats.dc, atol=1e-3, rtol=0)
    assert torch.equal(same.splats.means, near.splats.means)


def test_the_most_important_splats_stay_in_their_order(model: HybridModel, cameras: list[Camera]) -> None:
    baked = bake(model, cameras, 0)
    few = baked.most_important(10)
    assert few.importance.min() >= baked.importance.sort().values[-10]
    rows = [int(torch.nonzero((baked.splats.means == mean).all(1))[0]) for mean in few.splats.means]
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
    assert psnr(model, refined, others) > psnr(model, baked, others) + 0.5
    assert torch.equal(refined.splats.means, baked.splats.means)
    assert not refined.splats.dc.requires_grad


def test_no_steps_change_nothing(model: HybridModel, cameras: list[Camera]) -> None:
    baked = bake(model, cameras, 0)
    again = refine(baked, model, cameras, 0)
    assert all(
        torch.equal(a, b)
        for a, b in zip(vars(baked.splats).values(), vars(again.splats).values(), strict=True)
    )


@pytest.mark.parametrize("count", [1, 2, 3, 10, 84, 96, 97])
def test_strides_come_by_every_camera(count: int) -> None:
    assert {step * _stride(count) % count for step in range(count)} == set(range(count))
