"""What one of several processes does in `test_distributed.py`: not a test itself.

    python ranks.py RANK OF FOLDER

The processes meet by a file in the folder; each leaves there what it found, as `found_RANK.pt`.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist

import compgs  # before torch: its threads must not spin

sys.path.append(str(Path(__file__).parents[1]))
from compgs.config import Config, ControlConfig, ModelConfig, Phases, TrainingConfig
from compgs.errors import CompGSError
from compgs.scene.generated import generate_scene
from compgs.scene.views import Scene, View
from compgs.training.run import distributed
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
STEPS = 24
STOPPED_AT = 9
# Few views, so that some primitives are left out of each step; growth, pruning and turned references are all in it. All
# gradients are: one last bit makes another sample of them, and another run.
CONFIG = Config(
    model=ModelConfig(coupled_primitives=4, reference_dim=8, residual_dim=8, width=16, voxel_size=0.6),
    control=ControlConfig(
        start=0.2, stop=0.7, every=0.2, minimum_views=2, gradient_threshold=1e-5, opacity_threshold=0.01
    ),
    training=TrainingConfig(
        steps=STEPS,
        seed=3,
        views_per_step=2,
        exposure=True,
        rules="all but hidden_anchors",
        phases=Phases(rate=0.0),
    ),
)
TRAINERS: dict[str, Callable[..., Any]] = {"compgs": Trainer, "3dgs": SplatTrainer}


def small_scene(folder: Path) -> Scene:
    """Eight training views of 48 x 36 pixels; who makes it first, makes it for all."""
    if not folder.exists():
        generate_scene(folder, views=9, width=48, height=36)
    return compgs.load_scene(folder, test_every=9, at_once=False)


def noting(scene: Scene, seen: set[str]) -> Scene:
    """The scene, whose photographs leave their names in `seen` when they are looked at."""

    def noted(view: View) -> View:
        def pixels() -> np.ndarray:
            seen.add(view.name)
            return view.image

        return replace(view, pixels=pixels)

    return replace(scene, train_views=tuple(map(noted, scene.train_views)))


def parameters(trainer: Any) -> dict[str, torch.Tensor]:
    named = trainer.model.state_dict() if isinstance(trainer, Trainer) else trainer.named_parameters()
    return {name: value.detach().clone() for name, value in named.items()}


def first_gradients(kind: str, scene: Scene) -> dict[str, torch.Tensor]:
    """What the first step would move the parameters by."""
    trainer, found = TRAINERS[kind](scene, CONFIG, CPU), {}
    named = dict(trainer.model.named_parameters() if kind == "compgs" else trainer.named_parameters())
    step = trainer.optimizer.step

    def keep() -> None:
        found.update({name: p.grad.clone() for name, p in named.items() if p.grad is not None})
        step()

    trainer.optimizer.step = keep
    found["loss"] = trainer.train_step().loss
    return found


def whole_run(kind: str, scene: Scene, folder: Path) -> dict[str, Any]:
    """A run with a checkpoint on its way, which others go on from, and its end."""
    seen: set[str] = set()
    trainer = TRAINERS[kind](noting(scene, seen), CONFIG, CPU)
    counts = []
    for _ in range(STOPPED_AT):
        trainer.train_step()
        counts.append(trainer.primitives)
    trainer.save(folder / f"{kind}.safetensors" if distributed.rank() == 0 else None)
    trainer.run(None, None)
    return {
        "seen": seen,
        "counts": counts,
        "primitives": trainer.primitives,
        "parameters": parameters(trainer),
        "exposures": trainer.views.tensors()["photometry/photographs/numbers"].clone(),
    }


def resumed_run(kind: str, scene: Scene, path: Path) -> dict[str, Any]:
    """From a checkpoint, whoever wrote it, to the end."""
    trainer = TRAINERS[kind].resumed(scene, path, CONFIG, CPU)
    statistics = {name: getattr(trainer.control, name).clone() for name in trainer.control.STATISTICS}
    trainer.run(None, None)
    return {"primitives": trainer.primitives, "parameters": parameters(trainer), "statistics": statistics}


def diverging_run(scene: Scene) -> str:
    """Rank 1 loses the last bit of one number."""
    trainer = Trainer(scene, CONFIG, CPU)
    if distributed.rank() == 1:
        with torch.no_grad():
            trainer.model.log_scales[0, 0] += 1e-6
    try:
        trainer.run(None, None)
    except CompGSError as error:
        return f"{type(error).__name__}: {error}"
    return "nothing was noticed"


def stopped_run(scene: Scene, folder: Path) -> dict[str, Any]:
    """Ctrl-C comes to rank 1 alone."""
    trainer, step = Trainer(scene, CONFIG, CPU), None
    step = trainer.train_step

    def train_step() -> Any:
        if trainer.step == 5 and distributed.rank() == 1:
            import signal

            signal.raise_signal(signal.SIGINT)
        return step()

    trainer.train_step = train_step
    path = folder / "stopped.safetensors"
    try:
        trainer.run(path, None)
    except KeyboardInterrupt:
        return {"step": trainer.step, "written": path.is_file()}
    return {"step": None}


def everything(rank: int, of: int, folder: Path) -> dict[str, Any]:
    scene = small_scene(folder / "scene")
    found: dict[str, Any] = {}
    for kind in TRAINERS:
        found[f"gradients {kind}"] = first_gradients(kind, scene)
        found[f"run {kind}"] = whole_run(kind, scene, folder)
        found[f"resumed {kind}"] = resumed_run(kind, scene, folder.parent / "alone" / f"{kind}.safetensors")
    if of > 1:
        found["diverging"] = diverging_run(scene)
        found["stopped"] = stopped_run(scene, folder)
        try:
            Trainer(scene, replace(CONFIG, training=TrainingConfig(steps=4)), CPU)
        except CompGSError as error:
            found["too few views"] = str(error)
    return found


def gone(rank: int) -> str:
    """Rank 1 ends in the middle of a run."""
    total = torch.ones(3)
    distributed.sum_over_ranks(total)
    if rank == 1:
        sys.exit(3)
    try:
        while True:
            distributed.sum_over_ranks(total)
    except CompGSError as error:
        return f"{type(error).__name__}: {error}"


def main(rank: int, of: int, folder: Path) -> None:
    if of > 1:
        dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=of)
    found = everything(rank, of, folder)
    torch.save(found, folder / f"found_{rank}.pt")
    if of > 1:
        found["gone"] = gone(rank)
        torch.save(found, folder / f"found_{rank}.pt")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
