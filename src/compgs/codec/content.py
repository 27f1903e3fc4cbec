"""What a file holds, as integers: between the trained model (floats, torch) and the bytes.

"Q12" is fixed point with 12 fractional bits. A latent is in units of its quantization step; it lies whole *steps* from
the mean that is predicted for it. A symbol is such a number of steps, or what earlier ones of its row leave of it
(`rows.py`). Rows of arrays are anchors.

Latents come in *groups*, a causal chain: the symbols of a group are coded either by tables, one a channel, or around
means and scales that a network predicts from groups before it. The paper's entropy model (CompGS Sec. 3.3, Fig. 4) is

    0 side       z_f   tables
    1 reference  f     network of z_f           f_hat = q_f + mean
    2 log scales c     network of f_hat         c_hat = q_c + mean
    3 side       z_g   tables
    4 residual   g     network of f_hat, z_g    g_hat = q_g + mean

and other chains (several groups of one role, each given the one before; as context the anchors' coordinates, or what
anchors of earlier ranges have around) are written in the same format.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from compgs.codec.integer_network import (
    FRACTION_BITS,
    IntegerNetwork,
    entropy_parameters,
    first_rows,
    follow_neighbours,
)
from compgs.codec.neighbour_context import neighbour_context
from compgs.codec.rans import escape_bits
from compgs.codec.rows import Rows, steps_of_rows, symbols_of_rows
from compgs.codec.tables import FrequencyTables, HyperTable, channel_tables, gaussian_tables
from compgs.codec.viewpoints import Viewpoints
from compgs.codec.weights import QuantizedTensor
from compgs.model.constants import SHARED_RESIDUALS
from compgs.model.head_weights import HeadDimensions, Layout, weight_shapes
from compgs.numerics.compiled import chunk_of, njit, rows_a_thread
from compgs.ordering.neighbours import BESIDES, Neighbours, find_neighbours
from compgs.ordering.order import level_counts, octree_depth, octree_origin
from compgs.ordering.ranges import chosen_levels

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
    sees_neighbours: bool = False  # whether it takes what anchors around have of this group, behind all else

    @property
    def has_network(self) -> bool:
        """Else its channels have tables."""
        return bool(self.context) or self.sees_coordinates or self.sees_neighbours

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
    heads: Layout  # layout of the prediction networks
    width: int  # hidden width of the prediction networks
    groups: tuple[GroupShape, ...]

    @property
    def reference_dim(self) -> int:
        return self.channels(Role.REFERENCE)

    def channels(self, role: Role) -> int:
        """Count the channels of all groups of a role together."""
        return sum(g.channels for g in self.groups if g.role == role)

    def network_size(self, group: GroupShape) -> tuple[int, int]:
        """(inputs, outputs) of a group's network; the outputs are means and scales."""
        inputs = COORDINATES * group.sees_coordinates + sum(self.groups[i].channels for i in group.context)
        inputs += BESIDES * group.sees_neighbours
        return inputs, 2 * group.width(self.coupled_primitives)

    @property
    def network_sizes(self) -> list[tuple[int, int]]:
        """Return inputs and outputs of the networks, in the file's order."""
        return [self.network_size(g) for g in self.groups if g.has_network]

    @property
    def networks_that_follow(self) -> list[bool]:
        """Which of them are of groups that see neighbours."""
        return [g.sees_neighbours for g in self.groups if g.has_network]

    @property
    def channels_of_networks(self) -> list[int]:
        """Channels of their groups."""
        return [g.channels for g in self.groups if g.has_network]

    @property
    def head_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the prediction networks' parameters, by name, in the order of files that leave the names
        out.
        """
        sizes = HeadDimensions(self.reference_dim, self.residual_dim, self.width)
        shapes = weight_shapes(self.heads, sizes)
        if self.channels(Role.RESIDUAL) == 0:
            shapes[SHARED_RESIDUALS] = (self.coupled_primitives, self.residual_dim)
        return shapes

    @property
    def table_count(self) -> int:
        """Tables in the file: one for each channel of the groups without network."""
        return sum(g.width(self.coupled_primitives) for g in self.groups if not g.has_network)

    def symbols_per_anchor(self) -> int:
        """Count the symbols of an anchor that has all coupled primitives."""
        return sum(g.width(self.coupled_primitives) for g in self.groups)


@dataclass(frozen=True)
class FileContent:
    """N anchors with up to K coupled primitives each, and all that is needed to render them."""

    coupled_primitives: int
    residual_dim: int
    heads_layout: Layout
    width: int
    voxel_size: float  # world units between neighbouring coordinates
    world_offset: tuple[float, float, float]  # world units: where coordinates (0, 0, 0) are
    view_distance_scale: float  # world units: unit of the view embedding's distance
    background: tuple[float, float, float]  # color behind everything; float32
    coordinates: np.ndarray  # [N, 3] int32 voxels
    mask: np.ndarray  # [N, K] bool: which coupled primitives exist
    groups: tuple[Group, ...]
    heads: tuple[tuple[str, QuantizedTensor], ...]  # prediction networks' parameters by name
    # float32, of what is drawn (`RasterSettings`); None, in files before version 4: 0.3 pixels^2 at every size.
    angular_dilation: float | None = None
    viewpoints: Viewpoints | None = None  # where to look from
    # Last octree level of each range, on which what neighbours have depends; None: as `chosen_levels`.
    levels: tuple[int, ...] | None = None
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


def reordered(content: FileContent, order: np.ndarray) -> FileContent:
    """The content with its anchors in another order."""
    if (order[1:] > order[:-1]).all():
        return content
    return replace(
        content,
        coordinates=content.coordinates[order],
        mask=content.mask[order],
        groups=tuple(replace(group, symbols=group.symbols[order]) for group in content.groups),
    )


# Of each group: dequantized latents, Q12, in units of their quantization step: [N, channels] int32; with RESIDUAL
# [P, channels], the P coupled primitives that exist, anchor by anchor.
Latents = tuple[np.ndarray, ...]


def fixed_point(symbols: np.ndarray) -> np.ndarray:  # int32, Q12
    """Symbols of a group with tables as networks take them. Below 2^18, which the format asserts, they fit into 32
    bits.
    """
    return symbols << FRACTION_BITS


def reconstruct(steps: np.ndarray, means: np.ndarray) -> np.ndarray:  # int32, Q12
    """Latents from steps and means (same shape, Q12); they take the means' place."""
    _add_steps(steps.reshape(-1), means.reshape(-1))
    return means


