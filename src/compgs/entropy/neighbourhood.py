"""What the anchors around have, in training (docs/bitstream.md, "Neighbours").

As a decoder has it: latents that see neighbours lie whole steps from a constant, so that they are known without having
decoded anything. No gradient goes to the neighbours.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from compgs.numerics.compiled import chunk_of, njit
from compgs.ordering.neighbours import BESIDES, find_neighbours
from compgs.ordering.order import canonical_order, level_counts, octree_depth, octree_origin
from compgs.ordering.ranges import chosen_levels
from compgs.tensors import where


@dataclass(frozen=True)
class Neighbourhood:
    """The neighbours of N anchors, which are numbered as in the model."""

    anchors: Tensor  # [N, most] int32; behind an anchor's last neighbour any
    weights: Tensor  # [N, most] float32: those of an anchor sum to 1, or it has none; 0 behind the last

    @torch.no_grad()
    def around(self, latents: Tensor, centre: Tensor, rows: Tensor | None) -> Tensor:
        """[V, 2 + C] of the anchors in `rows` [V] int64 (None: of all): 1 if there are any neighbours, how far they are
        from the `centre` [C] on average over the channels, and by how much in each. latents: [N, C] of all anchors.
        """
        rows = torch.arange(len(latents), device=latents.device) if rows is None else rows
        if where.in_kernels(latents):
            out = torch.zeros(len(rows), BESIDES + latents.shape[1])
            _describe_neighbours(
                rows.numpy(),
                self.anchors.numpy(),
                self.weights.numpy(),
                latents.detach().numpy(),
                centre.detach().numpy(),
                out.numpy(),
            )
            return out
        deviations = latents - centre
        said = torch.cat(
            [torch.ones_like(deviations[:, :1]), deviations.abs().mean(1, keepdim=True), deviations], 1
        )
        anchors, weights = self.anchors.index_select(0, rows), self.weights.index_select(0, rows)
        # Sums as it reads: what all neighbours of all rows say would take a GPU hundreds of megabytes.
        return torch.nn.functional.embedding_bag(
            anchors, said, per_sample_weights=weights.to(said.dtype), mode="sum"
        )

    def to(self, device: torch.device) -> "Neighbourhood":
        return Neighbourhood(self.anchors.to(device), self.weights.to(device))


def neighbourhood(coordinates: Tensor) -> Neighbourhood:
    """Find the neighbourhood of the anchors at coordinates [N, 3] int32 voxels, in any order; with the ranges that an
    encoder would make.
    """
    voxels = coordinates.cpu().numpy()
    order = canonical_order(voxels)
    ordered = voxels[order].astype(np.int64)
    offsets = (ordered - octree_origin(voxels)).astype(np.int32)
    depth, counts = octree_depth(offsets.astype(np.int64)), level_counts(voxels)
    levels = chosen_levels(counts)
    ends = [int(counts[level]) for level in levels]
    counts_around = np.zeros(len(voxels), np.int64)
    found = []
    for level, known, end in zip(levels, ends, ends[1:], strict=False):
        first, neighbours, weights = find_neighbours(offsets[:end], known, depth - level).weights(
            offsets[:end]
        )
        counts_around[known:end] = np.diff(first)
        found.append((known, first, neighbours, weights))
    most = max(1, int(counts_around.max()))
    anchors = np.zeros((len(voxels), most), np.int32)
    shares = np.zeros((len(voxels), most), np.float32)
    for known, first, neighbours, weights in found:
        own = np.repeat(np.arange(len(first) - 1), np.diff(first))
        place = np.arange(len(own)) - first[own]
        anchors[known + own, place] = order[neighbours]
        shares[known + own, place] = weights / np.add.reduceat(weights, first[:-1])[own]
    rank = np.empty_like(order)  # from the canonical order to the model's
    rank[order] = np.arange(len(order))
    device = coordinates.device
    return Neighbourhood(
        torch.from_numpy(anchors[rank]).to(device), torch.from_numpy(shares[rank]).to(device)
    )


@njit(parallel=True)
def _describe_neighbours(rows, anchors, weights, latents, centre, out, part):
    channels = len(centre)
    mean = np.float32(1) / np.float32(channels)
    for i in chunk_of(len(rows), part):
        row = rows[i]
        activity = np.float32(0)
        for e in range(anchors.shape[1]):
            j, weight = anchors[row, e], weights[row, e]
            if weight == 0:
                break
            size = np.float32(0)
            for c in range(channels):
                deviation = latents[j, c] - centre[c]
                size += abs(deviation)
                out[i, 2 + c] += weight * deviation
            activity += weight * size
        out[i, 0] = np.float32(1) if weights[row, 0] > 0 else np.float32(0)
        out[i, 1] = activity * mean
