"""Poses are learned beside the scene: gradients are those of the cameras, and known errors are found again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.gaussians import Gaussians
from compgs.scene.views import Scene
from compgs.tensors.rasterize import rasterize
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.step.poses import Poses, moved, rates, rotation_matrix
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
TURNS, SHIFTS = 0.02, 0.06  # radians, world units: a pixel each of the blobs' 50 pixels of focal length


def shaken(scene: Scene, seed: int = 0) -> Scene:
    """The cameras of the training views, each turned and moved a little; the photographs are as they were."""
    chance = np.random.default_rng(seed)
    views = []
    for view in scene.train_views:
        pose = np.eye(4)
        turn = torch.from_numpy(chance.normal(0, TURNS, 3))
        pose[:3, :3] = rotation_matrix(turn).numpy()
        pose[:3, 3] = chance.normal(0, SHIFTS, 3)
        views.append(
            replace(view, camera=replace(view.camera, world_to_camera=pose @ view.camera.world_to_camera))
        )
    return replace(scene, train_views=tuple(views))


def double(blobs: Gaussians) -> Gaussians:
    return Gaussians(*(value.double() for value in vars(blobs).values()))


def test_primitives_that_are_moved_look_like_a_camera_that_is_moved(blob_scene, blobs) -> None:
    poses = Poses(blob_scene, CPU, looks=50)
    poses.rows.numbers[2] = torch.tensor([1.0, -2.0, 0.5, 3.0, -1.0, 2.0])
    camera = blob_scene.train_views[2].camera
    scene = double(replace(blobs, scales=blobs.scales * torch.tensor([1.0, 0.4, 2.0])))
    by_primitives = rasterize(moved(scene, poses.rows.values()[2].double(), camera), camera).image
    by_camera = rasterize(scene, poses.camera(2, camera)).image
    assert (by_camera - rasterize(scene, camera).image).abs().max() > 0.1
    torch.testing.assert_close(by_primitives, by_camera, atol=1e-5, rtol=0)


def test_the_gradient_of_an_offset_is_that_of_finite_differences(blob_scene, blobs) -> None:
    camera, scene = blob_scene.train_views[1].camera, double(blobs)
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(36, 48, 3)))

    def loss(offset: torch.Tensor) -> torch.Tensor:
        return (weights * rasterize(moved(scene, offset, camera), camera).image).sum()

    offset = torch.tensor([0.01, -0.02, 0.005, 0.02, 0.01, -0.03], dtype=torch.float64, requires_grad=True)
    loss(offset).backward()
    step = 1e-6
    for i in range(6):
        change = torch.zeros(6, dtype=torch.float64)
        change[i] = step
        with torch.no_grad():
            expected = (loss(offset + change) - loss(offset - change)) / (2 * step)
        assert float(offset.grad[i]) == pytest.approx(float(expected), rel=1e-3, abs=1e-3)


def test_all_together_cameras_neither_turn_nor_move_nor_spread(blob_scene) -> None:
    poses = Poses(blob_scene, CPU, looks=50)
    numbers = torch.from_numpy(np.random.default_rng(0).normal(size=(8, 6))).float()
    poses.rows.numbers[:] = numbers
    poses.hold_means()
    values = poses.rows.numbers
    torch.testing.assert_close(values.mean(0), torch.zeros(6), atol=1e-6, rtol=0)
    centers = np.stack([view.camera.center for view in blob_scene.train_views])
    spread = torch.from_numpy(centers - centers.mean(0)).float()
    assert abs(float((spread * values[:, 3:]).sum())) < 1e-4
    before = values.clone()
    poses.hold_means()
    torch.testing.assert_close(values, before)


def test_the_fewer_looks_a_run_has_the_more_each_of_them_moves_a_camera() -> None:
    firsts = [rates(looks)[0] for looks in (5, 20, 50, 100, 300, 1000)]
    assert firsts == sorted(firsts, reverse=True) and firsts[0] == 0.3 and firsts[-1] == 0.05
    assert rates(60)[0] == pytest.approx(0.1) and rates(60)[1] == pytest.approx(0.01)


def off(scene: Scene, truth: Scene, poses: Poses | None) -> float:
    """Pixels that the poses are off, root mean square, by where points are seen."""
    squares = []
    for number, (view, true) in enumerate(zip(scene.train_views, truth.train_views, strict=True)):
        camera = view.camera if poses is None else poses.camera(number, view.camera)
        squares.append(((seen(camera, scene) - seen(true.camera, scene)) ** 2).sum(1).mean())
    return float(np.sqrt(np.mean(squares)))


def seen(camera, scene: Scene) -> np.ndarray:
    x, y, z = (scene.points.positions @ camera.rotation.T + camera.translation).T
    return np.stack([camera.fx * x / z, camera.fy * y / z], axis=1)


@pytest.mark.parametrize("kind", [Trainer, pytest.param(SplatTrainer, marks=pytest.mark.slow)])
def test_poses_that_were_put_off_are_found_again(blob_scene, tiny_config, kind) -> None:
    scene = shaken(blob_scene)
    training = replace(tiny_config.training, steps=400, lmbda=0.0, poses="on")
    trainer = kind(scene, replace(tiny_config, training=training), CPU)
    trainer.run(None, None)
    before, after = off(scene, blob_scene, None), off(scene, blob_scene, trainer.views.poses)
    assert before > 1.0
    assert after < 0.6 * before


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_a_run_with_poses_continues_exactly(blob_scene, tiny_config, tmp_path, kind) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, poses="on", exposure=True))
    whole = kind(blob_scene, config, CPU)
    whole.run(None, None)
    first = kind(blob_scene, config, CPU)
    for _ in range(17):
        first.train_step()
    first.save(tmp_path / "checkpoint.safetensors")
    second = kind.resumed(blob_scene, tmp_path / "checkpoint.safetensors", config, CPU)
    second.run(None, None)
    for name, value in whole.views.tensors().items():
        assert torch.equal(value, second.views.tensors()[name])
    assert whole.views.tensors()["poses/numbers"].any()


def test_poses_are_learned_where_the_reconstruction_is_in_doubt_or_somebody_asks(
    blob_scene, tiny_config
) -> None:
    def learns(scene: Scene, poses: str) -> bool:
        config = replace(tiny_config, training=replace(tiny_config.training, poses=poses))
        trainers = [kind(scene, config, CPU) for kind in (Trainer, SplatTrainer)]
        learned = {trainer.views.poses is not None for trainer in trainers}
        assert len(learned) == 1
        return learned.pop()

    doubtful = replace(blob_scene, poses_in_doubt="their mean error is 1.4 pixels")
    assert [learns(blob_scene, poses) for poses in ("auto", "off", "on")] == [False, False, True]
    assert [learns(doubtful, poses) for poses in ("auto", "off", "on")] == [True, False, True]
    plan = Trainer(doubtful, tiny_config, CPU).plan
    assert plan.poses and "poses" in "\n".join(plan.in_words())
    assert plan == type(plan).from_dict(plan.to_dict())
