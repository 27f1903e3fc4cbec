"""Checkpoints: everything that a run needs to go on as if it had never stopped, in one safetensors file.

Tensors by name; settings, counters and the view order as JSON in the file's metadata. Written atomically.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from compgs.config import config_from_dict
from compgs.errors import CheckpointError, OutputError
from compgs.trained_model import TrainedModel

CHECKPOINT_NAME = "checkpoint.safetensors"
CHECKPOINT_VERSION = "1"


@dataclass(frozen=True)
class Checkpoint:
    """State of a run between two steps."""

    model: TrainedModel
    optimizer: dict[str, Tensor]  # "<parameter name>/<moment>"
    extra: dict[str, Tensor]  # control statistics, random generators
    state: dict[str, Any]  # step, view order, ... (JSON)


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Raises OutputError if the file cannot be written; a previous checkpoint then stays as it was."""
    model = checkpoint.model
    tensors = {f"model/{k}": v for k, v in model.state_dict().items()}
    tensors |= {f"optimizer/{k}": v for k, v in checkpoint.optimizer.items()}
    tensors |= {f"extra/{k}": v for k, v in checkpoint.extra.items()}
    metadata = {
        "format": "compgs checkpoint",
        "version": CHECKPOINT_VERSION,
        "config": json.dumps(model.config.to_dict()),
        "scene": json.dumps(
            {
                "voxel_size": model.voxel_size,
                "distance_unit": model.distance_unit,
                "background": list(model.background),
            }
        ),
        "state": json.dumps(checkpoint.state),
    }
    temporary = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        safetensors.torch.save_file(
            {k: v.detach().cpu().contiguous() for k, v in tensors.items()}, temporary, metadata=metadata
        )
        os.replace(temporary, path)
    except (OSError, safetensors.SafetensorError) as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(f"{path}: the checkpoint cannot be written ({error})") from error


def load_checkpoint(path: Path) -> Checkpoint:
    """Raises CheckpointError if there is none, or it is damaged or of another version."""
    if not path.is_file():
        raise CheckpointError(f"{path}: there is no checkpoint; start the run without resuming")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error
    if metadata.get("format") != "compgs checkpoint" or metadata.get("version") != CHECKPOINT_VERSION:
        raise CheckpointError(f"{path}: not a checkpoint of this version ({CHECKPOINT_VERSION}); train anew")
    config = config_from_dict(json.loads(metadata["config"]), str(path))
    scene = json.loads(metadata["scene"])
    parts: dict[str, dict[str, Tensor]] = {"model": {}, "optimizer": {}, "extra": {}}
    for name, value in tensors.items():
        kind, rest = name.split("/", 1)
        parts[kind][rest] = value
    model = TrainedModel(
        config,
        parts["model"]["coordinates"],
        scene["voxel_size"],
        scene["distance_unit"],
        tuple(scene["background"]),
    )
    model.load_state_dict(parts["model"])
    return Checkpoint(model, parts["optimizer"], parts["extra"], json.loads(metadata["state"]))


def optimizer_tensors(model: TrainedModel, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's moments by the names of their parameters."""
    names: dict[Tensor, str] = {p: name for name, p in model.named_parameters()}
    result = {}
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            result[f"{names[parameter]}/{key}"] = torch.as_tensor(value)
    return result


def restore_optimizer(
    model: TrainedModel, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]
) -> None:
    """Inverse of `optimizer_tensors`."""
    parameters = dict(model.named_parameters())
    for name, value in tensors.items():
        parameter, key = name.rsplit("/", 1)
        state = optimizer.state.setdefault(parameters[parameter], {})
        state[key] = value if key == "step" else value.to(parameters[parameter].device)
