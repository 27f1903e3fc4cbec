"""Files of splats, opened by their first bytes: our own and those of other programs, readers and writers side by side.

| format | read | written | bytes a splat (degree 3) |
|---|---|---|---|
| .cgs | yes | by `compgs.encode` | |
| .ply, 3DGS | yes | yes | 248 |
| .spz 2, 3, 4 | yes | 3, 4 | about 25 |
| .sog 2, zip or meta.json | yes | yes | about 20 |
| .glb, KHR_gaussian_splatting | yes | yes | 240 |
| .splat | yes | no | 32, no harmonics |
| manifest.json of tiles, .cgs files | yes | by `write_tiles` | |
| .packed, of a method of the comparison | yes | by `compgs.methods.write` | |
"""

from compgs.formats.arrays import SplatArrays
from compgs.formats.ply import read_ply, write_ply
from compgs.formats.registry import (
    FORMATS,
    WRITERS,
    Format,
    check_scene,
    component_bytes,
    encoded,
    format_of,
    open_scene,
    scene_file,
    scene_name,
    told,
    writer_of,
)
from compgs.formats.tiled import open_tiles

__all__ = [
    "FORMATS",
    "WRITERS",
    "Format",
    "SplatArrays",
    "check_scene",
    "component_bytes",
    "encoded",
    "format_of",
    "open_scene",
    "open_tiles",
    "read_ply",
    "scene_file",
    "scene_name",
    "told",
    "write_ply",
    "writer_of",
]
