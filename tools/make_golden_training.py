"""Writes tests/golden/training.json: what a short training of a small generated scene comes to.

    python tools/make_golden_training.py

Run it when training is meant to decide otherwise than before, and say in the commit why. Floating-point results differ
between processors and versions of libraries: the file's hash is exact only for the machine that is named beside it.
"""

import hashlib
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import torch

import compgs
from compgs.config import Config, ControlConfig, EntropyConfig, ModelConfig, Phases, TrainingConfig
from compgs.metrics import psnr, to_8bit
from compgs.render import render
from compgs.scene.generated import generate_scene
from compgs.training.start import plan_for
from compgs.training.trainer import Trainer

GOLDEN = Path(__file__).parent.parent / "tests" / "golden" / "training.json"
# Everything that a run does is in it: growth and the removal of transparent anchors, pruning, references that turn and
# lose channels, a size to aim at, primitives left out of steps, noise and then symbols, weights as they are stored. But
# for what would make another run of every machine's last bits.
CONFIG = Config(
    model=ModelConfig(
        coupled_primitives=3, reference_dim=10, residuals=True, residual_dim=4, width=16, voxel_size=0.7
    ),
    entropy=EntropyConfig(reference_hyper_dim=2, decorrelate_at=(0.3, 0.5, 0.8)),
    control=ControlConfig(
        start=0.25,
        stop=0.6,
        every=0.2,
        gradient_threshold=1e-5,
        minimum_views=2,
        growth_probabilities=(0.5, 0.4, 0.3),
        prune_worth=300.0,
        opacity_threshold=0.01,
        prune_at=(0.55, 0.7),
        idle_share=0.01,
    ),
    training=TrainingConfig(
        steps=60,
        seed=11,
        target_bytes=2_200,
        ssim_weight=0.2,
        # Which anchors are hidden depends on the last bit of their gradients.
        rules="all but hidden_anchors",
        phases=Phases(rate=0.05, symbols=0.75),
    ),
)


def machine() -> dict[str, str]:
    """What decides the last bits of floating-point results."""
    return {
        "processor": llvmlite.binding.get_host_cpu_name(),
        "vectors": torch.backends.cpu.get_cpu_capability(),
        **{module.__name__: module.__version__ for module in (torch, numba, np)},
    }


def golden_training(folder: Path) -> dict[str, Any]:
    """What training decides, and the file; `folder` is for the scene and the file. No number depends on threads."""
    generate_scene(folder / "scene", views=16, width=64, height=48)
    scene = compgs.load_scene(folder / "scene")
    device = torch.device("cpu")
    planned = replace(plan_for(scene, CONFIG, device), rate_every=2)  # 60 steps are few
    trainer = Trainer(scene, CONFIG, device, planned=planned)
    # [step, anchors, channels of a reference], whenever one of the two has changed
    events = [[0, trainer.model.anchors, trainer.model.reference_dim]]
    while trainer.step < CONFIG.training.steps:
        trainer.train_step()
        now = [trainer.model.anchors, trainer.model.reference_dim]
        if now != events[-1][1:]:
            events.append([trainer.step, *now])
    trainer.finish()
    file = folder / "golden.cgs"
    compgs.encode(trainer.model, file)
    decoded = compgs.decode(file)
    quality = [psnr(to_8bit(render(decoded, view.camera).image), view.image) for view in scene.test_views]
    return {
        "events": events,
        "lambda": trainer.lmbda,
        "primitives": int(trainer.model.mask.sum()),
        "bytes": file.stat().st_size,
        "psnr": float(np.mean(quality)),
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
    }


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        found = golden_training(Path(folder))
    lines = [f'"{name}": {json.dumps(value)}' for name, value in {"machine": machine(), **found}.items()]
    GOLDEN.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(GOLDEN.read_text(encoding="utf-8"), end="")


if __name__ == "__main__":
    main()
