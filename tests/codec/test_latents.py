"""Ranges of octree levels: any choice gives the same scene, and a beginning of the file is its coarse part."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.codec.content import FileContent, GroupShape, Latents, Role, dequantize
from compgs.codec.fields import FieldReader, varint
from compgs.codec.format import LATENTS, MAX_RANGES, Section, pack, section_ends, unpack, version_of
from compgs.codec.latents import RangeHead, read_head
from compgs.codec.reader import RangeInfo, file_info, read_content, read_latents
from compgs.codec.writer import write_content
from compgs.errors import CorruptSection, TruncatedSection
from compgs.ordering.order import level_counts
from compgs.ordering.ranges import chosen_levels

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from made_content import make_content, make_dimensions, paper_groups

# Contexts of every kind, own residuals of both.
GROUPS = (
    GroupShape(Role.SIDE, 2),
    GroupShape(Role.REFERENCE, 3, (1.0,), (0,), sees_coordinates=True),
    GroupShape(Role.REFERENCE, 2, (1.0,), (1,)),
    GroupShape(Role.LOG_SCALES, 6, (0.5,), (), sees_coordinates=True),
    GroupShape(Role.RESIDUAL, 2, (1.0,), (1, 2, 3)),
    GroupShape(Role.RESIDUAL, 1, (1.0,)),
)


@pytest.fixture(scope="module")
def content() -> FileContent:
    """In the file's order."""
    made = make_content(150, 1, make_dimensions(3, GROUPS), kept=0.6, blocks=1)
    return read_content(write_content(made))


def allowed_levels(content: FileContent) -> list[int]:
    """A range for each level that brings anchors; the last one ends the file, though it may bring none itself."""
    counts = level_counts(content.coordinates)
    last = len(counts) - 1
    first_of = {int(count): level for level, count in reversed(list(enumerate(counts)))}
    return [*sorted(level for count, level in first_of.items() if count < counts[-1]), last]


def same_symbols(a: FileContent, b: FileContent, anchors: int | None = None) -> bool:
    """The first `anchors` of b are a."""
    pairs = [(a.coordinates, b.coordinates), (a.mask, b.mask)]
    pairs += [(x.symbols, y.symbols) for x, y in zip(a.groups, b.groups, strict=True)]
    return all(len(x) == len(y[:anchors]) and (x == y[:anchors]).all() for x, y in pairs)


def same_latents(a: Latents, b: Latents, content: FileContent, anchors: int | None = None) -> bool:
    """`a` is of the first anchors of `content`, `b` of all."""
    primitives = None if anchors is None else int(content.mask[:anchors].sum())
    return all(
        len(x) == len(y[: primitives if group.shape.role == Role.RESIDUAL else anchors])
        and (x == y[: len(x)]).all()
        for group, x, y in zip(content.groups, a, b, strict=True)
    )


@given(st.sets(st.integers(0, 20)))
@settings(max_examples=15, deadline=None)
def test_any_choice_of_levels_gives_the_same_symbols_and_latents(
    content: FileContent, some: set[int]
) -> None:
    allowed = allowed_levels(content)
    levels = sorted({level for level in allowed if level in some} | {allowed[-1]})
    data = write_content(content, levels=levels)
    read, latents = read_latents(data)
    assert same_symbols(read, content)
    assert same_latents(latents, dequantize(content), content)
    counts = level_counts(content.coordinates)
    assert [(r.level, r.anchors) for r in file_info(data).ranges] == [(v, counts[v]) for v in levels]


