"""The phases that `complexity.py` measures. Each runs in a process of its own, so that peak memory is its own:

    python benchmarks/complexity_phases.py PHASE FOLDER COMMAND ...

FOLDER is the run's; COMMAND is the `compgs train` of the run, word by word. The last line that it prints is JSON.
Seconds are wall clock. `peak_mb` is the most memory that the process had during the phase, `before_mb` what it had
when the phase began: program, libraries, and what the phase works on (photographs, trained model, file).
"""

import contextlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import fmean, median
from typing import Any

import codec
from codec import timed

from compgs import methods
from compgs.cli.command import use_threads
from compgs.cli.main import parse
from compgs.cli.run_folder import CHECKPOINT_NAME, RunSettings, file_name
from compgs.cli.scenes import read_scene
from compgs.cli.train import Train
from compgs.methods import METHODS

# Calls of which the median counts, after a first one that loads kernels and fills caches.
REPEATS = 5
EVALUATION = "evaluation"
BLACK = (0.0, 0.0, 0.0)


class Run:
    """What a `compgs train` was asked for, and where it writes."""

    def __init__(self, folder: Path, command: list[str]) -> None:
        asked = parse(command)
        assert isinstance(asked, Train), f"no training: {command}"
        self.folder = folder
        self.device = asked.device
        self.settings: RunSettings = asked.settings(folder)
        self.method = METHODS[self.settings.method]
        if asked.threads is not None:
            use_threads(asked.threads)

    @property
    def file(self) -> Path:
        return self.folder / file_name(self.folder, self.method.suffix)


# memory -------------------------------------------------------------------------------------------------------------


STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_mb() -> float:
    """MB (10^6 bytes), since the process began or since `forget_peak`."""
    if STATUS.is_file():
        # Not getrusage: there, a process begins with the peak of the one that started it.
        for line in STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    return codec.peak_mb()


def forget_peak() -> None:
    """Linux can; elsewhere what was loaded before may be part of a phase's peak."""
    with contextlib.suppress(OSError):
        CLEAR.write_text("5")


class Memory:
    """Of a phase that begins when this is made."""

    def __init__(self) -> None:
        import torch

        forget_peak()
        self.before = peak_mb()
        self.gpu = torch.cuda if torch.cuda.is_available() else None
        if self.gpu:
            self.gpu.reset_peak_memory_stats()

    def measured(self) -> dict[str, float]:
        """MB; `gpu_peak_mb` where there is a GPU."""
        gpu = {"gpu_peak_mb": self.gpu.max_memory_allocated() / 1e6} if self.gpu else {}
        return {"before_mb": self.before, "peak_mb": peak_mb(), **gpu}


def repeated(function: Callable[[], Any]) -> dict[str, float]:
    """Seconds: the first call, and the median of those after it."""
    first = timed(function)[0]
    return {"first_seconds": first, "seconds": median(timed(function)[0] for _ in range(REPEATS))}


# phases -------------------------------------------------------------------------------------------------------------


def train(run: Run) -> dict[str, Any]:
    """From a scene in memory to a trained model; checkpoints, as any run writes them, included."""
    scene = read_scene(run.settings.scene)
    config = run.settings.config
    memory = Memory()
    options = {"method": run.method.name, "output": run.folder, "device": run.device}
    seconds, _ = timed(lambda: methods.train(scene, config, **options))
    steps = config.training.steps
    return {"steps": steps, "seconds": seconds, "seconds_per_step": seconds / steps, **memory.measured()}


def encode(run: Run) -> dict[str, Any]:
    """From a trained model to its file on disk."""
    model = trained(run)
    memory = Memory()
    return {**repeated(lambda: run.method.write(model, run.file, run.settings.config)), **memory.measured()}


def trained(run: Run) -> Any:
    """The model of the checkpoint, as training hands it to the writer."""
    if run.settings.method == "compgs":
        from compgs.training import load_run

        return load_run(run.folder)
    from compgs.model.splats import SplatModel
    from compgs.tensors.splats import Splats
    from compgs.training.run.checkpoint import read_checkpoint_file, tensors_by_kind
    from compgs.training.splats.trainer import METHOD

    tensors, _ = read_checkpoint_file(run.folder / CHECKPOINT_NAME, METHOD)
    return SplatModel(Splats(**tensors_by_kind(tensors)["model"]).arrays(), BLACK)


def decode(run: Run) -> dict[str, Any]:
    """From the file on disk to a model that can be rendered."""
    memory = Memory()
    return {**repeated(lambda: opened(run)), **memory.measured()}


def opened(run: Run) -> Any:
    """A .ply does not know its background, which costs the same in every color."""
    from compgs.opening import open_scene
    from compgs.training.run.run import chosen_device

    return open_scene(run.file, chosen_device(run.device), BLACK)


def evaluate(run: Run) -> dict[str, Any]:
    """What the file is worth: the content of results.json. Leaves the held-out cameras for `render`."""
    import compgs

    scene = read_scene(run.settings.scene)
    folder = run.folder / EVALUATION
    return compgs.evaluate(run.file, scene, output=folder, overwrite=True, device=run.device).to_dict()


def render(run: Run) -> dict[str, Any]:
    """Until the 8-bit image is in main memory: for each held-out camera the median of some calls, then the mean."""
    from compgs.evaluation.camera_path import read_cameras
    from compgs.evaluation.measure import timed_render

    cameras = [camera for _, camera in read_cameras(run.folder / EVALUATION / "cameras.json")]
    model = opened(run)
    memory = Memory()
    first, *rounds = [[timed_render(model, c)[1] for c in cameras] for _ in range(1 + REPEATS)]
    return {"first_seconds": first[0], **view_seconds(rounds), **memory.measured()}


def view_seconds(rounds: list[list[float]]) -> dict[str, float]:
    """Of seconds by round and view: the mean over the views of each one's median, the slowest, and frames a second."""
    views = [median(seconds) for seconds in zip(*rounds, strict=True)]
    return {"seconds": fmean(views), "slowest_seconds": max(views), "frames_per_second": 1 / fmean(views)}


# In the order in which one needs what another leaves.
PHASES: dict[str, Callable[[Run], dict[str, Any]]] = {
    "train": train,
    "encode": encode,
    "decode": decode,
    "evaluate": evaluate,
    "render": render,
}


def main() -> None:
    phase, folder, *command = sys.argv[1:]
    Path(folder).mkdir(parents=True, exist_ok=True)
    print(json.dumps(PHASES[phase](Run(Path(folder), command))))


if __name__ == "__main__":
    main()
