"""Writes files for the tests of web/, and what the Python package decodes of them.

    PYTHONPATH=src python web/test/make_fixtures.py FOLDER [FILE.cgs ...]

FOLDER gets, for each made-up content and each file that is named:

- NAME.cgs, the file;
- NAME.json: hashes of its arrays, as in tests/golden/hashes.json, of the whole and of each prefix that ends with a
  section of latents; numbers of the scene; and the Gaussians that a camera sees, as offsets into NAME.bin;
- NAME.bin: little-endian float32 arrays: those of FIELDS, then the sizes that scales are shares of.

and refused.json: damaged files, with the name of the error of each, or the number of anchors; and city.tiles, a scene
of tiles.
"""

import base64
import hashlib
import itertools
import json
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.append(str(ROOT / "benchmarks"))
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402
from made_heads import make_heads  # noqa: E402

from compgs.cameras import Camera  # noqa: E402
from compgs.codec.content import FileContent, GroupShape, Latents, Role  # noqa: E402
from compgs.codec.decoder import from_latents  # noqa: E402
from compgs.codec.format import MAX_SYMBOL  # noqa: E402
from compgs.codec.reader import file_info, read_latents  # noqa: E402
from compgs.codec.viewpoints import Viewpoint, Viewpoints  # noqa: E402
from compgs.codec.writer import write_content  # noqa: E402
from compgs.errors import BitstreamError  # noqa: E402
from compgs.formats.tile_detail import wanted_levels  # noqa: E402
from compgs.formats.tiled import read_manifest  # noqa: E402
from compgs.formats.tiled_writer import NewTile, write_tiles  # noqa: E402
from compgs.ordering.order import canonical_order, level_counts  # noqa: E402

FIELDS = {"means": 3, "quaternions": 4, "scales": 3, "opacities": 1, "colors": 3}  # columns
STEPS = (0.25, 0.25, 0.25, 0.0625, 0.125, 0.0625)
# Several groups of each role, coordinates as context, steps of their own, residuals in two groups.
MANY_GROUPS = (
    GroupShape(Role.SIDE, 3, sees_coordinates=True),
    GroupShape(Role.REFERENCE, 5, (0.5,), (0,)),
    GroupShape(Role.SIDE, 2, context=(0, 1)),
    GroupShape(Role.REFERENCE, 2, (0.25, 2.0), (0, 2), sees_coordinates=True),
    GroupShape(Role.LOG_SCALES, 2, (0.0625,)),
    GroupShape(Role.LOG_SCALES, 4, STEPS[2:], (1, 3)),
    GroupShape(Role.RESIDUAL, 1, (0.5,)),
    GroupShape(Role.RESIDUAL, 3, (1.0, 0.5, 0.25), (2, 3, 5), sees_coordinates=True),
)
# A network of each kind takes what neighbours have: alone, with other groups, with coordinates, behind both.
NEIGHBOURS = (
    GroupShape(Role.SIDE, 2, sees_neighbours=True),
    GroupShape(Role.REFERENCE, 5, (0.5,), (0,), sees_neighbours=True),
    GroupShape(Role.REFERENCE, 3, (0.5, 1.0, 2.0), (1,), sees_coordinates=True, sees_neighbours=True),
    GroupShape(Role.SIDE, 1, sees_coordinates=True, sees_neighbours=True),
    GroupShape(Role.LOG_SCALES, 6, STEPS, (0, 2), sees_neighbours=True),
    GroupShape(Role.RESIDUAL, 2, (1.0,), (1, 3)),
)
WITH_ROWS: dict[str, Any] = {"angular_dilation": 2.0**-18, "row_context": True}
MUTANTS = 150
SIDE = 5  # tiles of the city
STARTS = (b"", b"\x93", b"\x93CG", b"CGS", b"\x93CGS", b"\x93CGS\2\0", b"\x93CGS\1\0\5", b"PK\3\4")
# In place of levels: a range for each that has anchors of its own, and one for all of them.
EVERY_LEVEL, ONE_RANGE = [-1], [-2]


