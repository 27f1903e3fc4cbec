"""Files of splats: our own and those of other programs, readers and writers side by side. `compgs.opening` knows them
by their first bytes.

| format | read | written | bytes a splat (degree 3) |
|---|---|---|---|
| .cgs | yes | by `compgs.encode` | |
| .ply, 3DGS; 2DGS, text | yes | 3DGS | 248 |
| .compressed.ply, SuperSplat | yes | no | 16 to 61 |
| .spz 1 to 4 | yes | 3, 4 | 65 before packing |
| .sog 1, 2, zip or meta.json | yes | 2 | about 25 |
| lod-meta.json, .sog of several levels | yes | by `compgs.export` | as .sog, each level |
| .glb, .gltf, KHR_gaussian_splatting | yes | .glb | 240 |
| .ksplat, GaussianSplats3D | yes | no | 24 to 140, degree 2 at most |
| .splat | yes | no | 32, no harmonics |
| manifest.json of tiles, .cgs files | yes | by `write_tiles`, `compgs.export` | |
| .packed, of a method of the comparison | yes | by `compgs.methods.write` | |
"""

from compgs.formats.arrays import SplatArrays
from compgs.formats.ply import read_ply, write_ply
from compgs.formats.writing import WRITERS, encoded, told, writer_of

__all__ = [
    "WRITERS",
    "SplatArrays",
    "encoded",
    "read_ply",
    "told",
    "write_ply",
    "writer_of",
]
