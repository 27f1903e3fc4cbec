"""A capture in coordinates of a country or of the Earth trains as it would around the origin."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import compgs
from compgs import metrics
from compgs.codec.viewpoint_cameras import kept_viewpoints
from compgs.config import Config
from compgs.evaluation.importance import importance
from compgs.numerics.rotations import rotation_from_quaternion
from compgs.render import render
from compgs.scene import Points, Scene, load_scene
from compgs.scene.colmap import read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model
from compgs.scene.generated import generate_scene
from compgs.training import train, train_splats
from compgs.training.run.checkpoint import CHECKPOINT_NAME
from compgs.training.run.model_checkpoint import load_checkpoint
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.trainer import Trainer

from .rules import without

CPU = torch.device("cpu")
SHIFT = (4.2e6, 5.1e5, 3e3)  # metres


def shifted(scene: Scene) -> Scene:
    """The same scene, its whole world moved by SHIFT."""

    def moved(views):
        return tuple(replace(v, camera=v.camera.moved(-np.array(SHIFT))) for v in views)

    points = Points(scene.points.positions.astype(np.float64) + SHIFT, scene.points.colors)
    return replace(
        scene, train_views=moved(scene.train_views), test_views=moved(scene.test_views), points=points
    )


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Scene]:
    """A generated capture, and the same one written to disk in coordinates like those of UTM; both read."""
    folder: Path = tmp_path_factory.mktemp("captures")
    for name in ("near", "far"):
        generate_scene(folder / name, views=10, width=64, height=48)
    sparse = folder / "far" / "sparse" / "0"
    model = read_sparse_model(sparse)
    images = [
        replace(i, translation=i.translation - rotation_from_quaternion(i.quaternion) @ SHIFT)
        for i in model.images
    ]
    points = replace(model.points, positions=model.points.positions + SHIFT)
    write_sparse_model(sparse, model.cameras.values(), images, points)
    return load_scene(folder / "near"), load_scene(folder / "far")


def small(config: Config) -> Config:
    # A voxel of a power of two: whole units are whole voxels, so that both scenes have the same grid. Without growth:
    # it draws random numbers for all candidates, and one more of them, by a rounding, gives other anchors. With all
    # gradients: which are in a sample depends on roundings, too.
    return replace(
        config,
        model=replace(config.model, voxel_size=0.125),
        control=replace(config.control, start=1.0, stop=0.0, prune_at=()),
        training=replace(config.training, steps=30, rules=without(config.training.rules, "hidden_anchors")),
    )


def assert_same_pictures(near, far, near_scene: Scene, far_scene: Scene) -> None:
    for a, b in zip(
        near_scene.test_views + near_scene.train_views[:3],
        far_scene.test_views + far_scene.train_views[:3],
        strict=True,
    ):
        first, second = render(near, a.camera).image, render(far, b.camera).image
        assert first.std() > 0.02  # something is seen
        assert metrics.psnr(metrics.to_8bit(first), metrics.to_8bit(second)) > 45


def test_a_capture_in_utm_trains_and_renders_as_around_the_origin(captures, tiny_config):
    near_scene, far_scene = captures
    config = small(tiny_config)
    near, far = train(near_scene, config, device=CPU), train(far_scene, config, device=CPU)
    assert near.world_offset == (0.0, 0.0, 0.0)
    middle = np.mean([v.camera.center for v in far_scene.train_views], axis=0)
    assert far.world_offset == tuple(np.rint(middle))
    assert far.as_hybrid_model().world_offset == far.world_offset
    assert near.anchors == far.anchors
    world = far.coordinates.numpy() * far.voxel_size + np.array(far.world_offset) - SHIFT
    np.testing.assert_allclose(world, near.coordinates.numpy() * near.voxel_size, rtol=0, atol=1e-6)
    assert_same_pictures(near.as_hybrid_model(), far.as_hybrid_model(), near_scene, far_scene)


def test_importance_is_looked_at_from_cameras_of_the_world(captures, tiny_config):
    far_scene = captures[1]
    model = Trainer(far_scene, small(tiny_config), CPU).model.as_hybrid_model()
    local = replace(model, world_offset=(0.0, 0.0, 0.0))
    cameras = [view.camera for view in far_scene.train_views[:2]]
    found = importance(model, cameras)
    assert found.sum() > 1
    expected = importance(local, [camera.moved(model.world_offset) for camera in cameras])
    assert np.array_equal(found, expected)


def test_the_offset_survives_a_checkpoint_and_the_run_goes_on(blob_scene, tiny_config, tmp_path):
    scene, path = shifted(blob_scene), tmp_path / CHECKPOINT_NAME
    whole, first = Trainer(scene, tiny_config, CPU), Trainer(scene, tiny_config, CPU)
    whole.run(None, None)
    for _ in range(17):
        first.train_step()
    first.save(path)
    assert load_checkpoint(path).model.world_offset == whole.model.world_offset != (0.0, 0.0, 0.0)
    second = Trainer.resumed(scene, path, tiny_config, CPU)
    second.run(None, None)
    assert torch.equal(whole.model.references, second.model.references)


def test_splats_in_utm_train_and_render_as_around_the_origin(blob_scene, tiny_config, tmp_path):
    config = replace(tiny_config, training=replace(tiny_config.training, steps=30))
    scene = shifted(blob_scene)
    near, far = train_splats(blob_scene, config, device=CPU), train_splats(scene, config, device=CPU)
    assert near.world_offset == (0.0, 0.0, 0.0)
    assert np.abs(np.array(far.world_offset) - SHIFT).max() < 3
    assert_same_pictures(near, far, blob_scene, scene)
    trainer = SplatTrainer(scene, config, CPU)
    trainer.train_step()
    trainer.save(tmp_path / CHECKPOINT_NAME)
    again = SplatTrainer.resumed(scene, tmp_path / CHECKPOINT_NAME, config, CPU)
    again.run(None, None)
    assert again.world_offset == far.world_offset
    assert np.array_equal(again.parameters.means.detach(), far.splats.means)


def test_the_offset_and_the_viewpoints_survive_the_file(blob_scene, tiny_config, tmp_path):
    from compgs.codec import decode, encode

    scene = shifted(blob_scene)
    model = Trainer(scene, tiny_config, CPU).model
    encode(model, tmp_path / "far.cgs")
    decoded = decode(tmp_path / "far.cgs")
    assert decoded.world_offset == model.world_offset and any(decoded.world_offset)
    kept = kept_viewpoints(tiny_config.training.viewpoints, len(model.coordinates))
    assert len(decoded.viewpoints) == min(len(scene.train_views), kept) > 1
    np.testing.assert_allclose(decoded.up, model.up, atol=0.01)
    spread = max(np.linalg.norm(c.center - model.viewpoints[0].center) for c in model.viewpoints)
    for found, camera in zip(decoded.viewpoints, model.viewpoints, strict=False):
        assert np.linalg.norm(found.center - camera.center) < spread / 1e4 + 1e-6
        np.testing.assert_allclose(found.rotation, camera.rotation, atol=1e-3)
    camera = scene.train_views[0].camera
    ours, theirs = (compgs.render(m, camera).image for m in (model.as_hybrid_model(), decoded))
    assert np.abs(ours - theirs).max() < 1e-2
