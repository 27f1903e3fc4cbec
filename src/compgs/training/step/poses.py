"""Where each photograph was taken from, learned beside the scene: a small turn and shift of its camera.

    x seen by the camera = W (R (x - c) + c + t),    W and c: the given pose, and its center

Poses of a reconstruction may be off by a pixel, and a scene that is trained on them is blurred. Instead of the camera
the primitives are moved before they are drawn, so that every renderer gives the gradients. A turn is a quaternion of
(1, turn / 2) and a shift a vector, both along the axes of the world, in units of a pixel of a usual view.

No file holds them. After every step turns and shifts are zero in the mean over the photographs, and so is what would
make all cameras move apart: else the scene could turn, move and grow away from the poses that others know.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.scene.sight import depths_in
from compgs.scene.views import Scene
from compgs.tensors.prediction import camera_center
from compgs.training.step.learned_rows import LearnedRows


class Poses:
    """[V, 6]: turn and shift of each training view."""

    GRADIENTS = 1  # tensors of `gradients`

    def __init__(self, scene: Scene, device: torch.device, looks: float) -> None:
        """`looks`: how often a run looks at each view; with few looks, each has to move more."""
        cameras = [view.camera for view in scene.train_views]
        focal = float(np.median([camera.fx for camera in cameras]))
        turn, shift = 1.0 / focal, usual_depth(scene) / focal
        self.rows = LearnedRows("poses", len(cameras), [turn] * 3 + [shift] * 3, device, rates(looks))
        centers = np.stack([camera.center for camera in cameras])
        spread = torch.from_numpy(centers - centers.mean(axis=0)).float().to(device)
        self.spread = spread / spread.norm().clamp_min(1e-30)

    def moved(self, view: int, gaussians: Gaussians[Tensor], camera: Camera) -> Gaussians[Tensor]:
        """The Gaussians as the given camera of a view has to see them, for the image that its learned one takes."""
        return moved(gaussians, self.rows.of(view), camera)

    def camera(self, view: int, camera: Camera) -> Camera:
        """The given camera of a view at its learned pose."""
        turn, shift = self.rows.values()[view].double().cpu().numpy().reshape(2, 3)
        rotation = rotation_matrix(torch.from_numpy(turn)).numpy()
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = camera.center - rotation @ camera.center + shift
        return replace(camera, world_to_camera=camera.world_to_camera @ pose)

    def gradients(self, views: Sequence[int]) -> tuple[Tensor, ...]:
        """[V, 6], as `LearnedRows.gradients` has them."""
        return (self.rows.gradients(views),)

    def learn(self, progress: float, views: Sequence[int], gradients: Sequence[Tensor]) -> None:
        """Learn from `gradients`, summed over the ranks; `progress` of the run, 0 to 1."""
        self.rows.learn(progress, views, gradients[0])
        self.hold_means()

    @torch.no_grad()
    def hold_means(self) -> None:
        """All together the cameras neither turn nor move, nor move apart."""
        numbers = self.rows.numbers
        numbers -= numbers.mean(0)
        shift = numbers[:, 3:]
        shift -= self.spread * (self.spread * shift).sum()

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds."""
        return self.rows.tensors()

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`. Raises ValueError, KeyError for what is none."""
        self.rows.restore(tensors)


def rates(looks: float) -> tuple[float, float]:
    """Pixels a step on a view, first and last of a run that looks at each view so often: at the first rate, all these
    looks together would move it by six pixels.
    """
    first = min(0.3, max(0.05, 6.0 / max(looks, 1.0)))
    return first, 0.1 * first


def moved(gaussians: Gaussians[Tensor], offset: Tensor, camera: Camera) -> Gaussians[Tensor]:
    """Gaussians turned about the camera's center and shifted, by an offset [6] along the axes of the world."""
    turn, shift = offset.split(3)
    center = camera_center(camera, gaussians.means.device, gaussians.means.dtype)
    means = (gaussians.means - center) @ rotation_matrix(turn).T + (center + shift)
    return replace(gaussians, means=means, quaternions=turned(gaussians.quaternions, turn))


def rotation_matrix(turn: Tensor) -> Tensor:
    """[3, 3] of the quaternion (1, turn / 2): by the length of the turn in radians, as long as that is small."""
    x, y, z = turn / 2
    zero = torch.zeros_like(x)
    across = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    square = x * x + y * y + z * z
    identity = torch.eye(3, dtype=turn.dtype, device=turn.device)
    return identity + 2.0 / (1.0 + square) * (across + across @ across)


def turned(quaternions: Tensor, turn: Tensor) -> Tensor:
    """[M, 4] w-x-y-z quaternions after the turn [3]; of another length, which means nothing."""
    half = turn / 2
    w, rest = quaternions[:, :1], quaternions[:, 1:]
    return torch.cat(
        [w - rest @ half[:, None], rest + w * half + torch.linalg.cross(half.expand_as(rest), rest)], 1
    )


def usual_depth(scene: Scene) -> float:
    """World units: the median distance of the points that a camera shows, along its axis, over some 16 cameras."""
    views = scene.train_views[:: max(1, len(scene.train_views) // 16)]
    medians = []
    for view in views:
        depth, inside = depths_in(view.camera, np.asarray(scene.points.positions, dtype=np.float64))
        if inside.any():
            medians.append(float(np.median(depth[inside])))
    return float(np.median(medians)) if medians else scene.extent
