"""Sparse points that `transforms.json` names."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import SceneError
from compgs.scene.capture import check_inside
from compgs.scene.names import Names
from compgs.scene.ply_points import read_ply_points
from compgs.scene.transforms import file_path
from compgs.scene.views import Points


def points_of(values: Mapping[str, Any], file: Path) -> tuple[Points, tuple[Path, ...], tuple[str, ...]]:
    """Read the points of `ply_file_path`, else none; the file that was read, and what is to be noted. Raises
    SceneError.
    """
    nothing = Points(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))
    ply, folder = values.get("ply_file_path"), file.parent
    if ply is None:
        return nothing, (), ()
    if not isinstance(ply, str):
        raise SceneError(f"{file}: ply_file_path is {ply!r:.60}; expected a path")
    relative = file_path(dict(values), str(file), "ply_file_path")
    check_inside(folder / relative, (folder,), f"ply_file_path {relative!r}")
    found = Names().find(folder, relative, (".ply",))
    if found is None:
        note = f"ply_file_path: {folder / relative} does not exist: the points in it are not used"
        return nothing, (), (note,)
    return read_ply_points(found), (found,), ()
