"""What a file holds, as integers: between the trained model (floats, torch) and the bytes.

"Q12" is fixed point with 12 fractional bits. A latent is in units of its quantization step; a symbol is the
whole number of steps between a latent and the mean that is predicted for it. Rows are anchors.

Latents come in *groups*, a causal chain: the symbols of a group are coded either by tables, one a channel, or around
means and scales that a network predicts from groups before it. The paper's entropy model (CompGS Sec. 3.3, Fig. 4) is

    0 side       z_f   tables
    1 reference  f     network of z_f           f_hat = q_f + mean
    2 log scales c     network of f_hat         c_hat = q_c + mean
    3 side       z_g   tables
    4 residual   g     network of f_hat, z_g    g_hat = q_g + mean

and other chains (several groups of one role, each given the one before; the anchors' coordinates as context) are
written in the same format.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np

from compgs.codec.anchor_order import octree_depth, octree_origin
from compgs.codec.integer_network import FRACTION_BITS, IntegerNetwork, entropy_parameters, first_rows
from compgs.codec.rans import escape_bits
from compgs.codec.tables import FrequencyTables, HyperTable, channel_tables, gaussian_tables
from compgs.codec.viewpoints import Viewpoints
from compgs.codec.weights import QuantizedTensor
from compgs.numerics.compiled import njit, portion

LOG_SCALES = 6  # of an anchor: reach of the offsets, size of the primitives
COORDINATES = 3  # inputs of a network that sees where its anchor is


class Role(IntEnum):
    """What a group's latents are; the numbers are the file's."""

    SIDE = 0  # context for other groups, nothing else: a hyperprior
    REFERENCE = 1  # reference embedding of an anchor
    LOG_SCALES = 2  # of an anchor
    RESIDUAL = 3  # residual embedding of each coupled primitive that exists


@dataclass(frozen=True)
class GroupShape:
    """A group as the scene section describes it."""

    role: Role
    channels: int  # of an anchor; with RESIDUAL of a coupled primitive
    steps: tuple[float, ...] = ()  # quantization steps, float32: one, or one a channel; none with SIDE
    context: tuple[int, ...] = ()  # groups before this one, ascending, that its network takes
    sees_coordinates: bool = False  # whether the network takes the anchor's coordinates, before all else

    @property
    def has_network(self) -> bool:
        """Else its channels have tables."""
        return bool(self.context) or self.sees_coordinates

    def width(self, coupled_primitives: int) -> int:
        """Symbols of an anchor that has all its coupled primitives."""
        return self.channels * (coupled_primitives if self.role == Role.RESIDUAL else 1)


@dataclass(frozen=True)
class Group:
    """Latents of all anchors, and what their symbols are coded with."""

    shape: GroupShape
    prior: IntegerNetwork | tuple[HyperTable, ...]  # tables: one a channel
    symbols: np.ndarray  # [N, channels] int32; with RESIDUAL [N, K, channels], zero where the mask is False


@dataclass(frozen=True)
class Dimensions:
    """Sizes of everything."""

    coupled_primitives: int  # K, slots per anchor; the mask says which exist
    residual_dim: int  # channels of a residual embedding, whether coded or in the heads
    heads: Literal["separate", "paired"]  # layout of the prediction networks
    width: int  # hidden width of the prediction networks
    groups: tuple[GroupShape, ...]

    @property
    def reference_dim(self) -> int:
        return self.channels(Role.REFERENCE)

    def channels(self, role: Role) -> int:
        """Of all groups of a role together."""
        return sum(g.channels for g in self.groups if g.role == role)

    def network_size(self, group: GroupShape) -> tuple[int, int]:
        """(inputs, outputs) of a group's network; the outputs are means and scales."""
        inputs = sum(self.groups[i].channels for i in group.context)
        return inputs + COORDINATES * group.sees_coordinates, 2 * group.width(self.coupled_primitives)

    @property
    def network_sizes(self) -> list[tuple[int, int]]:
        """Of the networks in the file's order."""
        return [self.network_size(g) for g in self.groups if g.has_network]

    @property
    def table_count(self) -> int:
        """Tables in the file: one for each channel of the groups without network."""
        return sum(g.width(self.coupled_primitives) for g in self.groups if not g.has_network)

    def symbols_per_anchor(self) -> int:
        """With all coupled primitives."""
        return sum(g.width(self.coupled_primitives) for g in self.groups)