@dataclass(frozen=True)
class Surroundings:
    """What is known of N anchors, in canonical order, before any of their latents."""

    offsets: np.ndarray  # [N, 3] int32 from the octree's origin
    depth: int  # of the octree
    levels: tuple[int, ...]  # last one of each range
    ends: tuple[int, ...]  # anchors up to there

    @cached_property
    def places(self) -> np.ndarray:
        """[N, 3] int32 Q12, -1 to 1: where an anchor is in the octree."""
        doubled = (2 * self.offsets.astype(np.int64) + 1) << FRACTION_BITS
        return ((doubled >> self.depth) - (1 << FRACTION_BITS)).astype(np.int32)

    def rows(self, number: int) -> slice:
        """Anchors of a range."""
        return slice(self.ends[number - 1] if number else 0, self.ends[number])

    def neighbours(self, number: int) -> Neighbours:
        """Find the neighbours of the anchors of a range, which is not the first."""
        known, end = self.ends[number - 1], self.ends[number]
        return find_neighbours(self.offsets[:end], known, self.depth - self.levels[number - 1])

    def around(self, number: int, network: IntegerNetwork, earlier: np.ndarray) -> np.ndarray:
        """`neighbour_context` of a range; earlier [M, C]: latents of the anchors of the ranges before."""
        end = self.ends[number]
        return neighbour_context(network, earlier, self.offsets[:end], lambda: self.neighbours(number))


