"""Writes tests/golden: small files of this format, and hashes of what they and their beginnings decode to.

    python tools/make_golden_files.py

Run it when the version of the format rises, and only then: golden files of a version decode for ever. (`rows`, `long`
and `foreign2` are of version 5, `dilated` and `foreign1` of version 4, `neighbours` and `foreign0` of version 3; the
others are of version 2.)
"""

import hashlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from compgs.codec.content import FileContent, GroupShape, Latents, Role, reordered
from compgs.codec.format import MAX_SYMBOL
from compgs.codec.integer_network import FRACTION_BITS, IntegerLayer, IntegerNetwork
from compgs.codec.rans import CHUNK_SYMBOLS
from compgs.codec.reader import file_info, read_latents
from compgs.codec.rows import RowContext
from compgs.codec.viewpoints import Viewpoint, Viewpoints
from compgs.codec.writer import write_content
from compgs.ordering.order import canonical_order, octree_depth, octree_origin

ROOT = Path(__file__).parent.parent
GOLDEN = ROOT / "tests" / "golden"
sys.path.append(str(ROOT / "benchmarks"))
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402

DEFAULT_STEPS = (0.125, 0.15, 0.1, 0.2, 0.25, 0.175)  # of the log scales, as training learns them: six

# Several groups of a role, each given others; coordinates as context, beside latents and alone; tables for a group of
# every role.
ODD_GROUPS = (
    GroupShape(Role.SIDE, 2),
    GroupShape(Role.SIDE, 3, (), (0,)),
    GroupShape(Role.REFERENCE, 4, (0.5,), (1,)),
    GroupShape(Role.REFERENCE, 3, (1.0, 2.0, 0.25), (1, 2), sees_coordinates=True),
    GroupShape(Role.REFERENCE, 2, (0.75,)),
    GroupShape(Role.LOG_SCALES, 2, (0.25,)),
    GroupShape(Role.LOG_SCALES, 4, (0.125, 0.25, 0.5, 0.0625), (), sees_coordinates=True),
    GroupShape(Role.RESIDUAL, 1, (0.5,)),
    GroupShape(Role.RESIDUAL, 2, (1.0, 0.5), (2, 3, 6), sees_coordinates=True),
)

# As the default preset has them in small files: nothing is known of a reference before it is decoded.
CONSTANT_GROUPS = (
    GroupShape(Role.REFERENCE, 12, (0.33,), (), sees_coordinates=True),
    GroupShape(Role.LOG_SCALES, 6, DEFAULT_STEPS, (0,)),
)

# What neighbours have as context: alone, as the default preset has it, and beside all else.
NEIGHBOUR_GROUPS = (
    GroupShape(Role.SIDE, 2, sees_neighbours=True),
    GroupShape(Role.REFERENCE, 8, (0.33,), sees_neighbours=True),
    GroupShape(Role.REFERENCE, 3, (0.5,), (0, 1), sees_coordinates=True, sees_neighbours=True),
    GroupShape(Role.LOG_SCALES, 6, DEFAULT_STEPS, (1,)),
)

# As the default preset has them, and beside these, of coupled primitives and with a single channel.
ROWS_GROUPS = (
    GroupShape(Role.REFERENCE, 12, (0.33,), sees_neighbours=True),
    GroupShape(Role.LOG_SCALES, 6, DEFAULT_STEPS, (0,)),
    GroupShape(Role.SIDE, 3),
    GroupShape(Role.RESIDUAL, 1, (0.5,), (0,)),
    GroupShape(Role.RESIDUAL, 3, (0.5, 1.0, 0.25), (0, 2)),
)
DILATION = float(np.float32(0.3 / 500**2))

# More symbols than a chunk has, whose end is amid a row; and a few more than a chunk of one state has.
LONG_GROUPS = (
    GroupShape(Role.REFERENCE, 255, (0.33,), sees_coordinates=True),
    GroupShape(Role.SIDE, 64, sees_coordinates=True),
    GroupShape(Role.LOG_SCALES, 6, (0.125,), sees_coordinates=True),
)
LONG_ANCHORS = 4113
LONG_TABLES = (30, 0, 36)