def contents() -> dict[str, tuple[FileContent, list[int] | None]]:
    """Content and levels of the ranges, by name."""
    shared = make_dimensions(5, paper_groups(12, 0))
    made = {
        "one_anchor": (make_content(1, 1, shared, kept=1.0), None),
        "two_anchors": (make_content(2, 2, shared), None),
        "shared": (make_content(900, 3, shared, blocks=2, hidden=12), None),
        "paper": (make_content(700, 4, make_dimensions(10, paper_groups(16, 4)), blocks=1, hidden=8), None),
        "many_groups": (
            make_content(500, 5, make_dimensions(4, MANY_GROUPS, "separate", 24), kept=0.6),
            EVERY_LEVEL,
        ),
        "full_mask": (make_content(400, 6, make_dimensions(3, paper_groups(8, 2)), kept=2.0), None),
        "no_coupled": (make_content(30, 7, shared, kept=-1.0), None),
        "wide": (make_content(120, 8, make_dimensions(64, paper_groups(4, 1, 1, 1)), kept=0.3), None),
    }
    near = make_dimensions(3, NEIGHBOURS, width=16)
    made["neighbours"] = (make_content(600, 13, near, kept=0.5, blocks=1), EVERY_LEVEL)
    made["dilated"] = (make_content(300, 15, near, kept=0.5, angular_dilation=2.0**-18), EVERY_LEVEL)
    wild = make_content(900, 14, near, kept=0.5)
    for group in wild.groups:
        group.symbols[::7] *= 900  # beyond what a network takes
    made["deep_neighbours"] = (replace(wild, coordinates=wild.coordinates * 7001), None)
    many = make_dimensions(4, MANY_GROUPS, "separate", 24)
    made["rows"] = (make_content(400, 16, many, kept=0.6, **WITH_ROWS), EVERY_LEVEL)
    unlike = make_content(500, 17, near, kept=0.5, **WITH_ROWS)
    for group in unlike.groups:
        group.symbols[::7] *= 900  # escapes amid rows, whose values need the tables that were used
    made["unlike_rows"] = (unlike, EVERY_LEVEL)
    # Its references are more than a chunk, whose end is amid a row.
    long = make_content(30_000, 18, make_dimensions(2, paper_groups(37, 0)), **WITH_ROWS)
    made["chunks_of_rows"] = (long, ONE_RANGE)
    escapes = make_content(200, 9, make_dimensions(3, paper_groups(4, 2)))
    for group in escapes.groups:
        existing = group.symbols if group.shape.role != Role.RESIDUAL else group.symbols[escapes.mask]
        existing[::7] *= 900
        existing[3, -1], existing[4, 0] = -MAX_SYMBOL, MAX_SYMBOL
        if group.shape.role == Role.RESIDUAL:
            group.symbols[escapes.mask] = existing
    made["escapes"] = (replace(escapes, metadata={"note": "Ä", "creator": "made up"}), None)
    views = Viewpoints((0.0, -0.8, 0.6), tuple(_viewpoint(i) for i in range(3)))
    far = make_content(300, 10, shared)
    coordinates = far.coordinates - 100_000
    made["far"] = (
        replace(far, coordinates=coordinates, world_offset=(4.5e6, -2.25e5, 1.0), viewpoints=views),
        None,
    )
    spread = make_content(600, 11, shared)
    made["deep"] = (replace(spread, coordinates=spread.coordinates * 9001), None)  # single anchors high up
    made["two_states"] = (make_content(30_000, 12, make_dimensions(2, paper_groups(12, 0))), None)
    return {name: (_with_heads(content), levels) for name, (content, levels) in made.items()}


def _viewpoint(i: int) -> Viewpoint:
    q = np.array([0.5 - 0.4 * i, 0.7, -0.1, 0.3])
    q /= np.linalg.norm(q) * (1 if q[0] >= 0 else -1)
    w, x, y, z = (float(v) for v in q)
    return Viewpoint((w, x, y, z), (1.0 + i, -2.0, 3.5 * i), 640, 480, 500.0 + i, 510.0)


