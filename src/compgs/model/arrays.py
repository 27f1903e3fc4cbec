"""Anchors, residuals and networks as numpy arrays: what the kernels take, free of torch."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgs.model import network_kernels as kernels

_A = np.ndarray
# Weights as the kernels take them, those of `MLPArrays.after_entry` and `MLPArrays.whole`.
AfterEntry = tuple[_A, _A, _A, _A, _A, _A]
Whole = tuple[_A, _A, _A, _A, _A, _A, _A, _A]

# As `rows` of `MLPArrays.apply`: every residual embedding, in order.
ALL_ROWS = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class PrimitiveArrays:
    """N anchors and their P coupled primitives: the fields of `Primitives`, float32 and contiguous."""

    positions: np.ndarray  # [N, 3] world units
    log_scales: np.ndarray  # [N, 6] natural log of (0:3) reach, (3:6) size, in voxels
    references: np.ndarray  # [N, reference_dim]
    residuals: np.ndarray  # [P, residual_dim]
    anchor_index: np.ndarray  # [P] int64, ascending: row of the anchor of each coupled primitive
    voxel_size: float  # world units

    def __len__(self) -> int:
        return len(self.positions)

    def first_coupled(self) -> np.ndarray:
        """[N + 1] int64: where the coupled primitives of each anchor begin, and where the last one's end."""
        counts = np.bincount(self.anchor_index, minlength=len(self))
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)])

    def spread(self) -> np.ndarray:
        """[N, 6] world units: (0:3) reach of a translation of 1, (3:6) standard deviations of the anchor."""
        with np.errstate(over="ignore"):  # a file may hold any log scale; what is infinite is not rendered
            return np.exp(self.log_scales) * np.float32(self.voxel_size)


@dataclass(frozen=True, eq=False)
class MLPArrays:
    """A residual MLP of H hidden channels, O outputs, B blocks, over F anchor features and G residual channels.

    First layer and skip stand side by side: they take the same inputs. All float32 and contiguous.
    """

    anchor_entry: np.ndarray  # [F, H + O] of the anchor features
    entry_bias: np.ndarray  # [H + O] input bias, then output bias
    residual_entry: np.ndarray  # [G, H + O] of the residual embedding
    weights1: np.ndarray  # [B, H, H]
    biases1: np.ndarray  # [B, H]
    weights2: np.ndarray  # [B, H, H]
    biases2: np.ndarray  # [B, H]
    output_weight: np.ndarray  # [H, O]

    @classmethod
    def of(cls, tensors: Mapping[str, np.ndarray], anchor_dim: int) -> "MLPArrays":
        """Make it from a network's tensors by the names that docs/bitstream_prediction.md gives them, without the
        network's own in front; the first `anchor_dim` inputs are the anchor's.
        """

        width = len(tensors["input_bias"])
        count = sum(name.endswith(".bias1") for name in tensors)

        def blocks(name: str, *shape: int) -> np.ndarray:
            found = [tensors[f"blocks.{b}.{name}"] for b in range(count)]
            return np.stack(found) if found else np.zeros((0, *shape), np.float32)

        entry = np.concatenate([tensors["input_weight"], tensors["skip_weight"]], 1)
        return cls(
            anchor_entry=entry[:anchor_dim],
            entry_bias=np.concatenate([tensors["input_bias"], tensors["output_bias"]]),
            residual_entry=entry[anchor_dim:],
            weights1=blocks("weight1", width, width),
            biases1=blocks("bias1", width),
            weights2=blocks("weight2", width, width),
            biases2=blocks("bias2", width),
            output_weight=np.ascontiguousarray(tensors["output_weight"]),
        )

    @property
    def after_entry(self) -> AfterEntry:
        """The weights that are applied to each coupled primitive, as the kernels take them."""
        return (
            self.residual_entry,
            self.weights1,
            self.biases1,
            self.weights2,
            self.biases2,
            self.output_weight,
        )

    @property
    def whole(self) -> Whole:
        """All weights, as the kernels take them."""
        return (self.anchor_entry, self.entry_bias, *self.after_entry)

    def begin(self, features: np.ndarray) -> np.ndarray:  # [A, F] -> [A, H + O]
        """The anchors' part of the first layer and of the skip, biases included."""
        shared = np.empty((len(features), len(self.entry_bias)), np.float32)
        kernels.begin(features, self.anchor_entry, self.entry_bias, shared)
        return shared

    def apply(
        self,
        features: np.ndarray,  # [A, F] of anchors
        residuals: np.ndarray,  # [P, G]
        index: np.ndarray,  # [M] int64, ascending: row of `features` of each coupled primitive
        rows: np.ndarray = ALL_ROWS,  # [M] int64, ascending: their rows of `residuals`
    ) -> np.ndarray:  # [M, O]
        """One row of outputs per coupled primitive: the kernels' twin of `tensors.residual_mlp.ResidualMLP`."""
        out = np.empty((len(index), self.output_weight.shape[1]), np.float32)
        kernels.forward(residuals, rows, index, self.begin(features), *self.after_entry, out)
        return out