@dataclass(frozen=True)
class FileContent:
    """N anchors with up to K coupled primitives each, and all that is needed to render them."""

    coupled_primitives: int
    residual_dim: int
    heads_layout: Literal["separate", "paired"]
    width: int
    voxel_size: float  # world units between neighbouring coordinates
    world_offset: tuple[float, float, float]  # world units: where coordinates (0, 0, 0) are
    view_distance_scale: float  # world units: unit of the view embedding's distance
    background: tuple[float, float, float]  # color behind everything; float32
    coordinates: np.ndarray  # [N, 3] int32 voxels
    mask: np.ndarray  # [N, K] bool: which coupled primitives exist
    groups: tuple[Group, ...]
    heads: tuple[tuple[str, QuantizedTensor], ...]  # prediction networks' parameters by name
    viewpoints: Viewpoints | None = None  # where to look from
    stands_for: np.ndarray | None = None  # of a prefix: [N] anchors of the whole scene for which each stands
    metadata: dict[str, str] = field(default_factory=dict)  # for people; no decoder depends on it

    @property
    def dimensions(self) -> Dimensions:
        shapes = tuple(group.shape for group in self.groups)
        return Dimensions(self.coupled_primitives, self.residual_dim, self.heads_layout, self.width, shapes)

    def group(self, role: Role) -> Group:
        """The first group of a role. Raises KeyError if there is none."""
        for group in self.groups:
            if group.shape.role == role:
                return group
        raise KeyError(role)


# Of each group: dequantized latents, Q12, in units of their quantization step: [N, channels] int32; with RESIDUAL
# [P, channels], the P coupled primitives that exist, anchor by anchor.
Latents = tuple[np.ndarray, ...]


def fixed_point(symbols: np.ndarray) -> np.ndarray:  # int32, Q12
    """Symbols of a group with tables as networks take them. Below 2^18, which the format asserts, they fit into 32
    bits.
    """
    return symbols << FRACTION_BITS


def reconstruct(symbols: np.ndarray, means: np.ndarray) -> np.ndarray:  # int32, Q12
    """Latents from symbols and means (same shape, Q12); they take the means' place."""
    _add_steps(symbols.reshape(-1), means.reshape(-1))
    return means


def coordinate_context(coordinates: np.ndarray) -> np.ndarray:
    """[N, 3] voxels of all anchors -> [N, 3] int32 Q12, -1 to 1: where an anchor is in the scene's octree."""
    origin = octree_origin(coordinates)
    offsets = coordinates.astype(np.int64) - origin
    depth = octree_depth(offsets)
    return ((((2 * offsets + 1) << FRACTION_BITS) >> depth) - (1 << FRACTION_BITS)).astype(np.int32)


def network_context(shape: GroupShape, latents: Sequence[np.ndarray], places: np.ndarray) -> np.ndarray:
    """[N, inputs] Q12 of a group's network, from the latents of the groups before it and `coordinate_context`."""
    parts = [places] if shape.sees_coordinates else []
    parts += [latents[i] for i in shape.context]
    return parts[0] if len(parts) == 1 else np.concatenate(parts, 1)


