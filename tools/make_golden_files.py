"""Writes tests/golden: small files of this version of the format, and hashes of what they decode to.

    python tools/make_golden_files.py

Run it when the version of the format rises, and only then: golden files of a version decode for ever. (`rows` is of
version 5, `dilated` of version 4 and `neighbours` of version 3; the others are of version 2.)
"""

import hashlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from compgs.codec.content import FileContent, GroupShape, Latents, Role
from compgs.codec.format import MAX_SYMBOL
from compgs.codec.reader import read_latents
from compgs.codec.viewpoints import Viewpoint, Viewpoints
from compgs.codec.writer import write_content

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
# Those that stay as they are: these, and one of version 4, which is not written any more.
KEPT = (*TRAINED, "dilated")


def contents() -> dict[str, tuple[FileContent, list[int] | None]]:
    """Content and levels of the ranges, by name: the smallest sensible file, one as the default preset makes it, one as
    it makes small ones, one as the paper's preset does, one with neighbours, one as training writes them, whose rows
    say something, one with everything unusual.
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
        "odd": odd(),
    }


def rows() -> FileContent:
    dimensions = make_dimensions(4, ROWS_GROUPS)
    content = make_content(120, 7, dimensions, kept=0.7, angular_dilation=DILATION, row_context=True)
    for i in (0, 4):  # some far out, which are escaped and count for no more than others
        content.groups[i].symbols[::11] *= 12
    return replace(content, viewpoints=VIEWPOINTS)


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


def hashes(content: FileContent, latents: Latents) -> dict[str, str]:
    """SHA-256 of each array as little-endian 32-bit integers (the mask as bytes), in canonical order."""
    arrays = {"coordinates": content.coordinates, "mask": content.mask}
    for i, (group, values) in enumerate(zip(content.groups, latents, strict=True)):
        name = f"group {i}, {group.shape.role.name.lower().replace('_', ' ')}"
        arrays |= {f"{name}: symbols": group.symbols, f"{name}: latents": values}
    return {
        name: hashlib.sha256(array.astype("u1" if array.dtype == np.bool_ else "<i4").tobytes()).hexdigest()
        for name, array in arrays.items()
    }


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
    _write(GOLDEN / "hashes.json", (json.dumps(pinned, indent=2) + "\n").encode())


def _write(path: Path, data: bytes) -> None:
    temporary = path.with_name(f".{path.name}.partial")
    temporary.write_bytes(data)
    os.replace(temporary, path)


if __name__ == "__main__":
    main()
