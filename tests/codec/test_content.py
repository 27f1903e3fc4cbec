"""Whole files: content -> bytes -> content, sizes against the tables' own code length, refusals."""

import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.codec import integer_network
from compgs.codec.content import (
    Dimensions,
    FileContent,
    Group,
    GroupShape,
    Role,
    cross_entropy_bits,
    dequantize,
    surroundings,
)
from compgs.codec.format import MASKS, MAX_SYMBOL, OLDEST_VERSION, pack, unpack
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.codec.reader import file_info, group_names, read_content, read_latents
from compgs.codec.tables import HyperTable
from compgs.codec.writer import write_content
from compgs.errors import CorruptSection, NotEncodable
from compgs.ordering.order import canonical_order, level_counts

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from made_content import make_content, make_dimensions, paper_groups

PAPER_NAMES = [
    "reference hyperprior",
    "reference embeddings",
    "log scales",
    "residual hyperprior",
    "residual embeddings",
]
ROWS = ("coordinates", "mask", "groups")  # fields with a row for each anchor


def reordered(content: FileContent, order: np.ndarray) -> FileContent:
    groups = tuple(replace(group, symbols=group.symbols[order]) for group in content.groups)
    return replace(content, coordinates=content.coordinates[order], mask=content.mask[order], groups=groups)


def with_group(content: FileContent, index: int, **changes: object) -> FileContent:
    """Content of which one group is changed."""
    groups = list(content.groups)
    groups[index] = replace(groups[index], **changes)
    return replace(content, groups=tuple(groups))


def by_position(content: FileContent) -> FileContent:
    return reordered(content, np.lexsort(content.coordinates.T))


