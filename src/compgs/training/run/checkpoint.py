"""Checkpoints: everything that a run needs to go on as if it had never stopped, in one safetensors file.

Tensors by name; settings, counters and the view order as JSON in the file's metadata. Written atomically.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config, config_from_dict
from compgs.errors import CheckpointError, OutputError
from compgs.outputs import replacing
from compgs.scene.capture import check_camera
from compgs.scene.points import COORDINATE_BITS
from compgs.scene.views import Scene
from compgs.stored_weights import MOST_BITS
from compgs.trained_model import TrainedModel
from compgs.training.plan import Plan
from compgs.training.run.restoring import (
    check_moments,
    check_step,
    check_tensor,
    check_tensors,
    finite,
    restoring,
    whole_number,
)

CHECKPOINT_NAME = "checkpoint.safetensors"
CHECKPOINT_VERSION = "11"


@dataclass(frozen=True)
class Checkpoint:
    """State of a run between two steps."""

    model: TrainedModel
    plan: Plan
    optimizer: dict[str, Tensor]  # "<parameter name>/<moment>"
    extra: dict[str, Tensor]  # control statistics, random generators
    state: dict[str, Any]  # step, view order, ... (JSON)


class Writer:
    """Writes a checkpoint in a thread beside the steps of a run, one at a time, from a copy of its tensors.

    To copy the half gigabyte of a million anchors takes a tenth of the time that a disk takes to write it.
    """

    def __init__(self) -> None:
        self._thread: Thread | None = None
        self._error: BaseException | None = None

    @property
    def busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def begin(self, write: Callable[[], None]) -> None:
        """Once the last one is written. Raises what it raised."""
        self.finish()
        # Not a daemon: the end of the process waits until the file is whole.
        self._thread = Thread(target=self._attempt, args=(write,), name="compgs-checkpoint")
        self._thread.start()

    def finish(self) -> None:
        """Wait until it is written. Raises OutputError if it could not be."""
        if self._thread is not None:
            self._thread.join()
        self.check()

    def check(self) -> None:
        """Raises OutputError if the last one could not be written."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _attempt(self, write: Callable[[], None]) -> None:
        try:
            write()
        except BaseException as error:
            self._error = error


def save_checkpoint(path: Path, checkpoint: Checkpoint, writer: Writer | None = None) -> None:
    """Raises OutputError if the file cannot be written; a previous checkpoint then stays as it was. With a `writer`
    that happens later, and what is saved may change meanwhile.
    """
    model = checkpoint.model
    tensors = {f"model/{k}": v for k, v in model.state_dict().items()}
    tensors |= {f"optimizer/{k}": v for k, v in checkpoint.optimizer.items()}
    tensors |= {f"extra/{k}": v for k, v in checkpoint.extra.items()}
    metadata = {
        "config": json.dumps(model.config.to_dict()),
        "scene": json.dumps(
            {
                "voxel_size": model.voxel_size,
                "distance_unit": model.distance_unit,
                "background": list(model.background),
                "viewpoints": [_camera_entry(camera) for camera in model.viewpoints],
                "up": list(model.up),
                "angular_dilation": model.angular_dilation,
                "world_offset": list(model.world_offset),
                "head_bits": model.head_bits,
            }
        ),
        "plan": json.dumps(checkpoint.plan.to_dict()),
        "state": json.dumps(checkpoint.state),
    }
    write_checkpoint_file(path, "compgs", tensors, metadata, writer, device=model.device)


def write_checkpoint_file(
    path: Path,
    method: str,
    tensors: dict[str, Tensor],
    metadata: dict[str, str],
    writer: Writer | None = None,
    *,
    device: torch.device,
) -> None:
    """Tensors by name and JSON texts by name, of a method's run on a device. Raises OutputError; see
    `save_checkpoint`.
    """
    stamp = {"format": "compgs checkpoint", "version": CHECKPOINT_VERSION, "method": method}
    stamp["device"] = device.type
    copy = writer is not None
    content = {k: v.detach().to("cpu", copy=copy).contiguous() for k, v in tensors.items()}
    write = partial(_write, path, content, metadata | stamp)
    if writer is None:
        write()
    else:
        writer.begin(write)


def _write(path: Path, content: dict[str, Tensor], metadata: dict[str, str]) -> None:
    try:
        with replacing(path) as temporary:
            safetensors.torch.save_file(content, temporary, metadata=metadata)
    except (OSError, safetensors.SafetensorError) as error:
        raise OutputError(f"{path}: the checkpoint cannot be written ({error})") from error


def load_checkpoint(path: Path, device: torch.device | None = None) -> Checkpoint:
    """Read a checkpoint, to go on with it on a `device` if one is given.

    Raises CheckpointError if there is none, or it is damaged, of another version, method or kind of device.
    """
    tensors, metadata = read_checkpoint_file(path, "compgs", device)
    with restoring(path):
        config = config_from_dict(json.loads(metadata["config"]), str(path))
        parts = tensors_by_kind(tensors)
        plan = Plan.from_dict(json.loads(metadata["plan"]))
        model = _model(config, plan, json.loads(metadata["scene"]), parts["model"])
        check_moments(parts["optimizer"], dict(model.named_parameters()))
        state = json.loads(metadata["state"])
        check_step(state, config.training.steps)
        return Checkpoint(model, plan, parts["optimizer"], parts["extra"], state)