VIEWPOINTS = Viewpoints(
    up=(0.0, -0.6, 0.8),
    views=(
        Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 640, 480, 500.0, 510.0),
        Viewpoint((0.5, -0.5, 0.5, 0.5), (2.0, 0.25, 1.0), 640, 480, 500.0, 510.0),
        Viewpoint((0.0, 0.6, 0.0, 0.8), (-1.0, 2.0, 0.5), 480, 640, 450.5, 450.5),
    ),
)


# Files that a training wrote, of the scene of `compgs demo-scene` in 24 views of 128 x 96 pixels, with
# `--preset quick --steps 300`, model.max_anchors=150, control.start=0 and control.stop=0.
TRAINED = ("trained",)
# Files of another encoder, written from the document alone, with choices that this one does not make: groups and
# networks of all kinds at random, wild weights, extreme and escaped symbols, up to five ranges; of the versions 3, 4
# and 5. They show what ours do not: rounding and clamping at their limits.
FOREIGN = ("foreign0", "foreign1", "foreign2")
# Those that stay as they are: these, and one of version 4, which is not written any more.
KEPT = (*TRAINED, *FOREIGN, "dilated")


def contents() -> dict[str, tuple[FileContent, list[int] | None]]:
    """Content and levels of the ranges, by name: the smallest sensible file, one as the default preset makes it, one as
    it makes small ones, one as the paper's preset does, one with neighbours, one as training writes them, whose rows
    say something, one whose heads are shallow, one with everything unusual, one of several chunks.
    """
    tiny = make_content(3, 1, make_dimensions(2, paper_groups(2, 0, 1), width=2, residual_dim=2), kept=0.7)
    default = make_content(800, 2, make_dimensions(5, paper_groups(12, 0)))
    shapes = [g.shape for g in default.groups]
    scales = replace(default.groups[2], shape=replace(shapes[2], steps=DEFAULT_STEPS))
    default = replace(default, groups=(*default.groups[:2], scales))
    constant = make_content(300, 5, make_dimensions(5, CONSTANT_GROUPS))
    for layer in constant.groups[0].prior.layers:
        layer.weight[:] = 0
    paper = make_content(60, 4, make_dimensions(10, paper_groups(16, 4)), blocks=2, hidden=12)
    neighbours = make_content(500, 6, make_dimensions(5, NEIGHBOUR_GROUPS))
    made = {
        "tiny": tiny,
        "default": default,
        "constant": constant,
        "paper": paper,
        "neighbours": neighbours,
    }
    return {
        **{name: (content, None) for name, content in made.items()},
        "rows": (rows(), [3, 5, 7]),
        "shallow": (shallow(), None),
        "odd": odd(),
        "long": (long(), [depth_of(long())]),
    }


def rows() -> FileContent:
    dimensions = make_dimensions(4, ROWS_GROUPS)
    content = make_content(120, 7, dimensions, kept=0.7, angular_dilation=DILATION, row_context=True)
    for i in (0, 4):  # some far out, which are escaped and count for no more than others
        content.groups[i].symbols[::11] *= 12
    return replace(content, viewpoints=VIEWPOINTS)


def shallow() -> FileContent:
    d = make_dimensions(3, ROWS_GROUPS, "shallow", width=6)
    return make_content(90, 8, d, kept=0.6, angular_dilation=DILATION, row_context=True)


def odd() -> tuple[FileContent, list[int]]:
    content = make_content(70, 3, make_dimensions(5, ODD_GROUPS, "separate", 8), kept=0.4, blocks=1, hidden=9)
    for i, group in enumerate(content.groups):
        if group.shape.role == Role.RESIDUAL:
            group.symbols[content.mask] += 300 * i
            continue
        group.symbols[::9] *= 1000
        group.symbols[4, -1] = -MAX_SYMBOL
        group.symbols[5, 0] = MAX_SYMBOL
    content = replace(content, world_offset=(-1.5, 1e6, 0.1), metadata={"note": "Ä", "creator": "made up"})
    return replace(content, viewpoints=VIEWPOINTS), [0, 4, 7]


