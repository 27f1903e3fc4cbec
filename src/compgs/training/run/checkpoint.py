"""Checkpoints: everything that a run needs to go on as if it had never stopped, in one safetensors file.

Tensors by name; settings, counters and the view order as JSON in the file's metadata. Written atomically.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from compgs.config import Config, config_from_dict
from compgs.errors import CheckpointError, OutputError
from compgs.outputs import replacing
from compgs.scene.views import Scene
from compgs.training.run.restoring import check_step, restoring

CHECKPOINT_NAME = "checkpoint.safetensors"
CHECKPOINT_VERSION = "12"
STAMP = ("format", "version", "method", "device")  # what every checkpoint says of itself


@dataclass(frozen=True)
class Checkpoint:
    """State of a run between two steps, of whatever kind."""

    config: Config
    model: dict[str, Tensor]  # what is trained
    optimizer: dict[str, Tensor]  # "<parameter name>/<moment>"
    extra: dict[str, Tensor]  # control statistics, random generators
    state: dict[str, Any]  # step, view order, ... (JSON)
    described: dict[str, Any] = field(default_factory=dict)  # what else is to be known of the model (JSON)


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


def write_checkpoint(
    path: Path, method: str, checkpoint: Checkpoint, writer: Writer | None = None, *, device: torch.device
) -> None:
    """Write the checkpoint of a method's run on a device; a previous one stays as it was until then. With a `writer`
    that happens later, and what is saved may change meanwhile. Raises OutputError if the file cannot be written.
    """
    tensors = {f"model/{name}": value for name, value in checkpoint.model.items()}
    tensors |= {f"optimizer/{name}": value for name, value in checkpoint.optimizer.items()}
    tensors |= {f"extra/{name}": value for name, value in checkpoint.extra.items()}
    told = {"config": checkpoint.config.to_dict(), **checkpoint.described, "state": checkpoint.state}
    metadata = {name: json.dumps(value) for name, value in told.items()}
    write_checkpoint_file(path, method, tensors, metadata, writer, device=device)


def read_checkpoint(
    path: Path, method: str, kind: type[Config], device: torch.device | None = None
) -> Checkpoint:
    """Inverse of `write_checkpoint`, to go on with it on a `device` if one is given; `kind` of settings.

    Raises CheckpointError if there is none, or it is damaged, of another version, method or kind of device.
    """
    tensors, metadata = read_checkpoint_file(path, method, device)
    with restoring(path):
        told = {name: json.loads(value) for name, value in metadata.items() if name not in STAMP}
        config = config_from_dict(told.pop("config"), str(path), kind)
        state = told.pop("state")
        check_step(state, config.training.steps)
        parts = tensors_by_kind(tensors)
        return Checkpoint(config, parts["model"], parts["optimizer"], parts["extra"], state, told)


def checkpoint_of(path: Path, method: str, config: Config, scene: Scene, device: torch.device) -> Checkpoint:
    """Read the checkpoint of a run with these settings on this scene. Raises CheckpointError, also where it is another
    run's.
    """
    saved = read_checkpoint(path, method, type(config), device)
    with restoring(path):
        check_same_run(saved.config, config, saved.state["views"], scene)
    return saved


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
    `write_checkpoint`.
    """
    stamp = dict(zip(STAMP, ("compgs checkpoint", CHECKPOINT_VERSION, method, device.type), strict=True))
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


def read_checkpoint_file(
    path: Path, method: str, device: torch.device | None = None
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Inverse of `write_checkpoint_file`. Raises CheckpointError, as `read_checkpoint`."""
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