def test_a_beginning_up_to_any_byte_is_the_first_anchors_of_the_whole(content: FileContent) -> None:
    """Symbols and latents, exactly: at each section's end what is there, inside a section what is before it."""
    levels = allowed_levels(content)
    assert len(levels) >= 4
    data = write_content(content, levels=levels)
    whole, latents = read_latents(data)
    counts = level_counts(content.coordinates)
    ends = [end for number, end in section_ends(data) if number == LATENTS]
    assert [r.bytes for r in file_info(data).ranges] == ends
    for i, end in enumerate(ends):
        following = ends[i + 1] if i + 1 < len(ends) else len(data) + 1
        for size in {end, (end + following) // 2, following - 1}:
            part, coarse = read_latents(data[:size], prefix=True)
            assert len(part.coordinates) == counts[levels[i]]
            assert same_symbols(part, whole, len(part.coordinates))
            assert same_latents(coarse, latents, whole, len(part.coordinates))
            assert part.dimensions == whole.dimensions
            assert all(
                (x.values == y.values).all() for (_, x), (_, y) in zip(part.heads, whole.heads, strict=True)
            )
    without = read_latents(data[: ends[0]], prefix=True, keep_symbols=False)
    assert same_latents(without[1], latents, whole, counts[levels[0]])


def test_a_beginning_without_a_range_is_refused_by_the_name_of_what_is_missing(content: FileContent) -> None:
    data = write_content(content, levels=allowed_levels(content))
    first = next(end for number, end in section_ends(data) if number == LATENTS)
    with pytest.raises(
        TruncatedSection, match=f"latents: of {first - 1} bytes nothing can be shown yet, .* {first}"
    ):
        read_latents(data[: first - 1], prefix=True)
    for section, end in zip(unpack(data), section_ends(data), strict=True):
        if section.number == LATENTS:
            break
        if section.data:
            with pytest.raises(TruncatedSection, match=f"{section.name}: of {end[1] - 1} bytes nothing"):
                read_latents(data[: end[1] - 1], prefix=True)
    with pytest.raises(TruncatedSection, match="header"):
        read_latents(data[:20], prefix=True)


def test_a_file_whose_last_range_is_missing_is_refused_as_a_beginning_too(content: FileContent) -> None:
    """All that its header names has arrived, and still it does not reach the octree's depth."""
    levels = allowed_levels(content)
    data = write_content(content, levels=levels)
    sections = unpack(data)
    last = max(i for i, section in enumerate(sections) if section.number == LATENTS)
    shorter = pack(sections[:last] + sections[last + 1 :], version_of(data))
    for prefix in (False, True):
        with pytest.raises(CorruptSection, match="latents: the last level is"):
            read_latents(shorter, prefix=prefix)


def with_head(data: bytes, index: int, head: RangeHead) -> bytes:
    """The file with another head of one of its ranges."""
    sections = unpack(data)
    at = [i for i, section in enumerate(sections) if section.number == LATENTS][index]
    reader = FieldReader(sections[at].data, "latents")
    read_head(reader)
    forged = bytes([head.level]) + varint(head.anchors) + varint(head.coupled)
    sections[at] = Section(LATENTS, forged + sections[at].data[reader.position :])
    return pack(sections, version_of(data))


@pytest.mark.parametrize("prefix", [False, True])
@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ((1, 0, 0), r"latents: levels are|latents: up to level|latents: the last level"),
        ((-1, 0, 0), r"latents: levels are|latents: up to level|latents: the last level"),
        ((0, 1, 0), "latents: up to level"),
        ((0, -1, 0), "latents: up to level"),
        ((0, 0, 1), "latents: up to level"),
        ((0, 0, -1), "latents: up to level"),
        ((30, 0, 0), "latents: level is"),
        ((0, 1 << 24, 0), "latents: anchors is|scene: .* symbols"),
        ((0, 0, 1 << 24), "latents: coupled is|prediction heads: .* products"),
    ],
)
def test_forged_heads_of_ranges_are_refused(
    content: FileContent, index: int, change: tuple[int, int, int], complaint: str, prefix: bool
) -> None:
    allowed = allowed_levels(content)
    levels = [allowed[1], allowed[2], allowed[-1]]
    data = write_content(content, levels=levels)
    section = [s for s in unpack(data) if s.number == LATENTS][index]
    head = read_head(FieldReader(section.data, section.name))
    forged = RangeHead(head.level + change[0], head.anchors + change[1], head.coupled + change[2])
    with pytest.raises(CorruptSection, match=complaint):
        read_latents(with_head(data, index, forged), prefix=prefix)
    assert with_head(data, index, head) == data