def surroundings(
    coordinates: np.ndarray, levels: Sequence[int] | None = None, counts: np.ndarray | None = None
) -> Surroundings:
    """Find the surroundings of [N, 3] voxels in canonical order; `levels`: last octree level of each range, by default
    `chosen_levels`; `counts`: `level_counts`, if that is known.
    """
    offsets = coordinates.astype(np.int64) - octree_origin(coordinates)
    depth, counts = octree_depth(offsets), level_counts(coordinates) if counts is None else counts
    levels = chosen_levels(counts) if levels is None else levels
    ends = tuple(int(counts[level]) for level in levels)
    return Surroundings(offsets.astype(np.int32), depth, tuple(levels), ends)


def network_context(
    shape: GroupShape, latents: Sequence[np.ndarray], places: np.ndarray, around: np.ndarray | None = None
) -> np.ndarray:
    """[n, inputs] Q12 of a group's network, from the latents of the groups before it, where the anchors are
    (`Surroundings.places`), and what the anchors around them have (`Surroundings.around`), if it sees that.
    """
    parts = [places] if shape.sees_coordinates else []
    parts += [latents[i] for i in shape.context]
    if shape.sees_neighbours:
        assert around is not None
        parts.append(around[:, :BESIDES])
    return parts[0] if len(parts) == 1 else np.concatenate(parts, 1)


def conditional_tables(
    shape: GroupShape,
    prior: IntegerNetwork | tuple[HyperTable, ...],
    latents: Sequence[np.ndarray],
    places: np.ndarray,  # [n, 3] `Surroundings.places`
    mask: np.ndarray,  # [n, K] bool
    around: np.ndarray | None = None,  # [n, 2 + channels] `Surroundings.around`, if the group sees neighbours
) -> tuple[np.ndarray | None, np.ndarray, FrequencyTables]:
    """What encoder and decoder know of a group before its symbols: means (Q12; None for a group with tables), index of
    each symbol's table, and the tables. [n, channels]; with RESIDUAL [p, channels].
    """
    slots = mask if shape.role == Role.RESIDUAL else np.ones((len(mask), 1), np.bool_)
    if isinstance(prior, IntegerNetwork):
        context = network_context(shape, latents, places, around)
        means, index = entropy_parameters(prior, context, slots)
        if prior.follow is not None and around is not None:
            follow_neighbours(prior, around[:, BESIDES:], means)
        return means, index, gaussian_tables()
    columns = np.arange(len(prior), dtype=np.uint8).reshape(slots.shape[1], shape.channels)
    return None, np.broadcast_to(columns, (len(mask), *columns.shape))[slots], channel_tables(prior)


def existing_symbols(
    group: Group, mask: np.ndarray
) -> np.ndarray:  # [N, channels], with RESIDUAL [P, channels]
    """A group's symbols without those of coupled primitives that do not exist."""
    return gather_existing(group.symbols, mask) if group.shape.role == Role.RESIDUAL else group.symbols


def gather_existing(slots: np.ndarray, mask: np.ndarray) -> np.ndarray:  # [P, D]
    """Gather from [N, K, D] the rows of the coupled primitives that exist [N, K], anchor by anchor."""
    rows = first_rows(mask)
    out = np.empty((int(rows[-1]), slots.shape[2]), np.int32)
    _move_rows(slots, out, mask, rows, True)
    return out


def scatter_existing(existing: np.ndarray, mask: np.ndarray) -> np.ndarray:  # [N, K, D]
    """Inverse of `gather_existing`; zero where nothing exists."""
    slots = np.empty((*mask.shape, existing.shape[1]), np.int32)
    _move_rows(slots, existing, mask, first_rows(mask), False)
    return slots


@njit(parallel=True, max_threads=rows_a_thread(1 << 17))  # 30 microseconds
def _add_steps(steps, means, part):
    for i in chunk_of(len(steps), part):
        means[i] += steps[i] << FRACTION_BITS


