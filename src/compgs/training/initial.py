"""The model that training starts from."""

from dataclasses import replace

import numpy as np
import torch

from compgs.config import MAX_VIEWPOINTS, Config, ModelConfig
from compgs.errors import ConfigError
from compgs.numerics.nearest import nearest
from compgs.scene.points import colors_at, median_spacing, voxel_grid
from compgs.scene.viewpoints import choose_viewpoints, up_direction
from compgs.scene.views import Scene
from compgs.scene.world import local_scene, world_offset
from compgs.trained_model import TrainedModel
from compgs.training.dilation import angular_dilation, dilation
from compgs.training.grid import grid_spacings
from compgs.training.network_size import head_bits, head_layout, hidden_width, reference_context
from compgs.training.own_residuals import coupled_primitives, own_residuals

COARSER = 1.25  # voxels, from one try to the next, until there are no more anchors than allowed


def initial_model(scene: Scene, config: Config) -> TrainedModel:
    """Anchors on the voxel grid of the scene's points (CompGS Sec. 3.4), as large as the distance to their neighbours.

    With `point_colors` they have the points' colors, too: from gray, hundreds of steps would go into finding them.
    A scene far from the world's origin gets a `world_offset`, from which its anchors are counted.
    Raises ConfigError if the voxel size that was asked for gives more than `max_anchors`.
    """
    m = replace(config.model, voxel_spacings=grid_spacings(config))
    cameras = [view.camera for view in scene.train_views]
    offset = world_offset(scene)
    scene = local_scene(scene, offset)
    coordinates, voxel_size = anchor_grid(scene, m)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.training.seed)
        model = TrainedModel(
            config,
            torch.from_numpy(coordinates),
            voxel_size,
            scene.extent,
            scene.background,
            offset,
            made_for(config, len(coordinates), len(cameras)),
        )
    model.head_bits = head_bits(config, config.training.lmbda, model.anchors)
    with torch.no_grad():
        model.log_scales.copy_(
            torch.from_numpy(np.log(anchor_spacing(coordinates))).float()[:, None].expand(-1, 6)
        )
        model.entropy.fit_covariance_prior(model.log_scales)
        if m.point_colors:
            logits = torch.from_numpy(logit(colors_at(scene.points, model.positions().numpy()))).float()
            model.heads.pass_colors(logits.mean(0))
            model.references[:, :3] = (logits - logits.mean(0)) / config.entropy.reference_step
    if cameras:
        model.viewpoints = tuple(cameras[i] for i in choose_viewpoints(cameras, MAX_VIEWPOINTS))
        model.up = up_direction(cameras)
        pixels = dilation(config, len(coordinates), len(cameras))
        model.angular_dilation = angular_dilation(pixels, cameras)
    return model


def made_for(config: Config, anchors: int, views: int) -> ModelConfig:
    """The model of a run that starts with so many anchors, of what the settings leave to training."""
    return replace(
        config.model,
        coupled_primitives=coupled_primitives(config, anchors, views),
        width=hidden_width(config, anchors),
        reference_context=reference_context(config, anchors),
        heads=head_layout(config, anchors, views),
        residuals=own_residuals(config, anchors, views),
    )


def anchor_grid(scene: Scene, m: ModelConfig) -> tuple[np.ndarray, float]:
    """[N, 3] int32 voxels that the scene's points fill, and the voxels' size in world units.

    Raises ConfigError if the voxel size that was asked for gives more than `max_anchors`.
    """
    wanted = m.voxel_size or m.voxel_spacings * median_spacing(scene.points.positions)
    coordinates, voxel_size = voxel_grid(scene.points, wanted)
    if m.voxel_size and len(coordinates) > m.max_anchors:
        raise ConfigError(
            f"model.voxel_size = {m.voxel_size}: the scene's points fill {len(coordinates)} voxels, "
            f"model.max_anchors is {m.max_anchors}; use a larger voxel, or allow more anchors"
        )
    while len(coordinates) > m.max_anchors:  # ends: at last all points are in one voxel
        coordinates, voxel_size = voxel_grid(scene.points, COARSER * voxel_size)
    return coordinates, voxel_size


def anchor_spacing(coordinates: np.ndarray) -> np.ndarray:
    """[N] voxels: how far an anchor's neighbours are from it, the root of the mean square of three distances."""
    neighbours = min(4, len(coordinates))
    distances, _ = nearest(coordinates, coordinates, neighbours)
    spread = np.sqrt((distances[:, 1:] ** 2).mean(1)) if neighbours > 1 else np.ones(1)
    return np.maximum(spread, 0.1)


def logit(colors: np.ndarray) -> np.ndarray:
    """Of colors in 0 to 1; black and white have none, and what is nearly so would be far from everything else."""
    clipped = np.clip(colors, 0.05, 0.95)
    return np.log(clipped / (1.0 - clipped))
