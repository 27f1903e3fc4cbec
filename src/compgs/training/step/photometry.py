"""What each photograph's camera made of the scene's colors, learned beside the scene (after PPISP, CVPR 2026).

    photograph = response(M (v rendering))

| part | of each | numbers |
|---|---|---|
| v, vignetting: 1 + a1 r^2 + a2 r^4 + a3 r^6, r = 1 in the corners | lens | 3 a color, none above 0 |
| M = 2^e (1 + A), exposure e and a matrix A of trace 0 | photograph | 1 + 8 |
| response: x + x (1 - x) (bend + contrast (2 x - 1)) | lens | 2 a color |

Where cameras chose exposure and white balance by themselves, photographs contradict one another. A scene without these
numbers becomes foggy patches that repair each view. No file holds them: it has the colors between all photographs.
After every step exposure and matrix are zero in the mean over the photographs, and so is the response; else all of
them could brighten together while the scene darkens. So a single lens has no response: the scene's colors have it.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.scene.views import Scene, View
from compgs.training.step.learned_rows import LearnedRows
from compgs.training.step.photometry_start import starting_gains

# A photograph's numbers: stops; red and blue of the diagonal, of which green takes what makes the trace 0; the matrix
# beside its diagonal, row by row. A lens's: a1, a2, a3, bend and contrast of each color.
OF_PHOTOGRAPH, OF_LENS = (1, 2, 6), (9, 6)


class Photometry:
    """Exposure and color of each photograph, vignetting and response of each lens."""

    GRADIENTS = 2  # tensors of `gradients`

    def __init__(self, scene: Scene, device: torch.device, own: Sequence[int] | None = None) -> None:
        """`own`: the views whose photographs this rank reads; None: all."""
        views = scene.train_views
        self.cameras = [view.camera for view in views]
        self.lens_of = lenses(views)
        count = max(self.lens_of) + 1
        self.weights = torch.bincount(torch.tensor(self.lens_of), minlength=count).to(device) / len(views)
        # A step moves an exposure by a tenth of a stop at first; colors mix less than they are scaled. What a
        # photograph does not show well stays near the others.
        self.photographs = LearnedRows(
            "photometry/photographs",
            len(views),
            [1.0] * 3 + [0.2] * 6,
            device,
            learning_rates=(0.1, 0.002),
            penalty=0.001,
        )
        # A lens is looked at far more often. Where corners show nothing, nothing else would hold the vignetting.
        self.lenses = LearnedRows(
            "photometry/lenses", count, [1.0] * 15, device, learning_rates=(0.005, 0.0005), penalty=0.1
        )
        gains = starting_gains(scene, own)
        if gains is not None:
            self.photographs.numbers[:, :3] = torch.from_numpy(numbers_of(gains)).float().to(device)
        self.hold_means()
        self._radii: dict[tuple[int, int, int], Tensor] = {}

    def taken(self, view: int) -> Callable[[Tensor], Tensor]:
        """Return what the camera of a photograph makes of a rendering [H, W, 3] of any size."""
        photograph, lens = self.photographs.of(view), self.lenses.of(self.lens_of[view])

        def camera(rendering: Tensor) -> Tensor:
            vignetting, curve = lens.split(OF_LENS)
            light = rendering * falloff(vignetting, self._radius(view, rendering))
            return response(light @ color_matrix(photograph).T, curve)

        return camera

    def gradients(self, views: Sequence[int]) -> tuple[Tensor, ...]:
        """Return those of the photographs [V, 9], and of all lenses [L, 15]."""
        return self.photographs.gradients(views), self.lenses.gradients(range(len(self.weights)))

    def learn(self, progress: float, views: Sequence[int], gradients: Sequence[Tensor]) -> None:
        """Learn from `gradients`, summed over the ranks; `progress` of the run, 0 to 1."""
        self.photographs.learn(progress, views, gradients[0])
        self.lenses.learn(progress, range(len(self.weights)), gradients[1])
        self.hold_means()

    @torch.no_grad()
    def hold_means(self) -> None:
        """Only the scene says how bright and how colored everything is, and no lens brightens its corners."""
        self.photographs.numbers -= self.photographs.numbers.mean(0)
        vignetting, curve = self.lenses.numbers.split(OF_LENS, 1)
        curve -= self.weights @ curve
        vignetting.clamp_(max=0.0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds."""
        return self.photographs.tensors() | self.lenses.tensors()

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`. Raises ValueError, KeyError for what is none."""
        self.photographs.restore(tensors)
        self.lenses.restore(tensors)

    def _radius(self, view: int, image: Tensor) -> Tensor:
        """[H, W, 1] squared distance from the middle of a view's image; kept for each lens and size."""
        height, width = image.shape[:2]
        key = (self.lens_of[view], height, width)
        if key not in self._radii:
            found = squared_radius(self.cameras[view], height, width)
            self._radii[key] = torch.from_numpy(found).to(image)
        return self._radii[key]


# the equations ---------------------------------------------------------------------------------


def color_matrix(photograph: Tensor) -> Tensor:
    """[9] numbers of a photograph -> [3, 3] of its exposure and color."""
    exposure, (red, blue), mixed = photograph.split(OF_PHOTOGRAPH)
    rows = [red, mixed[0], mixed[1], mixed[2], -red - blue, mixed[3], mixed[4], mixed[5], blue]
    matrix = torch.stack(rows).view(3, 3) + torch.eye(3, dtype=photograph.dtype, device=photograph.device)
    return torch.exp2(exposure) * matrix


def falloff(numbers: Tensor, radius: Tensor) -> Tensor:
    """[9] numbers of a lens and squared radii [H, W, 1] -> [H, W, 3], 1 in the middle."""
    a1, a2, a3 = numbers.view(3, 3)
    return 1.0 + radius * (a1 + radius * (a2 + radius * a3))


def response(colors: Tensor, numbers: Tensor) -> Tensor:
    """[..., 3] colors and [6] numbers of a lens -> [..., 3]; black and white stay, and what is beyond them."""
    bend, contrast = numbers.view(2, 3)
    within = colors.clamp(0.0, 1.0)
    return colors + within * (1.0 - within) * (bend + contrast * (2.0 * within - 1.0))


def squared_radius(camera: Camera, height: int, width: int) -> np.ndarray:
    """[H, W, 1] float32: squared distance from the principal point, 1 at half a diagonal."""
    across = (np.arange(width) + 0.5) * (camera.width / width) - camera.cx
    down = (np.arange(height) + 0.5) * (camera.height / height) - camera.cy
    squares = across[None, :] ** 2 + down[:, None] ** 2
    return (squares / ((camera.width**2 + camera.height**2) / 4))[..., None].astype(np.float32)


def numbers_of(gains: np.ndarray) -> np.ndarray:
    """[V, 3] gains of the colors, log2 -> [V, 3]: stops, and red and blue of the matrix's diagonal."""
    factors = 2.0**gains
    means = factors.mean(axis=1, keepdims=True)
    return np.concatenate([np.log2(means), (factors / means - 1.0)[:, [0, 2]]], axis=1)


def lenses(views: Sequence[View]) -> list[int]:
    """Number the lens of each view, from 0: views of equal cameras share one.

    Where hardly any cameras are equal, as some programs give each photograph one of its own, views of one size do.
    """
    keys: list[tuple[float, ...]] = [
        (c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (view.camera for view in views)
    ]
    if len(keys) < 3 * len(Counter(keys)):
        keys = [key[:2] for key in keys]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return [numbers[key] for key in keys]
