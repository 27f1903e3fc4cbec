"""When a run writes its checkpoint."""

import time
from pathlib import Path

from compgs.interrupt import held_back
from compgs.training.run.any_trainer import AnyTrainer
from compgs.training.run.checkpoint import Writer
from compgs.training.run.distributed import on_any_rank

MINUTES = 5.0  # between two checkpoints; one is also written when the run is interrupted


class Saving:
    """A run's checkpoint: written every few minutes, at the end, and when the run is stopped.

    A run that takes the place of an earlier one leaves the earlier checkpoint until it has been going for long enough
    to write one of its own: whoever stops it at once keeps what there was.

    Those on the way are written beside the steps that follow. Of several ranks only rank 0 writes, and decides, but a
    checkpoint needs all of them.
    """

    def __init__(self, trainer: AnyTrainer, path: Path | None) -> None:
        self.trainer = trainer
        self.path = path
        self.writer = Writer()
        self.begun = False
        self.seconds = 60 * MINUTES
        self.saved = time.perf_counter()
        (self.writes,) = on_any_rank(path is not None)
        (self.replaces,) = on_any_rank(path is not None and trainer.step == 0 and path.exists())

    def due(self) -> bool:
        if not self.writes:
            return False
        waited = time.perf_counter() - self.saved > self.seconds
        (due,) = on_any_rank(self.path is not None and waited and not self.begun)
        return due

    def save(self, writer: Writer | None = None) -> float:
        """Seconds that it took. Whoever stops the run meanwhile is heard when the checkpoint is whole."""
        start = time.perf_counter()
        if self.writes:
            with held_back():
                self.trainer.save(self.path, writer)
        self.saved, self.replaces = time.perf_counter(), False
        return self.saved - start

    def begin(self) -> float:
        """Start writing a checkpoint in the background. Returns the seconds spent waiting."""
        self.begun = self.path is not None
        return self.save(self.writer)

    def last(self) -> None:
        """The checkpoint of the end."""
        with held_back():
            self.writer.finish()
            self.save()

    def ended(self) -> bool:
        """Whether one that was begun has been written since this was asked last. Raises OutputError if it could not."""
        ended = self.begun and not self.writer.busy
        self.begun = self.begun and not ended
        self.writer.check()
        return ended

    def stopped(self) -> None:
        """Save, unless an earlier run's checkpoint would be lost."""
        if not self.replaces:
            self.last()