@njit(parallel=True)
def _move_rows(slots, existing, mask, rows, gather, part):
    for n in chunk_of(len(mask), part):
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
    table_index: np.ndarray  # of each symbol, before its row says anything
    tables: FrequencyTables
    latents: np.ndarray
    inertia: int = 0  # of its rows

    @property
    def rows(self) -> Rows:
        """Return the row layout of the group's stream of symbols."""
        return Rows(self.symbols.shape[1], self.inertia)

    def part(self, rows: slice) -> "CodedGroup":
        """Some of its rows."""
        return replace(
            self, symbols=self.symbols[rows], table_index=self.table_index[rows], latents=self.latents[rows]
        )

    def bits(self) -> float:
        """Code length, escapes included, were it one stream."""
        return float(sum(escape_bits(self.symbols.ravel(), self.table_index.ravel(), self.tables, self.rows)))


# Steps of anchors of a group, given their means (None: it has tables) and the index of each symbol's table.
StepsOf = Callable[[slice, np.ndarray | None, np.ndarray], np.ndarray]


def code_group(
    shape: GroupShape,
    prior: IntegerNetwork | tuple[HyperTable, ...],
    before: Sequence[np.ndarray],  # latents of the groups before
    known: Surroundings,
    mask: np.ndarray,  # [N, K]
    steps_of: StepsOf,
) -> CodedGroup:
    """A group of all anchors: at once, or range by range where it sees neighbours."""
    if not shape.sees_neighbours:
        means, index, tables = conditional_tables(shape, prior, before, known.places, mask)
        steps = steps_of(slice(0, len(mask)), means, index)
        if means is None:
            return CodedGroup(steps, index, tables, fixed_point(steps))
        assert isinstance(prior, IntegerNetwork)
        symbols = symbols_of_rows(prior.rows, steps)
        return CodedGroup(symbols, index, tables, reconstruct(steps, means), prior.rows.inertia)
    assert isinstance(prior, IntegerNetwork)
    steps, latents = np.empty((2, len(mask), shape.channels), np.int32)
    index, tables = np.empty(steps.shape, np.uint8), gaussian_tables()
    for number in range(len(known.ends)):
        rows = known.rows(number)
        said = known.around(number, prior, latents[: rows.start])
        context = [x[rows] if i in shape.context else x for i, x in enumerate(before)]
        means, index[rows], _ = conditional_tables(
            shape, prior, context, known.places[rows], mask[rows], said
        )
        assert means is not None
        steps[rows] = steps_of(rows, means, index[rows])
        latents[rows] = reconstruct(steps[rows], means)
    return CodedGroup(symbols_of_rows(prior.rows, steps), index, tables, latents, prior.rows.inertia)


def walk(groups: Sequence[Group], mask: np.ndarray, known: Surroundings) -> Iterator[CodedGroup]:
    """Along the chain of groups, each given the ones before. mask: [N, K]."""
    latents: list[np.ndarray] = []
    for group in groups:
        coded = code_group(group.shape, group.prior, latents, known, mask, steps_of(group, mask))
        latents.append(coded.latents)
        yield coded


def steps_of(group: Group, mask: np.ndarray) -> StepsOf:
    """Those that a group has."""
    symbols = existing_symbols(group, mask)
    steps = steps_of_rows(group.prior.rows, symbols) if isinstance(group.prior, IntegerNetwork) else symbols
    return lambda rows, *_: steps if group.shape.role == Role.RESIDUAL else steps[rows]


def dequantize(content: FileContent) -> Latents:
    """Latents of all anchors, exactly as any other decoder gets them."""
    known = surroundings(content.coordinates, content.levels)
    return tuple(coded.latents for coded in walk(content.groups, content.mask, known))


def cross_entropy_bits(content: FileContent) -> list[float]:
    """Code length of each group under the file's own integer tables, escapes included: what a perfect coder needs."""
    known = surroundings(content.coordinates, content.levels)
    return [coded.bits() for coded in walk(content.groups, content.mask, known)]