def conditional_tables(
    shape: GroupShape,
    prior: IntegerNetwork | tuple[HyperTable, ...],
    latents: Sequence[np.ndarray],
    places: np.ndarray,  # [N, 3] `coordinate_context`
    mask: np.ndarray,  # [N, K] bool
) -> tuple[np.ndarray | None, np.ndarray, FrequencyTables]:
    """What encoder and decoder know of a group before its symbols: means (Q12; None for a group with tables), index of
    each symbol's table, and the tables. [N, channels]; with RESIDUAL [P, channels].
    """
    slots = mask if shape.role == Role.RESIDUAL else np.ones((len(mask), 1), np.bool_)
    if isinstance(prior, IntegerNetwork):
        context = network_context(shape, latents, places)
        means, index = entropy_parameters(prior, context, slots)
        return means, index, gaussian_tables()
    columns = np.arange(len(prior), dtype=np.uint8).reshape(slots.shape[1], shape.channels)
    return None, np.broadcast_to(columns, (len(mask), *columns.shape))[slots], channel_tables(prior)


def existing_symbols(
    group: Group, mask: np.ndarray
) -> np.ndarray:  # [N, channels], with RESIDUAL [P, channels]
    """A group's symbols without those of coupled primitives that do not exist."""
    return gather_existing(group.symbols, mask) if group.shape.role == Role.RESIDUAL else group.symbols


def gather_existing(slots: np.ndarray, mask: np.ndarray) -> np.ndarray:  # [P, D]
    """Of [N, K, D], the coupled primitives that exist [N, K], anchor by anchor."""
    rows = first_rows(mask)
    out = np.empty((int(rows[-1]), slots.shape[2]), np.int32)
    _move_rows(slots, out, mask, rows, True)
    return out


def scatter_existing(existing: np.ndarray, mask: np.ndarray) -> np.ndarray:  # [N, K, D]
    """Inverse of `gather_existing`; zero where nothing exists."""
    slots = np.empty((*mask.shape, existing.shape[1]), np.int32)
    _move_rows(slots, existing, mask, first_rows(mask), False)
    return slots


def _additions_worth_sharing(symbols: np.ndarray, means: np.ndarray) -> int:
    return symbols.size >> 17  # 30 microseconds


@njit(parallel=True, worth=_additions_worth_sharing)
def _add_steps(symbols, means, share):
    for i in portion(len(symbols), share):
        means[i] += symbols[i] << FRACTION_BITS


@njit(parallel=True)
def _move_rows(slots, existing, mask, rows, gather, share):
    for n in portion(len(mask), share):
        row = rows[n]
        for k in range(mask.shape[1]):
            if not mask[n, k]:
                if not gather:
                    slots[n, k, :] = 0
                continue
            for c in range(slots.shape[2]):
                if gather:
                    existing[row, c] = slots[n, k, c]
                else:
                    slots[n, k, c] = existing[row, c]
            row += 1


@dataclass(frozen=True)
class CodedGroup:
    """A group's symbols as a stream has them, with what both sides of the coder know; rows as in `Latents`."""

    symbols: np.ndarray
    table_index: np.ndarray  # of each symbol
    tables: FrequencyTables
    latents: np.ndarray


def walk(groups: Sequence[Group], mask: np.ndarray, places: np.ndarray) -> Iterator[CodedGroup]:
    """Along the chain of groups, each given the ones before. mask: [N, K]; places: [N, 3] `coordinate_context`."""
    latents: list[np.ndarray] = []
    for group in groups:
        means, index, tables = conditional_tables(group.shape, group.prior, latents, places, mask)
        symbols = existing_symbols(group, mask)
        latents.append(fixed_point(symbols) if means is None else reconstruct(symbols, means))
        yield CodedGroup(symbols, index, tables, latents[-1])


def dequantize(content: FileContent) -> Latents:
    """Latents of all anchors, exactly as any other decoder gets them."""
    places = coordinate_context(content.coordinates)
    return tuple(coded.latents for coded in walk(content.groups, content.mask, places))


def cross_entropy_bits(content: FileContent) -> list[float]:
    """Code length of each group under the file's own integer tables, escapes included: what a perfect coder needs."""
    places = coordinate_context(content.coordinates)
    return [
        float(sum(escape_bits(coded.symbols.ravel(), coded.table_index.ravel(), coded.tables)))
        for coded in walk(content.groups, content.mask, places)
    ]
