"""How an encoder chooses what the symbols of a row say about its later ones (`rows.py`), once it has all of them.

Training knows nothing of it: it pays for each symbol as if it stood alone, and the file takes less.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from compgs.codec.content import (
    CodedGroup,
    FileContent,
    Group,
    Role,
    StepsOf,
    code_group,
    scatter_existing,
    steps_of,
    surroundings,
)
from compgs.codec.integer_network import BIAS_LIMIT, FRACTION_BITS, IntegerNetwork
from compgs.codec.rans import escape_bits
from compgs.codec.rows import CHAIN_BITS, CHAIN_LIMIT, RowContext, symbols_of_rows
from compgs.codec.tables import GAUSSIAN_COUNT, SCALES_PER_OCTAVE, SMALLEST_SCALE_OCTAVE, HyperTable

INERTIAS = (0, 2, 3, 4, 6, 8, 12, 16, 24, 40, 63)
# Channels whose symbols a chain makes smaller get tables that are lower by up to two octaves; a few are wider than the
# network thinks.
TABLE_SHIFTS = range(-24, 13)
ELEMENT_BITS = 8  # that an element of a chain costs, about
OUTLIER = 1 << 12  # steps beyond it say nothing about how others follow one another
RIDGE = 1e-3  # of the variances: keeps elements small where symbols say next to nothing


def with_chain(network: IntegerNetwork, coded: CodedGroup) -> IntegerNetwork:
    """The network with the chain that suits the group's steps, and tables for what it leaves; without any where that
    does not pay. coded: of a network without chain.
    """
    steps, index = coded.symbols, coded.table_index
    channels = steps.shape[1]
    if channels == 1 or len(steps) == 0:
        return network
    context = RowContext(_fitted_chain(steps, index))
    symbols = symbols_of_rows(context, steps)
    shifts = [_best_shift(symbols[:, c], index[:, c], coded) for c in range(channels)]
    before = _bits(steps, index, coded)
    after = _bits(symbols, _moved(index, np.array(shifts)), coded)
    assert context.chain is not None
    if after + ELEMENT_BITS * len(context.chain) >= before:
        return network
    return replace(_with_tables_moved(network, shifts), rows=replace(network.rows, chain=context.chain))


def fitted(
    role: Role, network: IntegerNetwork, code: Callable[[IntegerNetwork], CodedGroup]
) -> tuple[IntegerNetwork, CodedGroup]:
    """A group's network with what suits its rows, and the group so coded. `code`: the group with a network. A chain
    that is there stays: the tables are made for it.
    """
    coded = code(network)
    if role != Role.REFERENCE and network.rows.chain is None:  # in their principal axes a chain finds nothing
        chained = with_chain(network, coded)
        coded, network = coded if chained is network else code(chained), chained
    coded = replace(coded, inertia=best_inertia(coded))
    return replace(network, rows=replace(network.rows, inertia=coded.inertia)), coded


def with_fitted_rows(content: FileContent) -> FileContent:
    """The same scene, each group with what suits its rows. The content must have an angular dilation, without which the
    format knows nothing of rows.
    """
    known = surroundings(content.coordinates, content.levels)
    groups: list[Group] = []
    latents: list[np.ndarray] = []
    for group in content.groups:
        steps = steps_of(group, content.mask)

        def code(
            prior: IntegerNetwork | tuple[HyperTable, ...], group: Group = group, steps: StepsOf = steps
        ) -> CodedGroup:
            return code_group(group.shape, prior, latents, known, content.mask, steps)

        if isinstance(group.prior, IntegerNetwork):
            network, coded = fitted(group.shape.role, group.prior, code)
            symbols = coded.symbols
            if group.shape.role == Role.RESIDUAL:
                symbols = scatter_existing(symbols, content.mask)
            group = replace(group, prior=network, symbols=symbols)
        else:
            coded = code(group.prior)
        groups.append(group)
        latents.append(coded.latents)
    return replace(content, groups=tuple(groups))


def best_inertia(coded: CodedGroup) -> int:
    """Choose the inertia of a group's rows."""
    bits = [replace(coded, inertia=inertia).bits() for inertia in INERTIAS]
    return INERTIAS[int(np.argmin(bits))]  # the first of equal ones


def _fitted_chain(steps: np.ndarray, index: np.ndarray) -> np.ndarray:  # [C (C - 1) / 2] int32
    """Least squares, every step in units of what its table expects. Sums are taken one by one and not as products of
    matrices, whose last digits depend on the number of threads.
    """
    channels = steps.shape[1]
    values = np.clip(steps, -OUTLIER, OUTLIER).astype(np.float64)
    weights = 2.0 ** (-2.0 * (index / SCALES_PER_OCTAVE + SMALLEST_SCALE_OCTAVE))
    chain: list[float] = []
    for c in range(1, channels):
        weighted = values[:, : c + 1] * weights[:, c, None]
        sums = np.array([[(weighted[:, i] * values[:, j]).sum() for j in range(c + 1)] for i in range(c)])
        inner = sums[:, :c] + np.diag(RIDGE * np.diag(sums[:, :c]) + 1e-9)
        chain += np.linalg.solve(inner, sums[:, c]).tolist()
    whole = np.rint(np.array(chain) * (1 << CHAIN_BITS))
    return np.clip(whole, 1 - CHAIN_LIMIT, CHAIN_LIMIT - 1).astype(np.int32)


def _best_shift(symbols: np.ndarray, index: np.ndarray, coded: CodedGroup) -> int:
    """Choose the shift of a channel's tables."""
    bits = [_bits(symbols, _moved(index, shift), coded) for shift in TABLE_SHIFTS]
    return TABLE_SHIFTS[int(np.argmin(bits))]


def _bits(symbols: np.ndarray, index: np.ndarray, coded: CodedGroup) -> float:
    return sum(escape_bits(symbols.ravel(), index.ravel(), coded.tables))


def _moved(index: np.ndarray, shifts: np.ndarray | int) -> np.ndarray:
    return np.clip(index.astype(np.int64) + shifts, 0, GAUSSIAN_COUNT - 1).astype(np.uint8)


def _with_tables_moved(network: IntegerNetwork, shifts: Iterable[int]) -> IntegerNetwork:
    """Each channel's tables, in all slots, moved by so many."""
    *first, last = network.layers
    half = len(last.bias) // 2
    moves = np.array(list(shifts), np.int64) << FRACTION_BITS
    bias = last.bias.astype(np.int64).copy()
    bias[half:] += np.tile(moves, half // len(moves))
    bias = bias.clip(1 - BIAS_LIMIT, BIAS_LIMIT - 1)
    return replace(network, layers=(*first, replace(last, bias=bias)))
