"""Anchors with view-dependent networks, as they are trained."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from compgs.config import Config
from compgs.methods.anchors.networks import ViewNetworks
from compgs.methods.anchors.prediction import AnchorValues
from compgs.published.anchors import AnchorScene, Frame
from compgs.scene.points import neighbour_distance
from compgs.scene.views import Scene
from compgs.scene.world import local_scene, world_offset
from compgs.training.start import anchor_grid

SIZES = 3  # log scales of the Gaussians; those of the positions stand before them


class AnchorModel(nn.Module):
    """N anchors on a voxel grid with K offsets each; an anchor is at coordinates * voxel_size in the local frame.

    Log scales are natural logarithms, relative to the voxel size. Control adds and removes rows.
    """

    coordinates: Tensor  # [N, 3] int32, voxels
    mask: Tensor  # [N, K] bool: coupled primitives that exist

    position_scales = 3  # an anchor's: 3 (Scaffold-GS), or 1 for all axes

    def __init__(self, config: Config, coordinates: Tensor, frame: Frame) -> None:
        super().__init__()
        m, n = config.model, len(coordinates)
        self.config = config
        self.frame = frame
        self.networks = ViewNetworks(m.reference_dim, m.coupled_primitives, m.width)
        self.register_buffer("coordinates", coordinates.to(torch.int32))
        self.register_buffer("mask", torch.ones(n, m.coupled_primitives, dtype=torch.bool))
        self.features = nn.Parameter(torch.zeros(n, m.reference_dim))
        self.offsets = nn.Parameter(torch.zeros(n, 3 * m.coupled_primitives))
        self.log_scales = nn.Parameter(torch.zeros(n, self.position_scales + SIZES))

    @property
    def anchors(self) -> int:
        return len(self.coordinates)

    @property
    def voxel_size(self) -> float:
        """World units."""
        return self.frame.voxel_size

    @property
    def device(self) -> torch.device:
        return self.features.device

    @property
    def anchor_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that have a row for each anchor."""
        return "features", "offsets", "log_scales"

    @property
    def references(self) -> Tensor:
        """[N, F] what new anchors inherit: the features."""
        return self.features

    def grown(self, coordinates: Tensor, references: Tensor, log_scale: Tensor) -> dict[str, Tensor]:
        """Rows of new anchors by name: at coordinates [A, 3] int32, with features [A, F] and log scales [A]."""
        new = len(coordinates)
        return {
            "coordinates": coordinates,
            "features": references,
            "offsets": self.offsets.new_zeros(new, self.offsets.shape[1]),
            "log_scales": log_scale[:, None].repeat(1, self.log_scales.shape[1]),
            "mask": self.mask.new_ones(new, self.mask.shape[1]),
        }

    def positions(self) -> Tensor:
        """[N, 3] float32 world units in the local frame."""
        return self.coordinates.to(torch.float32) * self.voxel_size

    def values(self) -> AnchorValues:
        """Return the values as they are, unquantized."""
        return AnchorValues(
            self.positions(),
            self.features,
            self.offsets.view(self.anchors, -1, 3),
            self.log_scales[:, : self.position_scales],
            self.log_scales[:, self.position_scales :],
        )

    @torch.no_grad()
    def as_hybrid_model(self) -> AnchorScene:
        """Return a copy of the model as it is now, to be rendered."""
        v = self.values()

        def array(tensor: Tensor) -> np.ndarray:
            return np.array(tensor.cpu().numpy())

        return AnchorScene(
            self.frame,
            array(v.positions),
            array(v.features),
            array(v.offsets),
            array(v.position_scales),
            array(v.sizes),
            array(self.mask),
            {name: array(w) for name, w in self.networks.weights().items()},
        )


def initial_anchors(kind: type[AnchorModel], scene: Scene, config: Config) -> AnchorModel:
    """Anchors on the voxel grid of the scene's points, as large as the distance to their neighbours.

    A scene far from the world's origin gets a `world_offset`, from which its anchors are counted. Raises ConfigError.
    """
    offset = world_offset(scene)
    scene = local_scene(scene, offset)
    coordinates, voxel_size = anchor_grid(scene, config.model)
    frame = Frame(voxel_size, scene.extent, scene.background, offset)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.training.seed)
        model = kind(config, torch.from_numpy(coordinates), frame)
    with torch.no_grad():
        model.log_scales.copy_(torch.from_numpy(np.log(neighbour_distance(coordinates))).float()[:, None])
    return model


def control_settings(config: Config) -> Config:
    """Return settings for `AdaptiveControl` with which nothing is pruned or weighed by a rate."""
    return replace(config, training=replace(config.training, rules="none"))
