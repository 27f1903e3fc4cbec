"""Files that hold a scene: `.cgs`, or `.ply` with splats. What is measured is the same for both, by the same code."""

from pathlib import Path

import torch

from compgs.codec.decoder import decode
from compgs.codec.reader import file_info
from compgs.export.ply import property_groups, read_ply, read_ply_header
from compgs.model.hybrid_model import HybridModel
from compgs.model.splats import SplatModel

SceneModel = HybridModel | SplatModel


def is_ply(path: Path) -> bool:
    """By its name."""
    return path.suffix.lower() == ".ply"


def open_scene_file(
    path: Path,
    device: torch.device | str,
    background: tuple[float, float, float],  # RGB, 0 to 1, of .ply files, which do not know theirs
) -> SceneModel:
    """A scene that can be rendered. Raises BitstreamError, SplatFileError."""
    if is_ply(path):
        return SplatModel(read_ply(path).to(device), background)
    return decode(path, device)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    if not is_ply(path):
        return {section.name: section.bytes for section in file_info(path.read_bytes()).sections}
    header = read_ply_header(path)
    names = header.row.names or ()
    groups = {name: group for group, held in property_groups(header.degree).items() for name in held}
    sizes = dict.fromkeys(dict.fromkeys(["header", *(groups.get(name, "others") for name in names)]), 0)
    for name in names:
        sizes[groups.get(name, "others")] += header.count * header.row[name].itemsize
    sizes["header"] = header.bytes - sum(sizes.values())
    return sizes