def _with_heads(content: FileContent) -> FileContent:
    heads = make_heads(np.random.default_rng(5), content.dimensions)
    return replace(content, heads=heads)


def hashes(content: FileContent, latents: Latents) -> dict[str, str]:
    stored = dict(content.heads)
    tensors = [stored[name] for name in content.dimensions.head_shapes]
    heads = np.concatenate([np.append(tensor.exponent, tensor.values) for tensor in tensors])
    arrays = {"coordinates": content.coordinates, "mask": content.mask, "heads": heads}
    for i, (group, values) in enumerate(zip(content.groups, latents, strict=True)):
        name = f"group {i}, {group.shape.role.name.lower().replace('_', ' ')}"
        arrays |= {f"{name}: symbols": group.symbols, f"{name}: latents": values}
    return {
        name: hashlib.sha256(array.astype("u1" if array.dtype == np.bool_ else "<i4").tobytes()).hexdigest()
        for name, array in arrays.items()
    }


def expected(data: bytes) -> tuple[dict[str, Any], bytes]:
    """What NAME.json and NAME.bin hold."""
    content, latents = read_latents(data)
    ends = [r.bytes for r in file_info(data).ranges]
    prefixes = {}
    for end in ends[:-1]:
        part, part_latents = read_latents(data[: end + 5], prefix=True)
        assert part.stands_for is not None
        prefixes[end] = hashes(part, part_latents) | {"stands_for": part.stands_for.tolist()}
    views = content.viewpoints
    model = from_latents(content, latents)
    camera = _camera(content)
    found, index = model.drawn(camera.moved(content.world_offset))
    values = {name: getattr(found, name).astype(np.float64) for name in FIELDS}
    drawn = _sound(values)
    arrays = [values[name][drawn].astype("<f4") for name in FIELDS]
    p = model.primitives
    arrays.append(p.spread()[p.anchor_index[index], 3:][drawn].astype("<f4"))
    return {
        "hashes": hashes(content, latents),
        "prefixes": prefixes,
        "anchors": len(content.coordinates),
        "coupled": int(content.mask.sum()),
        "voxel_size": content.voxel_size,
        "world_offset": list(content.world_offset),
        "background": list(content.background),
        "angular_dilation": content.angular_dilation,
        "metadata": content.metadata,
        "viewpoints": None
        if views is None
        else {
            "up": list(views.up),
            "views": [
                {
                    "rotation": list(v.rotation),
                    "center": list(v.center),
                    "lens": [v.width, v.height, v.fx, v.fy],
                }
                for v in views.views
            ],
        },
        "world_to_camera": camera.world_to_camera.ravel().tolist(),
        "gaussians": int(drawn.sum()),
    }, b"".join(array.tobytes() for array in arrays)


def _sound(values: dict[str, np.ndarray]) -> np.ndarray:  # [M] bool
    """Which primitives reach a renderer: the package leaves it to its renderers to skip those beyond float32."""
    everything = np.concatenate([values[name].reshape(-1, columns) for name, columns in FIELDS.items()], 1)
    return (np.abs(everything) < 2.0**127).all(1) & (
        np.linalg.norm(values["quaternions"], axis=1) >= 2.0**-60
    )


def _camera(content: FileContent) -> Camera:
    """Beside the middle of the anchors, turned a little, in the world."""
    extent = float(np.ptp(content.coordinates, axis=0).max() + 8) * content.voxel_size
    centre = content.coordinates.mean(0) * content.voxel_size + extent * np.array((0.5, -1.0, 0.25))
    turn = 0.3
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ (centre + np.array(content.world_offset))
    return Camera(pose, 50, 50, 32, 32, 64, 64)


