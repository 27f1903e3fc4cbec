"""The time that is left knows that a run's last steps look at more pixels than its first."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.config import Config
from compgs.scene.views import Scene
from compgs.training.run.pace import Pace
from compgs.training.run.status import TrainingStatus
from compgs.training.run.time_left import TimeLeft, drawing_seconds
from compgs.training.shortcuts.coarse import divided, halved, halvings, usual_camera
from compgs.training.trainer import Trainer

STEPS = 1000
FIXED, EACH = 0.2, 1e-6  # seconds of a step, and more of each pixel


@dataclass
class Fake:
    """A run on photographs of some size, coarse until seven tenths."""

    width: int
    height: int
    step: int = 0
    until: float = 0.7
    snapshots: int = 0

    def camera_at(self, step: int, divisor: int = 1) -> Camera:
        whole = Camera(np.eye(4), 100.0, 100.0, 1.0, 1.0, self.width // divisor, self.height // divisor)
        return halved(whole, halvings(step / STEPS, self.until, whole.width, whole.height))

    def snapshot(self) -> None:
        self.snapshots += 1


def step_seconds(camera: Camera) -> float:
    return FIXED + EACH * camera.width * camera.height


def picture_seconds(scene: object, camera: Camera) -> float:
    """A picture takes what is more of a step by its pixels, and something of its own."""
    return 0.05 + EACH * camera.width * camera.height


def truth(run: Fake, first: int, divisor: int = 1) -> float:
    return sum(step_seconds(run.camera_at(step, divisor)) for step in range(first, STEPS))


@pytest.mark.parametrize("step", [10, 300, 690, 710, 990])
def test_the_time_left_is_that_of_the_steps_that_are_left(step: int) -> None:
    run = Fake(3000, 2000)
    left = TimeLeft(run, STEPS, draws=picture_seconds)
    for run.step in range(10, step + 1, 10):
        left.look(step_seconds(run.camera_at(run.step)))
    assert left.seconds() == pytest.approx(truth(run, step), rel=0.02)
    plain = (STEPS - step) * step_seconds(run.camera_at(step))
    assert step >= 700 or left.seconds() > 1.5 * plain  # at the present pace it would be a fraction


def test_large_photographs_are_told_what_smaller_ones_would_take() -> None:
    run = Fake(3000, 2000, step=10)
    left = TimeLeft(run, STEPS, draws=picture_seconds)
    assert left.by_divisor() == {}  # nothing was drawn yet
    left.look(step_seconds(run.camera_at(10)))
    found = left.by_divisor()
    assert list(found) == [1, 2, 4, 8]
    for divisor, seconds in found.items():
        assert seconds == pytest.approx(truth(run, 0, divisor), rel=0.1)
    small = Fake(1600, 1200, step=10)
    left = TimeLeft(small, STEPS, draws=picture_seconds)
    left.look(1.0)
    assert left.by_divisor() == {}


def test_sizes_that_are_not_drawn_take_as_long_as_the_nearest_by_their_pixels() -> None:
    class Many(Fake):
        """Forty sizes, of which six are drawn: photographs that were cut, each by another number of pixels."""

        def camera_at(self, step: int, divisor: int = 1) -> Camera:
            return Fake(self.width + 40 * (step * 7 % 40), self.height).camera_at(step, divisor)

    run = Many(1000, 1000, step=10)
    left = TimeLeft(run, STEPS, draws=picture_seconds)
    left.look(step_seconds(run.camera_at(10)))
    assert len(left.drawn) <= 7
    assert left.seconds() == pytest.approx(truth(run, 10), rel=0.05)


def test_steps_of_one_size_are_not_drawn_beforehand() -> None:
    run = Fake(200, 200, step=10)
    left = TimeLeft(run, STEPS, draws=picture_seconds)
    assert left.look(0.5) == 0.0 and run.snapshots == 0
    assert left.seconds() == pytest.approx(0.5 * 990)


def test_a_pace_is_forgotten_when_pictures_become_larger(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("compgs.training.run.pace.time.perf_counter", lambda: now[0])
    pace = Pace()
    pace.step()
    for size, each in (((10, 10), 1.0), ((10, 10), 1.0), ((20, 20), 8.0)):
        for _ in range(5):
            now[0] += each
            pace.step()
        assert pace.look(size) == pytest.approx(each)


def test_looking_ahead_changes_nothing_of_a_run(blob_scene: Scene, tiny_config: Config) -> None:
    scene, config = blob_scene, tiny_config
    trainers = [Trainer(scene, config, torch.device("cpu")) for _ in range(2)]
    left = TimeLeft(trainers[0], config.training.steps)
    for _ in range(3):
        for trainer in trainers:
            trainer.train_step()
        left.drawn.clear()
        assert drawing_seconds(trainers[0].snapshot(), trainers[0].camera_at(trainers[0].step)) > 0
    for one, other in zip(*(trainer.model.state_dict().values() for trainer in trainers), strict=True):
        assert torch.equal(one, other)


def test_a_trainers_camera_is_as_large_as_what_its_step_looks_at(
    blob_scene: Scene, tiny_config: Config
) -> None:
    large = [replace(view, camera=view.camera.resized(800, 600)) for view in blob_scene.train_views]
    scene, config = replace(blob_scene, train_views=tuple(large)), tiny_config
    trainer = Trainer(scene, config, torch.device("cpu"))
    cameras = [view.camera for view in large]
    for progress in (0.0, 0.3, 0.65, 0.9):
        found = trainer.camera_at(round(progress * config.training.steps))
        times = halvings(progress, trainer.plan.coarse_until, 800, 600)
        assert (found.width, found.height) == (800 // 2**times, 600 // 2**times)
    assert divided(usual_camera(cameras), 4).width == 200


def test_a_status_without_it_counts_steps_at_the_present_pace() -> None:
    from compgs.progress import time_left

    status = TrainingStatus(10, 100, 0.1, 20.0, 5, "anchors", 100, 2.0, None)
    assert time_left(status) == "3 min 00 s left"
    assert time_left(replace(status, seconds_left=30.0)) == "30 s left"