def long() -> FileContent:
    """A million symbols, nearly all of them 0 and expected to be: two chunks, the first with two states; and a
    stream of two states and no more. Rows have inertia, and in that of the chunk's end large symbols move the tables.
    """
    d = make_dimensions(2, LONG_GROUPS, width=1, residual_dim=2)
    content = make_content(LONG_ANCHORS, 9, d, symbols=False, kept=1.0, angular_dilation=DILATION)
    content = reordered(content, canonical_order(content.coordinates))
    content.mask[1::2, 1] = False
    priors = [
        _constant(group.shape.channels, table)
        for group, table in zip(content.groups, LONG_TABLES, strict=True)
    ]
    references, side, scales = (group.symbols for group in content.groups)
    references[::97, ::61] = 1
    references[700, 3], references[2000, 254] = 5, -3000
    row, crossing = divmod(CHUNK_SYMBOLS, references.shape[1])
    references[row, : crossing + 6] = np.resize((2, -1, 1, -2), crossing + 6)
    side[::101, 5] = -1
    scales[:, 2] = np.random.default_rng(9).integers(-1, 2, LONG_ANCHORS)
    groups = [replace(group, prior=prior) for group, prior in zip(content.groups, priors, strict=True)]
    return replace(content, groups=tuple(groups))


def _constant(channels: int, table: int) -> IntegerNetwork:
    """Means of 0 and always the same table, but for what inertia does to it."""
    bias = np.repeat([0, table << FRACTION_BITS], channels).astype(np.int64)
    layer = IntegerLayer(np.zeros((2 * channels, 3), np.int32), bias, 0, False)
    return IntegerNetwork((layer,), rows=RowContext(None, 1))


def depth_of(content: FileContent) -> int:
    return octree_depth(content.coordinates.astype(np.int64) - octree_origin(content.coordinates))


def hashes(content: FileContent, latents: Latents) -> dict[str, str]:
    """SHA-256 of each array as little-endian 32-bit integers (the mask as bytes), in canonical order; of the heads, the
    exponent and the integers of each tensor in the order of version 5.
    """
    arrays = {"coordinates": content.coordinates, "mask": content.mask, "heads": head_integers(content)}
    for i, (group, values) in enumerate(zip(content.groups, latents, strict=True)):
        name = f"group {i}, {group.shape.role.name.lower().replace('_', ' ')}"
        arrays |= {f"{name}: symbols": group.symbols, f"{name}: latents": values}
    return {
        name: hashlib.sha256(array.astype("u1" if array.dtype == np.bool_ else "<i4").tobytes()).hexdigest()
        for name, array in arrays.items()
    }


def head_integers(content: FileContent) -> np.ndarray:
    stored = dict(content.heads)
    tensors = [stored[name] for name in content.dimensions.head_shapes]
    return np.concatenate([np.append(tensor.exponent, tensor.values) for tensor in tensors])


def prefix_hashes(data: bytes) -> dict[str, dict[str, str]]:
    """By number of bytes: of beginnings of a file that end with a range, and of one that ends amid the last range."""
    ends = [part.bytes for part in file_info(data).ranges]
    sizes = [*ends[:-1], (ends[-2] + ends[-1]) // 2] if len(ends) > 1 else []
    return {str(size): hashes(*read_latents(data[:size], prefix=True)) for size in sizes}


def main() -> None:
    GOLDEN.mkdir(parents=True, exist_ok=True)
    pinned = {}
    for name, (content, levels) in contents().items():
        data = write_content(content, levels=levels)
        _write(GOLDEN / f"{name}.cgs", data)
        pinned[name] = {"file": hashlib.sha256(data).hexdigest(), **hashes(*read_latents(data))}
        print(f"{name}.cgs: {len(data)} bytes")
    for name in KEPT:
        data = (GOLDEN / f"{name}.cgs").read_bytes()
        pinned[name] = {"file": hashlib.sha256(data).hexdigest(), **hashes(*read_latents(data))}
    _write_json(GOLDEN / "hashes.json", pinned)
    files = {name: (GOLDEN / f"{name}.cgs").read_bytes() for name in pinned}
    prefixes = {name: prefix_hashes(data) for name, data in files.items()}
    _write_json(GOLDEN / "prefixes.json", {name: found for name, found in prefixes.items() if found})


def _write_json(path: Path, values: dict) -> None:
    _write(path, (json.dumps(values, indent=2) + "\n").encode())


def _write(path: Path, data: bytes) -> None:
    temporary = path.with_name(f".{path.name}.partial")
    temporary.write_bytes(data)
    os.replace(temporary, path)


if __name__ == "__main__":
    main()