def refused(files: dict[str, bytes]) -> list[dict[str, Any]]:
    """Damaged files and what the package says of each, whole and as beginnings; null where it decodes them."""
    rng = np.random.default_rng(0)
    cases = []
    names = sorted(files)
    for i in range(MUTANTS):
        data = bytearray(files[names[i % len(names)]])
        kind = i % 5
        at = int(rng.integers(0, min(len(data), 140) if i % 2 else len(data)))
        if kind == 0:
            data = data[:at]
        elif kind == 1:
            data[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 2:
            data += b"\0"
        else:  # a damaged payload under checksums that match it
            _damage_payload(data, rng)
        cases += [_case(bytes(data), prefix=False), _case(bytes(data), prefix=True)]
    return cases + [_case(start, prefix=prefix) for start in STARTS for prefix in (False, True)]


def _damage_payload(data: bytearray, rng: np.random.Generator) -> None:
    count = data[6]
    start = 11 + 9 * count
    chosen = int(rng.integers(0, count))
    for i in range(count):
        entry = 7 + 9 * i
        length = int.from_bytes(data[entry + 1 : entry + 5], "little")
        if i == chosen and length:
            at = start + int(rng.integers(0, min(length, 80)))
            data[at] = int(rng.integers(0, 256))
            data[entry + 5 : entry + 9] = zlib.crc32(data[start : start + length]).to_bytes(4, "little")
        start += length
    data[7 + 9 * count : 11 + 9 * count] = zlib.crc32(data[: 7 + 9 * count]).to_bytes(4, "little")


def _case(data: bytes, *, prefix: bool) -> dict[str, Any]:
    """The bytes, whether they are decoded as the beginning of a file, and what comes of it."""
    error, anchors = None, 0
    try:
        anchors = len(read_latents(data, prefix=prefix)[0].coordinates)
    except BitstreamError as refused:
        error = type(refused).__name__
    return {"data": base64.b64encode(data).decode(), "prefix": prefix, "error": error, "anchors": anchors}


def _written(content: FileContent, levels: list[int] | None) -> bytes:
    if levels in (EVERY_LEVEL, ONE_RANGE):
        counts = level_counts(content.coordinates[canonical_order(content.coordinates)])
        every = [level for level, count in enumerate(counts) if level == 0 or count > counts[level - 1]]
        levels = every if levels == EVERY_LEVEL else every[-1:]
    return write_content(content, levels=levels)


def city(folder: Path) -> None:
    """SIDE x SIDE tiles side by side along x and z, each from coarse to fine; and how many levels of each the package
    draws for some cameras that see all of them.
    """
    content = _with_heads(make_content(900, 19, make_dimensions(5, paper_groups(12, 0))))
    pitch = float(np.ptp(content.coordinates, axis=0).max()) * content.voxel_size
    tiles = []
    for i, j in itertools.product(range(SIDE), repeat=2):
        placed = replace(content, world_offset=(i * pitch, 0.0, j * pitch))
        tiles.append(NewTile(f"{i}_{j}", _written(placed, EVERY_LEVEL)))
    manifest = read_manifest(write_tiles(folder, tiles))
    middle = np.mean([sphere[:3] for tile in manifest.tiles for sphere in tile.spheres], axis=0)
    cases = []
    for height, most in itertools.product((5, 9, 40, 200), (2_000, 9_000, 10**9)):
        rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # straight down
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (middle - np.array((0, height * pitch, 0)))
        camera = Camera(pose, 500, 500, 640, 400, 1280, 800)
        lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy")}
        sight = lens | {"centre": camera.center.tolist(), "rotation": rotation.ravel().tolist()}
        levels = wanted_levels(manifest.tiles, camera, most)
        cases.append({"sight": sight, "most": most, "levels": levels})
    (folder / "wanted.json").write_text(json.dumps(cases))


def main() -> None:
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    files = {name: _written(content, levels) for name, (content, levels) in contents().items()}
    small = {name: data for name, data in files.items() if len(data) < 20_000}
    files |= {Path(path).stem: Path(path).read_bytes() for path in sys.argv[2:]}
    for name, data in files.items():
        description, arrays = expected(data)
        (folder / f"{name}.cgs").write_bytes(data)
        (folder / f"{name}.json").write_text(json.dumps(description))
        (folder / f"{name}.bin").write_bytes(arrays)
        print(f"{name}: {len(data)} bytes, {description['gaussians']} Gaussians")
    (folder / "refused.json").write_text(json.dumps(refused(small)))
    city(folder / "city.tiles")


if __name__ == "__main__":
    main()
