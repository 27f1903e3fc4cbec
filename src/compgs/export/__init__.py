"""Files for other programs: .ply as 3DGS writes it, which most viewers of splats read."""

from compgs.export.ply import read_ply, write_ply

__all__ = ["read_ply", "write_ply"]
