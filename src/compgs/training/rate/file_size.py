"""How large the file of a model would be, without writing it."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from compgs.codec.encoder import encoded
from compgs.codec.mask_coder import encode_masks
from compgs.codec.octree import encode_positions
from compgs.codec.viewpoint_cameras import kept_viewpoints
from compgs.entropy.network import FRACTION_BITS
from compgs.entropy.quantization import in_stored_steps
from compgs.ordering.order import canonical_order
from compgs.trained_model import TrainedModel

OTHER_BYTES = 350  # scene, tables, metadata, container, about


class FileSize:
    """Bytes of a model in training. Remembers what the positions take while anchors stay the same."""

    def __init__(self, model: TrainedModel) -> None:
        self.model = model
        self._coordinates: Tensor | None = None
        self._positions = 0

    def latents(self, mask: Tensor | None = None) -> float:
        """Bytes of latents, positions and masks, if the coupled primitives of `mask` [N, K] bool existed (default:
        those that do); not finite if the latents are not.
        """
        mask = self.model.mask if mask is None else mask
        return sum(self.model.estimated_bits(mask).values()) / 8 + self._geometry(mask)

    def written_share(self) -> float:
        """Return the share of these bytes that a file takes as it would be written now: its rows say more of themselves
        than training pays for (`codec/rows.py`).
        """
        return max(1.0, len(encoded(self.model)[0]) - fixed_bytes(self.model)) / max(1.0, self.latents())

    def _geometry(self, mask: Tensor) -> int:
        """Bytes of positions and masks."""
        if not mask.all():
            return geometry_bytes(self.model.coordinates, mask)
        if self._coordinates is not self.model.coordinates:
            self._coordinates, self._positions = (
                self.model.coordinates,
                geometry_bytes(self.model.coordinates, mask),
            )
        return self._positions


def geometry_bytes(
    coordinates: Tensor,  # [N, 3] int32
    mask: Tensor,  # [N, K] bool; anchors without any are left out
) -> int:
    """Bytes of positions and masks, by their coders."""
    kept = mask.any(1)
    places, exist = coordinates[kept].cpu().numpy(), mask[kept].cpu().numpy()
    if len(places) == 0:
        return 0
    masks = 0 if exist.all() else len(encode_masks(np.ascontiguousarray(exist[canonical_order(places)])))
    return len(encode_positions(places)) + masks


def anchor_bits(model: TrainedModel) -> Tensor:
    """[N] bits of each anchor's latents and position as training pays for them, all anchors being coded."""
    bits = model.bits_of_anchors(in_file=False)
    return torch.stack(list(bits.values())).sum(0) + 10.0  # about what an anchor less saves of the positions


@torch.no_grad()
def fixed_bytes(model: TrainedModel) -> int:
    """Bytes of the networks and of all else that does not grow with the scene; no lambda makes them fewer."""
    stored, coded = model.weights, []
    for name, tensor in model.head_tensors().items():
        coded.append(in_stored_steps(tensor, stored.bits(name, tensor)))
    for network in model.entropy.coded_networks:
        for weight, bias in network.layers():
            # In halves, as the file has them: means and scales differ in spread.
            coded += in_stored_steps(weight, stored.network).tensor_split(2)
            coded += (bias * 2.0**FRACTION_BITS).tensor_split(2)
    bits = gaussian_entropy(coded)
    kept = kept_viewpoints(model.most_viewpoints, len(model.coordinates))
    kept = min(len(model.viewpoints), kept)
    # Of the cameras that the file keeps, a lens takes 32 bytes, and each viewpoint 13.
    return int(bits / 8) + OTHER_BYTES + (32 + 13 * kept if kept else 0)


def gaussian_entropy(tensors: Sequence[Tensor]) -> float:
    """Bits of tensors whose values are rounded to integers, and coded as if from one Gaussian of each tensor's spread.
    A GPU is waited for once.
    """
    variances = torch.stack([values.detach().double().var(correction=0) for values in tensors]).tolist()
    # A twelfth: of the rounding.
    each = [max(0.0, 0.5 * math.log2(2 * math.pi * math.e * (variance + 1 / 12))) for variance in variances]
    return sum(values.numel() * bits for values, bits in zip(tensors, each, strict=True))
