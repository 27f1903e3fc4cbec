"""The viewer of a command, and what a training shows in it."""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from compgs.cli.progress import parts_of
from compgs.cli.usage import UsageError, check_range

if TYPE_CHECKING:
    from compgs.scene import Scene
    from compgs.training.run.any_trainer import AnyTrainer
    from compgs.training.run.status import TrainingStatus
    from compgs.viewer.live import LiveViewer
    from compgs.viewer.shown import GrowingShown, Shown
    from compgs.viewer.stage import SpareTime, Stage

MAX_PORT = 65535
NEWS = 4  # parts of a progress line that are told: step, time left, quality, size


def check_viewing(port: int, option: str = "--port") -> None:
    """Raises UsageError, MissingDependency for what can be known before anything is read."""
    from compgs.viewer import check_viewer

    check_range(option, port, 0, MAX_PORT)
    check_viewer()


@contextlib.contextmanager
def listening(
    shown: "Shown", stage: "Stage", host: str, port: int, *, training: bool = False
) -> "Iterator[LiveViewer]":
    """A viewer, closed at the end. Raises UsageError."""
    from compgs.viewer.live import LiveViewer

    prefix = "--viewer-" if training else "--"
    try:
        viewer = LiveViewer(shown, stage, host=host, port=port, training=training)
    except OSError as error:
        raise UsageError(
            f"{prefix}host {host} {prefix}port {port}: cannot be listened at ({error.strerror or error}); "
            f"give another one; {prefix}port 0 takes a free port"
        ) from error
    try:
        yield viewer
    finally:
        viewer.close()


class Viewing:
    """A training that visitors look at: to be called between two steps."""

    def __init__(self, viewer: "LiveViewer", shown: "GrowingShown", stage: "SpareTime") -> None:
        self.viewer = viewer
        self.shown = shown
        self.stage = stage

    @property
    def address(self) -> str:
        return self.viewer.address

    def __call__(self, trainer: "AnyTrainer") -> None:
        """Render what visitors wait for, as far as there is time for it."""
        self.shown.grown(trainer.step, trainer.snapshot)
        self.stage.tend()

    def tell(self, status: "TrainingStatus") -> None:
        """How far the training is; pictures at rest are drawn anew."""
        self.viewer.scene_changed("  \n".join(parts_of(status)[:NEWS]))


@contextlib.contextmanager
def viewing(scene: "Scene", title: str, host: str, port: int) -> Iterator[Viewing]:
    """While a scene is being trained. Raises UsageError."""
    from compgs.scene.viewpoints import choose_viewpoints, up_direction
    from compgs.scene.world import local_scene, world_offset
    from compgs.viewer.shown import GrowingShown
    from compgs.viewer.stage import SpareTime

    offset = world_offset(scene)
    cameras = [view.camera for view in scene.train_views]
    first = choose_viewpoints(cameras, 1)
    order = (*first, *(i for i in range(len(cameras)) if i not in first))
    shown = GrowingShown(
        title,
        tuple((scene.train_views[i].name, cameras[i]) for i in order),
        offset,
        up_direction(cameras),
        scene.background,
        np.asarray(local_scene(scene, offset).points.positions),
    )
    stage = SpareTime()
    with listening(shown, stage, host, port, training=True) as viewer:
        yield Viewing(viewer, shown, stage)