def same_array(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and bool((a == b).all())


def assert_same(a: FileContent, b: FileContent) -> None:
    """Same scene, whatever the order of its anchors."""
    a, b = by_position(a), by_position(b)
    assert same_array(a.coordinates, b.coordinates) and same_array(a.mask, b.mask)
    for i, (x, y) in enumerate(zip(a.groups, b.groups, strict=True)):
        assert x.shape == y.shape, i
        assert same_array(x.symbols, y.symbols), i
        assert _plain(x.prior) == _plain(y.prior), i
    assert [(n, t.exponent, t.values.tolist()) for n, t in a.heads] == [
        (n, t.exponent, t.values.tolist()) for n, t in b.heads
    ]
    for field in fields(FileContent):
        if field.name not in (*ROWS, "heads", "levels"):
            assert getattr(a, field.name) == getattr(b, field.name), field.name


def _plain(prior: IntegerNetwork | tuple[HyperTable, ...]) -> list:
    if isinstance(prior, tuple):
        return [(table.lowest, table.levels.tolist()) for table in prior]
    layers = [(x.weight.tolist(), x.bias.tolist(), x.shift, x.rectify, x.adds) for x in prior.layers]
    follow = prior.follow and (prior.follow.weight.tolist(), prior.follow.shift)
    return [prior.skip, layers, follow]


@st.composite
def chains(draw: st.DrawFn) -> tuple[GroupShape, ...]:
    """Any groups that the format holds: several of a role in any order, context or none, one step or one a channel."""
    residual = draw(st.lists(st.integers(1, 3), max_size=2))
    first = draw(st.integers(1, 5))
    wanted = [(Role.REFERENCE, n) for n in draw(st.lists(st.integers(1, 12), min_size=1, max_size=3))]
    wanted += [(Role.LOG_SCALES, n) for n in ((first, 6 - first) if draw(st.booleans()) else (6,))]
    wanted += [(Role.RESIDUAL, n) for n in residual]
    wanted += [(Role.SIDE, n) for n in draw(st.lists(st.integers(1, 5), max_size=3))]
    shapes: list[GroupShape] = []
    for role, channels in draw(st.permutations(wanted)):
        count = 0 if role == Role.SIDE else draw(st.sampled_from([1, channels]))
        steps = tuple(2.0**-i for i in range(count))
        free = [i for i, shape in enumerate(shapes) if shape.role != Role.RESIDUAL]
        context = draw(st.sets(st.sampled_from(free))) if free else set()
        coordinates, neighbours = draw(st.booleans()), role != Role.RESIDUAL and draw(st.booleans())
        shapes.append(GroupShape(role, channels, steps, tuple(sorted(context)), coordinates, neighbours))
    return tuple(shapes)


dimensions = st.builds(
    make_dimensions,
    coupled_primitives=st.integers(1, 12),
    groups=chains(),
    heads=st.sampled_from(["separate", "paired", "shallow"]),
    width=st.integers(1, 64),
    residual_dim=st.integers(1, 9),
)


def slow_network(network: IntegerNetwork, row: list[int]) -> list[int]:
    """One row through a network, in Python's own integers."""

    inputs = [clamp(v) for v in row]
    before, taken = inputs, inputs
    for i, layer in enumerate(network.layers):
        if network.skip and i == len(network.layers) - 1:
            taken = taken + inputs
        out = []
        for o, weights in enumerate(layer.weight.tolist()):
            y = sum(w * v for w, v in zip(weights, taken, strict=True))
            y = (y + (1 << layer.shift >> 1)) >> layer.shift
            y += int(layer.bias[o])
            y = max(y, y >> 6) if layer.rectify else y
            y = clamp(y)
            out.append(clamp(y + before[o]) if layer.adds else y)
        before, taken = taken, out
    return taken


def clamp(v: int) -> int:
    return max(-(1 << 23), min(v, (1 << 23) - 1))


def slow_neighbours(own: list[int], known: list[list[int]], shift: int) -> list[tuple[int, int]]:
    """Numbers of neighbours, and their weights."""
    return [
        (j, 1 + (1 << 24) // sum(abs(a - b) for a, b in zip(own, other, strict=True)))
        for j, other in enumerate(known)
        if all(abs((a >> shift) - (b >> shift)) <= 1 for a, b in zip(own, other, strict=True))
    ]


def slow_around(
    near: list[tuple[int, int]], latents: list[list[int]], biases: list[int]
) -> tuple[list[int], list[int]]:
    """known and activity; around."""
    if not near:
        return [0, 0], [0] * len(biases)
    total = sum(w for _, w in near)
    deviations = {j: [clamp(x - b) for x, b in zip(latents[j], biases, strict=True)] for j, _ in near}
    activity = sum(w * (sum(map(abs, deviations[j])) // len(biases)) for j, w in near) // total
    around = [sum(w * deviations[j][c] for j, w in near) // total for c in range(len(biases))]
    return [4096, activity], around


def slow_latents(content: FileContent) -> list[np.ndarray]:
    """Slow twin of `dequantize`: an anchor at a time walks the chain; of residuals the slots that exist."""
    low = [min(column) // 16 * 16 for column in content.coordinates.T.tolist()]
    depth = 0
    while max(v - low[a] for row in content.coordinates.tolist() for a, v in enumerate(row)) >> depth:
        depth += 1
    offsets = [[v - low[a] for a, v in enumerate(row)] for row in content.coordinates.tolist()]
    counts, levels = level_counts(content.coordinates).tolist(), content.levels
    assert levels is not None
    rows: list[list[list[int]]] = [[] for _ in content.groups]
    for n, coordinates in enumerate(content.coordinates.tolist()):
        before = max((level for level in levels if counts[level] <= n), default=None)
        near = []
        if before is not None:
            near = slow_neighbours(offsets[n], offsets[: counts[before]], depth - before)
        place = [((2 * (v - low[a]) + 1) * 4096 >> depth) - 4096 for a, v in enumerate(coordinates)]
        latents: list[list[int]] = []
        for i, group in enumerate(content.groups):
            slots = np.atleast_2d(group.symbols[n]).tolist()
            means = [0] * sum(map(len, slots))
            if isinstance(group.prior, IntegerNetwork):
                context = place if group.shape.sees_coordinates else []
                context = sum((latents[j] for j in group.shape.context), context)
                if group.shape.sees_neighbours:
                    biases = group.prior.layers[-1].bias[: group.shape.channels].tolist()
                    two, around = slow_around(near, rows[i], biases)
                    context = context + two
                means = slow_network(group.prior, context)
                if group.shape.sees_neighbours:
                    follow, shift = group.prior.follow.weight.tolist(), group.prior.follow.shift
                    moved = [
                        (f * a + (1 << shift >> 1)) >> shift for f, a in zip(follow, around, strict=True)
                    ]
                    steps = [
                        (m - b + v + 2048) // 4096 for m, b, v in zip(means, biases, moved, strict=False)
                    ]
                    means = [clamp(b + 4096 * step) for b, step in zip(biases, steps, strict=True)]
            values = [
                [4096 * q + means[k * len(slot) + c] for c, q in enumerate(slot)]
                for k, slot in enumerate(slots)
            ]
            latents.append(values[0])
            exists = content.mask[n] if group.shape.role == Role.RESIDUAL else [True]
            rows[i] += [slot for slot, there in zip(values, exists, strict=True) if there]
    return [
        np.array(r, np.int64).reshape(-1, g.shape.channels) for r, g in zip(rows, content.groups, strict=True)
    ]


@pytest.mark.slow
@given(
    st.integers(1, 60),
    st.integers(0, 1 << 20),
    dimensions,
    st.sampled_from([0.0, 0.3, 1.0]),
    st.sampled_from([(0, 8), (1, 3), (2, 7)]),
    st.floats(0, 1),
)
@settings(max_examples=60, deadline=None)
def test_any_chain_of_groups_comes_back_with_the_latents_of_a_slow_twin(
    anchors: int, seed: int, d: Dimensions, kept: float, network: tuple[int, int], ranges: float
) -> None:
    content = make_content(anchors, seed, d, kept=kept, blocks=network[0], hidden=network[1])
    counts = level_counts(content.coordinates)
    rng = np.random.default_rng(seed)
    brings = np.flatnonzero(np.diff(counts[:-1], prepend=0) * (counts[:-1] < counts[-1]))
    levels = [int(level) for level in brings if rng.random() < ranges] + [len(counts) - 1]
    data = write_content(content, levels=levels)
    read, latents = read_latents(data)
    assert read.levels == tuple(levels)
    assert_same(read, content)
    assert (canonical_order(read.coordinates) == np.arange(anchors)).all()
    assert write_content(read) == data
    again = dequantize(read)
    for got, same, slow in zip(latents, again, slow_latents(read), strict=True):
        assert same_array(got, same)
        assert (got == slow).all() and got.dtype == np.int32


def test_dequantized_latents_are_symbols_plus_predicted_means() -> None:
    """The paper's chain (Sec. 3.3), written out."""
    content = read_content(write_content(make_content(40, 1)))
    z_f, f_hat, c_hat, z_g, g_hat = dequantize(content)
    q_f, q_c, q_g = (content.groups[i].symbols for i in (1, 2, 4))

    def means(group: Group, x: np.ndarray) -> np.ndarray:
        (layer,) = group.prior.layers
        y = x.astype(np.int64) @ layer.weight.T.astype(np.int64)
        y = ((y + (1 << (layer.shift - 1))) >> layer.shift) + layer.bias
        return y[:, : len(layer.bias) // 2]

    assert (z_f == content.groups[0].symbols * 4096).all()
    f = q_f * 4096 + means(content.groups[1], z_f)
    assert (f_hat == f).all()
    assert (c_hat == q_c * 4096 + means(content.groups[2], f)).all()
    assert (z_g == content.groups[3].symbols * 4096).all()
    g = q_g * 4096 + means(content.groups[4], np.concatenate([f, z_g], 1)).reshape(q_g.shape)
    assert (g_hat == g[content.mask]).all()


def test_the_corners_of_the_octree_are_at_plus_and_minus_one() -> None:
    """Voxels 0 and 63 of 64 are half a voxel inside of them; the origin is a multiple of 16."""
    coordinates = np.array([[-32, -17, 5], [31, -32, 0]], np.int32)
    places = surroundings(coordinates).places / 4096
    assert places[0].tolist() == [1 / 64 - 1, 31 / 64 - 1, 11 / 64 - 1]
    assert places[1].tolist() == [127 / 64 - 1, 1 / 64 - 1, 1 / 64 - 1]


def test_extreme_symbols_come_back_through_the_escape() -> None:
    content = make_content(30, 2)
    for i, group in enumerate(content.groups):
        rows = group.symbols.reshape(30, -1)
        rows[3 * i, :] = MAX_SYMBOL
        rows[3 * i + 1, :] = -MAX_SYMBOL
    content.groups[4].symbols[~content.mask] = 0
    assert_same(read_content(write_content(content)), content)


def test_order_of_anchors_does_not_change_the_bytes() -> None:
    content = make_content(200, 3)
    shuffled = reordered(content, np.random.default_rng(0).permutation(200))
    assert write_content(shuffled) == write_content(content)


def test_symbols_of_missing_coupled_primitives_are_ignored() -> None:
    content = make_content(50, 4, kept=0.5)
    residual = np.where(content.mask[:, :, None], content.groups[4].symbols, 77).astype(np.int32)
    assert write_content(with_group(content, 4, symbols=residual)) == write_content(content)


@pytest.mark.parametrize("blocks", [0, 2])
def test_groups_take_their_cross_entropy(blocks: int) -> None:
    content = make_content(8000, 5, blocks=blocks, hidden=16)
    info = file_info(write_content(content))
    sizes = {section.name: section.bytes for section in info.sections}
    assert group_names(content.dimensions) == PAPER_NAMES
    for name, bits in zip(PAPER_NAMES, cross_entropy_bits(content), strict=True):
        assert sizes[name] > 4000
        assert bits <= 8 * sizes[name] < 1.002 * bits + 64 * len(info.ranges), name


def test_results_do_not_depend_on_threads_or_block_sizes(
    monkeypatch: pytest.MonkeyPatch, with_threads: Callable[[int], None]
) -> None:
    content = make_content(3000, 6, blocks=2, hidden=16)
    with_threads(2)
    data = write_content(content)
    with_threads(1)
    monkeypatch.setattr(integer_network, "BLOCK_ROWS", 77)
    assert write_content(content) == data
    assert_same(read_content(data), content)


def test_info_accounts_for_every_byte() -> None:
    content = make_content(1200, 7)
    data = write_content(content)
    info = file_info(data)
    assert info.bytes == len(data) == sum(section.bytes for section in info.sections)
    assert (info.anchors, info.coupled, info.dimensions) == (
        1200,
        int(content.mask.sum()),
        content.dimensions,
    )
    assert info.metadata == content.metadata
    assert sum(s.bits_per_anchor for s in info.sections) == pytest.approx(info.bits_per_anchor)


def test_no_two_parts_of_a_file_share_a_name() -> None:
    """Else whoever adds them up by name loses bytes."""
    side, f = GroupShape(Role.SIDE, 2), GroupShape(Role.REFERENCE, 3, (1.0,), (0,))
    scales = GroupShape(Role.LOG_SCALES, 2, (0.5,), (1,))
    shapes = (side, side, f, replace(f, context=(1, 2)), scales, scales, scales)
    content = make_content(30, 1, make_dimensions(3, shapes, residual_dim=2))
    data = write_content(content)
    assert group_names(content.dimensions) == [
        "reference hyperprior",
        "reference hyperprior 2",
        "reference embeddings",
        "reference embeddings 2",
        "log scales",
        "log scales 2",
        "log scales 3",
    ]
    assert sum({s.name: s.bytes for s in file_info(data).sections}.values()) == len(data)


def broken(content: FileContent, name: str) -> FileContent:
    """Content with one thing that the format cannot hold."""
    tables = content.groups[0].prior
    assert isinstance(tables, tuple)
    networks = [group.prior for group in content.groups]
    shapes = [group.shape for group in content.groups]
    symbols = [group.symbols for group in content.groups]

    def reshaped(index: int, **changes: object) -> FileContent:
        return with_group(content, index, shape=replace(shapes[index], **changes))

    wide = IntegerLayer(np.ones((64, 4), np.int32), np.zeros(64, np.int64), 0, False)
    deep = [IntegerLayer(np.eye(4, dtype=np.int32), np.zeros(4, np.int64), 0, True)] * 8
    changes = {
        "no anchors": lambda: reordered(content, np.zeros(0, np.int64)),
        "shape": lambda: with_group(content, 1, symbols=symbols[1][:, 1:]),
        "dtype": lambda: with_group(content, 2, symbols=symbols[2].astype(np.float32)),
        "symbol": lambda: with_group(content, 0, symbols=symbols[0] + MAX_SYMBOL + 50),
        "voxel size": lambda: replace(content, voxel_size=float("nan")),
        "world offset": lambda: replace(content, world_offset=(0.0, float("nan"), 0.0)),
        "step": lambda: reshaped(2, steps=(0.0,)),
        "steps": lambda: reshaped(2, steps=(1.0,) * 5),
        "steps of a side group": lambda: reshaped(0, steps=(1.0,)),
        "dilation": lambda: replace(content, angular_dilation=0.0),
        "background": lambda: replace(content, background=(0.0, float("inf"), 0.0)),
        "width": lambda: replace(content, width=0),
        "heads": lambda: replace(content, heads_layout="odd"),
        "no groups": lambda: replace(content, groups=()),
        "no references": lambda: replace(content, groups=(content.groups[0], content.groups[2])),
        "log scales": lambda: replace(content, groups=content.groups[:2]),
        "residual dim": lambda: replace(content, residual_dim=5),
        "residuals as context": lambda: replace(
            content,
            groups=(*content.groups, Group(GroupShape(Role.SIDE, 1, (), (4,)), networks[1], symbols[0])),
        ),
        "too many groups": lambda: replace(content, groups=(*content.groups, *[content.groups[0]] * 12)),
        "tables": lambda: with_group(content, 0, prior=tables[1:]),
        "levels": lambda: with_group(
            content, 0, prior=(HyperTable(0, np.full(3, 200, np.uint8)), *tables[1:])
        ),
        "lowest": lambda: with_group(content, 0, prior=(HyperTable(1 << 30, tables[0].levels), *tables[1:])),
        "tables for a network": lambda: with_group(content, 1, prior=tables),
        "a network for tables": lambda: with_group(content, 0, prior=networks[1]),
        "network size": lambda: with_group(content, 2, prior=networks[1]),
        "too many layers": lambda: with_group(content, 1, prior=IntegerNetwork((*deep, wide))),
        "metadata": lambda: replace(content, metadata={"note": "x" * 5000}),
        "duplicates": lambda: replace(
            content, coordinates=np.repeat(content.coordinates[:1], len(content.coordinates), 0)
        ),
        "range": lambda: replace(content, coordinates=content.coordinates * (1 << 22)),
    }
    return changes[name]()


BROKEN = """no anchors,shape,dtype,symbol,voxel size,world offset,step,steps,steps of a side group,background,dilation,
width,heads,no groups,no references,log scales,residual dim,residuals as context,too many groups,tables,levels,lowest,
tables for a network,a network for tables,network size,too many layers,metadata,duplicates,range"""


@pytest.mark.parametrize("name", BROKEN.replace("\n", "").split(","))
def test_what_cannot_be_represented_is_refused_before_writing(name: str) -> None:
    with pytest.raises(NotEncodable):
        write_content(broken(make_content(20, 9), name))


def test_masks_must_agree_with_the_scene_section() -> None:
    a, b = (unpack(write_content(make_content(60, 10, kept=kept))) for kept in (0.2, 0.9))
    mixed = [y if x.number == MASKS else x for x, y in zip(a, b, strict=True)]
    with pytest.raises(CorruptSection, match="masks"):
        read_content(pack(mixed, OLDEST_VERSION))


def test_the_origin_of_the_world_comes_back_to_the_last_bit() -> None:
    offset = (0.1, -1e12, 2.0**-60 / 3)
    content = replace(make_content(10, 11, make_dimensions(2, paper_groups(4, 2))), world_offset=offset)
    assert read_content(write_content(content)).world_offset == offset
