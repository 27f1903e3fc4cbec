"""Whoever looks at a training changes nothing of it, and sees the scene of now."""

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import compgs
from compgs.config import Config
from compgs.methods import train
from compgs.metrics import to_8bit
from compgs.scene.views import Scene
from compgs.training.run.any_trainer import AnyTrainer
from compgs.viewer.shown import GrowingShown
from compgs.viewer.stage import SpareTime
from compgs.viewer.visitor import Look, Picture, Visitor, lens_of


class StandIn:
    """In place of a browser whose camera never rests."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.pictures: list[Picture] = []
        self.visitor: Visitor | None = None

    def lens(self) -> object:
        views = self.scene.train_views
        return lens_of(views[len(self.pictures) % len(views)].camera)

    def show(self, picture: Picture) -> None:
        self.pictures.append(picture)
        assert self.visitor is not None
        self.visitor.changed(moving=len(self.pictures) % 2 == 0)

    def fail(self, message: str) -> None:
        raise AssertionError(message)


class Watched:
    """A visitor and its thread; every step of the training has time for it."""

    def __init__(self, scene: Scene) -> None:
        positions = np.asarray(scene.points.positions)
        cameras = tuple((view.name, view.camera) for view in scene.train_views)
        self.shown = GrowingShown(scene.name, cameras, (0, 0, 0), (0, 0, 1), scene.background, positions)
        self.stage = SpareTime(share=1e6)
        self.page = StandIn(scene)
        self.visitor = self.page.visitor = Visitor(
            self.page, self.shown, self.stage, Look(0, (0.2, 0.2, 0.2))
        )
        self.thread = threading.Thread(target=self.visitor.work, daemon=True)
        self.thread.start()
        self.steps: list[int] = []

    def __call__(self, trainer: AnyTrainer) -> None:
        self.steps.append(trainer.step)
        self.shown.grown(trainer.step, trainer.snapshot)
        while self.stage._jobs.empty():  # until the visitor asks for something
            assert self.thread.is_alive()
        self.stage.tend()

    def close(self) -> None:
        self.visitor.close()
        self.stage.close()
        self.thread.join(10)
        assert not self.thread.is_alive()


@pytest.mark.parametrize("method", ["compgs", "3dgs"])
def test_a_training_comes_out_the_same_whether_it_is_looked_at_or_not(
    blob_scene: Scene, tiny_config: Config, method: str
) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, steps=24))
    alone = train(blob_scene, config, method=method, device="cpu")
    watched = Watched(blob_scene)
    looked_at = train(blob_scene, config, method=method, device="cpu", watch=watched)
    watched.close()
    assert watched.steps == list(range(1, 25)) and len(watched.page.pictures) >= 20
    assert {picture.full for picture in watched.page.pictures} == {True, False}
    for name, value in state(alone).items():
        np.testing.assert_array_equal(np.asarray(value), np.asarray(state(looked_at)[name]), name)


def state(model: object) -> dict[str, object]:
    return dict(model.state_dict()) if isinstance(model, torch.nn.Module) else dict(vars(model.splats))  # type: ignore[attr-defined]


@pytest.mark.parametrize("method", ["compgs", "3dgs"])
def test_a_snapshot_stays_as_it_was_taken(blob_scene: Scene, tiny_config: Config, method: str) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, steps=6))
    camera = blob_scene.test_views[0].camera
    taken: list[Callable[[], np.ndarray]] = []
    seen: list[np.ndarray] = []

    def look(trainer: AnyTrainer) -> None:
        snapshot = trainer.snapshot()
        taken.append(lambda: to_8bit(compgs.render(snapshot, camera).image))
        seen.append(taken[-1]())

    train(blob_scene, config, method=method, device="cpu", watch=look)
    for draw, before in zip(taken, seen, strict=True):
        np.testing.assert_array_equal(draw(), before)
    assert len({image.tobytes() for image in seen}) > 2  # there is something to see, and it changes


def test_pictures_at_rest_are_of_now_and_moving_ones_of_the_last_snapshot(blob_scene: Scene) -> None:
    positions = np.asarray(blob_scene.points.positions)
    cameras = tuple((view.name, view.camera) for view in blob_scene.train_views)
    shown = GrowingShown("blobs", cameras, (0, 0, 0), (0, 0, 1), (0, 0, 0), positions)
    names = iter("abc")
    for step in (1, 2):
        shown.grown(step, lambda: next(names))  # type: ignore[arg-type,return-value]
        if step == 1:
            assert shown.model(0, fresh=False) == "a" and shown.model(0, fresh=True) == "a"
    assert [shown.model(0, fresh=fresh) for fresh in (False, True, True)] == ["a", "b", "b"]
