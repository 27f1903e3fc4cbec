"""The model that training starts from."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from compgs.cameras import Camera
from compgs.codec.format import LARGEST_DILATION, SMALLEST_DILATION
from compgs.config import MAX_VIEWPOINTS, Config, ModelConfig
from compgs.errors import ConfigError
from compgs.numerics.evenly import evenly
from compgs.progress import shown_count
from compgs.render.settings import as_angle
from compgs.scene.points import MIN_POINTS, colors_at, median_spacing, neighbour_distance, voxel_grid
from compgs.scene.viewpoints import choose_viewpoints, up_direction
from compgs.scene.views import Points, Scene
from compgs.scene.world import local_scene, world_offset
from compgs.stereo import dense_points, expected_points
from compgs.trained_model import TrainedModel
from compgs.training.plan import POINTS_APART, Plan, Start, grid_spacings, head_bits, lambda_for, plan
from compgs.training.run.distributed import world
from compgs.training.run.seen_points import sightings

CPU = torch.device("cpu")


def start_of(
    scene: Scene, config: Config, device: torch.device, anchors: int, *, points_at_hand: bool = False
) -> Start:
    """What is known of a run on a scene that begins with so many anchors, before points are looked for."""
    t, cameras = config.training, [view.camera for view in scene.train_views]
    start = Start(
        anchors=anchors,
        views=len(cameras),
        sightings=sightings(scene),
        passes=t.steps * t.views_per_step / max(1, len(cameras)),
        lmbda=t.lmbda,
        pixels=max((camera.width * camera.height for camera in cameras), default=0),
        device=device.type,
        processes=world(),
        poses_in_doubt=bool(scene.poses_in_doubt),
        points_at_hand=points_at_hand,
        findable=round(expected_points(scene, POINTS_APART)) if cameras else 0,
    )
    if t.target_bytes is None:
        return start
    return replace(start, lmbda=lambda_for(t.target_bytes / anchors, dense=start.dense))


def plan_for(
    scene: Scene, config: Config, device: torch.device, tiles: int = 1, *, points_at_hand: bool = False
) -> Plan:
    """What a run on a scene decides; of a capture in so many tiles, for all of their runs. Raises ConfigError."""
    here = local_scene(scene, world_offset(scene))
    anchors = len(anchor_grid(here, replace(config.model, voxel_spacings=grid_spacings(config)))[0])
    at_hand = points_at_hand or tiles > 1  # a tile's photographs show more than the tile
    start = start_of(scene, config, device, max(1, round(anchors / tiles)), points_at_hand=at_hand)
    return plan(config, start)


def plan_of(model: TrainedModel, scene: Scene, device: torch.device) -> Plan:
    """The plan that a model was made by; one that was made without goes by the rules for its scene."""
    if isinstance(model.plan, Plan):
        return model.plan
    return plan(model.config, start_of(scene, model.config, device, model.anchors))


def initial_model(
    scene: Scene,
    config: Config,
    device: torch.device = CPU,  # of the run: the plan depends on it
    planned: Plan | None = None,  # of the capture, of which the scene is a tile; None: made for this scene
) -> TrainedModel:
    """Anchors on the voxel grid of the scene's points (CompGS Sec. 3.4), as large as the distance to their neighbours.

    With `point_colors` they have the points' colors, too: from gray, hundreds of steps would go into finding them.
    A scene far from the world's origin gets a `world_offset`, from which its anchors are counted.
    Raises ConfigError if the voxel size that was asked for gives more than `max_anchors`.
    """
    spacings = grid_spacings(config) if planned is None else planned.voxel_spacings
    cameras = [view.camera for view in scene.train_views]
    offset = world_offset(scene)
    scene = local_scene(scene, offset)
    m = replace(config.model, voxel_spacings=spacings)
    coordinates, voxel_size = anchor_grid(scene, m)
    chosen = planned or plan(config, start_of(scene, config, device, len(coordinates)))
    if chosen.voxel_spacings != spacings:  # many anchors may ask for more
        m = replace(m, voxel_spacings=chosen.voxel_spacings)
        coordinates, voxel_size = anchor_grid(scene, m)
    if chosen.dense_points > 0:
        if scene.guessed:
            scene = with_seen_points(scene, chosen.dense_points, device)
            coordinates, voxel_size = anchor_grid(scene, m)
        room = m.max_anchors - len(coordinates)
        scene = with_dense_points(scene, chosen.dense_points, room, device)
        coordinates, _ = anchor_grid(scene, replace(m, voxel_size=voxel_size))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.training.seed)
        model = TrainedModel(
            config,
            torch.from_numpy(coordinates),
            voxel_size,
            scene.extent,
            scene.background,
            offset,
            chosen,
        )
    model.head_bits = head_bits(config, chosen.start, config.training.lmbda, model.anchors)
    with torch.no_grad():
        model.log_scales.copy_(
            torch.from_numpy(np.log(neighbour_distance(coordinates))).float()[:, None].expand(-1, 6)
        )
        model.entropy.fit_covariance_prior(model.log_scales)
        if m.point_colors:
            logits = torch.from_numpy(logit(colors_at(scene.points, model.positions().numpy()))).float()
            model.heads.pass_colors(logits.mean(0))
            model.references[:, :3] = (logits - logits.mean(0)) / config.entropy.steps.reference
    if cameras:
        model.viewpoints = tuple(cameras[i] for i in choose_viewpoints(cameras, MAX_VIEWPOINTS))
        model.up = up_direction(cameras)
        model.angular_dilation = angular_dilation(chosen.dilation, cameras)
    return model


def with_seen_points(scene: Scene, pixels: float, device: torch.device) -> Scene:
    """A scene with points every so many pixels of its photographs in place of random ones, which say little of where to
    look. A second search, from the points of this one, finds more. The scene itself where too little was found.
    """
    found = _looked_for(scene, pixels, device)
    return replace(scene, points=found, guessed=False) if len(found) >= MIN_POINTS else scene


def with_dense_points(scene: Scene, pixels: float, most: int, device: torch.device) -> Scene:
    """A scene with points every so many pixels of its photographs, also where structure from motion found none; so many
    more at most.
    """
    found = _looked_for(scene, pixels, device)
    kept = evenly(len(found), most)
    known = scene.points
    positions = np.concatenate([known.positions, found.positions[kept].astype(known.positions.dtype)])
    return replace(scene, points=Points(positions, np.concatenate([known.colors, found.colors[kept]])))


def _looked_for(scene: Scene, pixels: float, device: torch.device) -> Points:
    with shown_count(None, "looking for points, photographs") as progress:
        return dense_points(scene, pixels, device, progress)


def angular_dilation(pixels: float, cameras: Sequence[Camera]) -> float:
    """The dilation of pixels^2 of the training photographs as an angle, at which pictures of every size are drawn; as a
    file can hold it, float32.

    3DGS adds 0.3 pixels^2 to the variances of what it projects, whatever the size of the picture: twice as large,
    splats are too thin; half as large, too thick. A scene of ours keeps the angle of the pixels it was trained with.
    """
    angle = min(max(as_angle(pixels, cameras), SMALLEST_DILATION), LARGEST_DILATION)
    return float(np.float32(angle))


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
        coordinates, voxel_size = voxel_grid(scene.points, 1.25 * voxel_size)
    return coordinates, voxel_size


def logit(colors: np.ndarray) -> np.ndarray:
    """Return the logits of colors in 0 to 1; black and white have none, and what is nearly so would be far from
    everything else.
    """
    clipped = np.clip(colors, 0.05, 0.95)
    return np.log(clipped / (1.0 - clipped))
