"""How alike a splat and its neighbours are (CompGS Fig. 2), by attribute.

M splats, k neighbours each. `x` is an attribute of all splats, [M, C], centred over the scene. A neighbour is one of
the k splats with the smallest Euclidean distance between means; positions serve for nothing else.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from compgs.model.splats import SplatArrays
from compgs.tensors.reference import rotation_matrices
from compgs.tensors.splats import Splats

Array = NDArray[np.float32]
Index = NDArray[np.int64]

# Neighbours of a splat (the paper's figure).
NEIGHBOURS = 20
# Of the random splats that neighbours are compared with.
SEED = 0
# Of the similarities to random splats: what is above is rare among them.
RARE = 0.99


@dataclass(frozen=True)
class Similarity:
    """Of one attribute to that of the neighbours, and to that of as many random splats."""

    attribute: str
    numbers: int  # of the attribute, a splat
    neighbours: (
        float | None
    )  # mean cosine similarity, -1 to 1; None for a single number, which has no direction
    random: float | None
    left: float | None  # share of the variance left after prediction by the neighbours' mean; None: as stored
    left_random: float | None


# attributes ---------------------------------------------------------------------------------------------------------


def attributes(arrays: SplatArrays) -> dict[str, Array]:
    """[M, C] each, nothing of them a position. What is arbitrary in a splat is not in them: the order of its axes
    and the sign of its quaternion.
    """
    splats = Splats.of(arrays)
    result = {
        "scales": splats.log_scales.sort(dim=1, descending=True).values,
        "orientation": stretch(splats.log_scales, splats.quaternions),
        "opacity": splats.opacity_logits.sigmoid()[:, None],
        "color": splats.dc,
        "harmonics": splats.rest.flatten(1),
    }
    return {name: value.numpy() for name, value in result.items() if value.shape[1]}


def stretch(log_scales: torch.Tensor, quaternions: torch.Tensor) -> torch.Tensor:
    """[M, 6]: where to a splat is longer than it is large: the logarithm of its covariance without the size (the
    trace). The dot product of two of them is that of the matrices, so the cosine is 1 for the same axes in the same
    proportions, and a round splat is zero.
    """
    rotations = rotation_matrices(quaternions)
    lengths = 2 * (log_scales - log_scales.mean(1, keepdim=True))
    matrices = (rotations * lengths[:, None]) @ rotations.transpose(1, 2)
    rows, columns = torch.tensor([[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    # An entry off the diagonal is there twice in the matrix.
    twice = torch.tensor([1.0, 1.0, 1.0, 2.0, 2.0, 2.0]).sqrt()
    return matrices[:, rows, columns] * twice


def as_stored(splats: SplatArrays) -> Array:
    """[M, C]: every number of the .ply file but position and normal, not centred, not scaled."""
    parts = [
        splats.dc,
        splats.rest.reshape(len(splats), -1),
        splats.opacity_logits[:, None],
        splats.log_scales,
        splats.quaternions,
    ]
    return np.concatenate(parts, 1)


def normalized(values: Array) -> Array:
    """Centred over the scene, and scaled as a whole so that the mean squared length is 1 (if not all are the same)."""
    centred = values.astype(np.float64) - values.mean(0, dtype=np.float64)
    length = np.sqrt((centred**2).sum(1).mean())
    return (centred / (length or 1.0)).astype(np.float32)


# pairs --------------------------------------------------------------------------------------------------------------


def nearest(means: Array, count: int) -> Index:
    """[M, count]: the nearest other splats of each. Raises SystemExit if there are not so many."""
    splats = len(means)
    if splats <= count:
        raise SystemExit(f"expected more than {count} splats, found {splats}: none has {count} neighbours")
    found = cKDTree(means).query(means, k=count + 1)[1]
    # Of splats in the same place, a splat need not be the first of its own list, nor in it at all.
    others = found != np.arange(splats)[:, None]
    others[others.all(1), -1] = False
    return found[others].reshape(splats, count).astype(np.int64)


def random_others(splats: int, count: int, seed: int = SEED) -> Index:
    """[M, count]: other splats, each as likely."""
    drawn = np.random.default_rng(seed).integers(0, splats - 1, (splats, count))
    return drawn + (drawn >= np.arange(splats)[:, None])


# measures -----------------------------------------------------------------------------------------------------------


def cosine_similarities(x: Array, partners: Index) -> Array:
    """[M]: mean over a splat's partners of the cosine of the angle between the two vectors; 0 for one without length.

    The paper's cosine distance is 1 less this.
    """
    lengths = np.linalg.norm(x, axis=1, keepdims=True)
    unit = np.divide(x, lengths, out=np.zeros_like(x), where=lengths > 0)
    total = np.zeros(len(x), np.float32)
    for column in partners.T:
        total += np.einsum("mc,mc->m", unit, unit[column])
    return total / partners.shape[1]


def variance_left(x: Array, partners: Index) -> float | None:
    """Mean square of what is left when each splat is predicted by the mean of its partners, over that of the splats
    themselves. 0: predicted exactly; 1 + 1/k for k that say nothing. None where all splats are the same.
    """
    predicted = np.zeros_like(x)
    for column in partners.T:
        predicted += x[column]
    residual = x - predicted / partners.shape[1]
    variance = float(np.square(x, dtype=np.float64).sum())
    return float(np.square(residual, dtype=np.float64).sum()) / variance if variance else None


@dataclass(frozen=True, eq=False)
class Measured:
    """What a file's splats are like."""

    splats: int
    rows: tuple[Similarity, ...]
    neighbours: Array  # [M] similarity of each splat to its neighbours, all attributes together
    random: Array  # [M] and to random splats

    @property
    def beyond_random(self) -> float:
        """Share of the splats that are more like their neighbours than 99 % of the splats are like random ones."""
        return float((self.neighbours > np.quantile(self.random, RARE)).mean())

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "splats": self.splats,
            "neighbours": NEIGHBOURS,
            "seed": SEED,
            "beyond_random": self.beyond_random,
            "rows": [vars(row) for row in self.rows],
        }


def measure(splats: SplatArrays) -> Measured:
    """Raises SystemExit for fewer splats than neighbours."""
    near = nearest(splats.means, NEIGHBOURS)
    far = random_others(len(splats), NEIGHBOURS)
    parts = {name: normalized(values) for name, values in attributes(splats).items()}
    together = np.concatenate(list(parts.values()), axis=1)
    rows = [similarity(name, x, near, far) for name, x in {**parts, "all together": together}.items()]
    stored = as_stored(splats)
    rows.append(Similarity("all, as stored", stored.shape[1], *_mean_cosines(stored, near, far), None, None))
    return Measured(
        len(splats), tuple(rows), cosine_similarities(together, near), cosine_similarities(together, far)
    )


def similarity(name: str, x: Array, near: Index, far: Index) -> Similarity:
    """Of one attribute."""
    cosines = _mean_cosines(x, near, far) if x.shape[1] > 1 else (None, None)
    return Similarity(name, x.shape[1], *cosines, variance_left(x, near), variance_left(x, far))


def _mean_cosines(x: Array, near: Index, far: Index) -> tuple[float, float]:
    return float(cosine_similarities(x, near).mean()), float(cosine_similarities(x, far).mean())