def test_ranges_in_another_order_are_refused(content: FileContent) -> None:
    data = write_content(content, levels=allowed_levels(content))
    sections = unpack(data)
    ranges = [i for i, section in enumerate(sections) if section.number == LATENTS]
    sections[ranges[1]], sections[ranges[2]] = sections[ranges[2]], sections[ranges[1]]
    for prefix in (False, True):
        with pytest.raises(CorruptSection, match=r"latents: levels are .*ascending"):
            read_latents(pack(sections, version_of(data)), prefix=prefix)


def test_a_range_that_another_scene_follows_is_refused(content: FileContent) -> None:
    """Bytes behind the last group of a range."""
    data = write_content(content)
    sections = unpack(data)
    at = next(i for i, section in enumerate(sections) if section.number == LATENTS)
    sections[at] = Section(LATENTS, sections[at].data + b"\0")
    with pytest.raises(CorruptSection, match="latents: 1 bytes are left over"):
        read_content(pack(sections, version_of(data)))


@pytest.mark.parametrize(
    ("counts", "levels"),
    [
        ([1], [0]),
        ([1, 8, 64, 349], [3]),  # below 350 anchors there is one range
        ([1, 8, 64, 350], [2, 3]),  # then two: level 2 has less than two thirds of all
        ([1, 40, 236, 351], [1, 3]),  # level 2 has more than two thirds
        ([1, 40, 234, 351], [2, 3]),  # level 2 has just two thirds
        ([1, 10, 350, 350], [3]),  # level 1 has less than a 32nd, and level 2 brings nothing
        ([1, 11, 350, 350], [1, 3]),  # level 1 has a 32nd
        ([300, 400, 690, 700], [1, 3]),  # what is left below has to be two thirds
        ([1, 10, 100, 200, 400, 800, 1600], [2, 3, 4, 5, 6]),  # as many as 1600 / 350 + 1 allow
        ([1, 4, 16, 64, 256, 1024, 4096, 16384, 65536, 262144], [7, 8, 9]),  # fewer than 8192 show nothing
        ([1, *(10_000 * 2**i // 2 for i in range(5))], [1, 2, 3, 4, 5]),
        ([int(1000 * 1.6**i) for i in range(12)], [4, 5, 6, 7, 8, 9, 10, 11]),  # eight at most
    ],
)
def test_a_range_has_at_least_half_as_many_anchors_as_all_before_it(
    counts: list[int], levels: list[int]
) -> None:
    assert chosen_levels(np.array(counts)) == levels


@pytest.mark.parametrize("anchors", [350, 3_000, 30_000])
@pytest.mark.parametrize("own_residuals", [False, True])
def test_ranges_cost_less_than_one_per_cent_of_the_file(anchors: int, own_residuals: bool) -> None:
    content = make_content(
        anchors, 3, make_dimensions(5, paper_groups(residual=8 * own_residuals, residual_hyper=5))
    )
    counts = level_counts(content.coordinates)
    data, whole = write_content(content), write_content(content, levels=[len(counts) - 1])
    ranges = file_info(data).ranges
    assert len(ranges) == len(chosen_levels(counts)) > 1
    assert len(whole) < len(data) < 1.01 * len(whole)


def test_the_first_range_of_many_anchors_is_a_small_part_of_the_file() -> None:
    content = make_content(30_000, 3, make_dimensions(5, paper_groups(residual=0)))
    first: RangeInfo = file_info(write_content(content)).ranges[0]
    assert first.anchors < 0.1 * 30_000


def test_the_deepest_octree_has_levels_enough_for_every_range() -> None:
    """Two anchors at opposite ends."""
    content = make_content(2, 0, make_dimensions(1, paper_groups(1, 0, 1)))
    content.coordinates[:] = [[0, 0, 0], [(1 << 21) - 1] * 3]
    counts = level_counts(content.coordinates)
    assert len(counts) == MAX_RANGES
    data = write_content(content, levels=[0, MAX_RANGES - 1])
    assert [r.anchors for r in file_info(data).ranges] == [1, 2]
    assert len(read_content(data).coordinates) == 2
