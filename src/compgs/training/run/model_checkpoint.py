"""The model of the hybrid method in a checkpoint, and out of one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import Config
from compgs.scene.capture import check_camera
from compgs.scene.points import COORDINATE_BITS
from compgs.stored_weights import MOST_BITS
from compgs.trained_model import TrainedModel
from compgs.training.plan import Plan
from compgs.training.run.checkpoint import Checkpoint, read_checkpoint
from compgs.training.run.restoring import (
    check_moments,
    check_tensor,
    check_tensors,
    finite,
    restoring,
    whole_number,
)

METHOD = "compgs"


@dataclass(frozen=True)
class SavedRun:
    """A checkpoint, and the model that it holds."""

    model: TrainedModel
    saved: Checkpoint

    @property
    def state(self) -> dict[str, Any]:
        """What the run remembers, as JSON has it."""
        return self.saved.state


def load_checkpoint(path: Path, device: torch.device | None = None) -> SavedRun:
    """Read a checkpoint, to go on with it on a `device` if one is given.

    Raises CheckpointError if there is none, or it is damaged, of another version, method or kind of device.
    """
    saved = read_checkpoint(path, METHOD, Config, device)
    return SavedRun(model_of(path, saved), saved)


def model_of(path: Path, saved: Checkpoint) -> TrainedModel:
    """The model of the checkpoint at `path`. Raises CheckpointError if it is damaged."""
    with restoring(path):
        plan = Plan.from_dict(saved.described["plan"])
        model = _model(saved.config, plan, saved.described["scene"], saved.model)
        check_moments(saved.optimizer, dict(model.named_parameters()))
        return model


def described(model: TrainedModel, plan: Plan) -> dict[str, Any]:
    """What a checkpoint says of a model beside its tensors."""
    scene = {
        "voxel_size": model.voxel_size,
        "distance_unit": model.distance_unit,
        "background": list(model.background),
        "viewpoints": [_camera_entry(camera) for camera in model.viewpoints],
        "up": list(model.up),
        "angular_dilation": model.angular_dilation,
        "world_offset": list(model.world_offset),
        "head_bits": model.head_bits,
    }
    return {"scene": scene, "plan": plan.to_dict()}


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