def _model(config: Config, plan: Plan, scene: dict[str, Any], tensors: dict[str, Tensor]) -> TrainedModel:
    """Raises ValueError and the like for what does not belong together."""
    coordinates, references = tensors["coordinates"], tensors["references"]
    anchors = len(coordinates)
    check_tensor(coordinates, (anchors, 3), torch.int32, "coordinates")
    if anchors == 0 or coordinates.abs().max() >= 1 << (COORDINATE_BITS - 1):
        raise ValueError(f"{anchors} anchors, expected some, at coordinates of {COORDINATE_BITS} bits")
    # Of as many anchors as there are coordinates, before as much memory is taken.
    for name, columns in (("log_scales", 6), ("mask", plan.coupled_primitives)):
        if tensors[name].shape != (anchors, columns):
            raise ValueError(f"{name}: expected {[anchors, columns]}, found {list(tensors[name].shape)}")
    if references.shape != (anchors, references.shape[-1]) or not (
        1 <= references.shape[1] <= config.model.reference_dim
    ):
        raise ValueError(f"references: {list(references.shape)} of {anchors} anchors")
    (voxel_size, distance_unit) = finite([scene["voxel_size"], scene["distance_unit"]], 2, "units", above=0.0)
    red, green, blue = finite(scene["background"], 3, "background")
    x, y, z = finite(scene["world_offset"], 3, "world_offset")
    model = TrainedModel(
        config,
        coordinates,
        voxel_size,
        distance_unit,
        (red, green, blue),
        (x, y, z),
        plan,
        references.shape[1],
    )
    if scene["angular_dilation"] is not None:
        (model.angular_dilation,) = finite([scene["angular_dilation"]], 1, "angular_dilation", above=0.0)
    model.head_bits = whole_number(scene["head_bits"], 1, MOST_BITS, "head_bits")
    model.viewpoints = tuple(_camera(entry) for entry in scene["viewpoints"])
    up_x, up_y, up_z = finite(scene["up"], 3, "up")
    model.up = (up_x, up_y, up_z)
    check_tensors(tensors, model.state_dict(), "model")
    model.load_state_dict(tensors)
    return model


def _camera_entry(camera: Camera) -> dict[str, Any]:
    return {**vars(camera), "world_to_camera": np.asarray(camera.world_to_camera, np.float64).tolist()}


def _camera(entry: dict[str, Any]) -> Camera:
    camera = Camera(**{**entry, "world_to_camera": np.array(entry["world_to_camera"], np.float64)})
    if camera.world_to_camera.shape != (4, 4):
        raise ValueError(f"a camera's pose of {list(camera.world_to_camera.shape)} numbers, expected 4 x 4")
    check_camera(camera, "a camera that the file would keep")
    return camera


def read_checkpoint_file(
    path: Path, method: str, device: torch.device | None = None
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Inverse of `write_checkpoint_file`. Raises CheckpointError, as `load_checkpoint`."""
    if not path.is_file():
        raise CheckpointError(f"{path}: there is no checkpoint; start the run without resuming")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            # Copies: on Windows a file that is mapped could not be replaced by the run's next checkpoint.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    # (the last three: of tensors that the header describes in a way that torch cannot have)
    except (OSError, safetensors.SafetensorError, ValueError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error
    if metadata.get("format") != "compgs checkpoint" or metadata.get("version") != CHECKPOINT_VERSION:
        raise CheckpointError(f"{path}: not a checkpoint of this version ({CHECKPOINT_VERSION}); train anew")
    found = metadata.get("method", "compgs")
    if found != method:
        raise CheckpointError(f"{path}: a run of method {found}, expected one of method {method}")
    began = metadata.get("device", "")
    if device is not None and device.type != began:
        raise CheckpointError(
            f"{path}: the run began on {began}, whose random numbers {device.type} does not have; continue it with "
            f"--device {began} (in Python device={began!r}), or train anew"
        )
    return tensors, metadata


def tensors_by_kind(tensors: dict[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """`model/...`, `optimizer/...` and `extra/...`, each without the first part of the name."""
    parts: dict[str, dict[str, Tensor]] = {"model": {}, "optimizer": {}, "extra": {}}
    for name, value in tensors.items():
        kind, _, rest = name.partition("/")
        parts[kind][rest] = value
    return parts


def check_same_run(saved: Config, config: Config, saved_views: list[str], scene: Scene) -> None:
    """Raises CheckpointError, naming what differs, if a checkpoint is of other settings or another scene."""
    if saved != config:
        now = config.to_dict()
        differing = [
            f"{section}.{key}: {value!r} then, {now[section][key]!r} now"
            for section, values in saved.to_dict().items()
            for key, value in values.items()
            if now[section][key] != value
        ]
        raise CheckpointError(f"the run to continue had other settings ({'; '.join(differing)})")
    if saved_views != [view.name for view in scene.train_views]:
        raise CheckpointError("the run to continue was trained on other views; give the same scene")


def optimizer_tensors(
    parameters: Mapping[str, Tensor], optimizer: torch.optim.Optimizer
) -> dict[str, Tensor]:
    """Adam's moments by the names of their parameters."""
    names = {parameter: name for name, parameter in parameters.items()}
    result = {}
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            result[f"{names[parameter]}/{key}"] = torch.as_tensor(value)
    return result


def restore_optimizer(
    parameters: Mapping[str, Tensor], optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]
) -> None:
    """Inverse of `optimizer_tensors`."""
    for name, value in tensors.items():
        parameter, key = name.rsplit("/", 1)
        state = optimizer.state.setdefault(parameters[parameter], {})
        state[key] = value.to(parameters[parameter].device)  # (fused Adam has its step there, too)
