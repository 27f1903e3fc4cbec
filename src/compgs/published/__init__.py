"""Files of the other methods, as they published them: readers and writers, without what trains them.

| file | holds |
|---|---|
| `c3dgs`, `compact3d`, `lightgaussian` | splats that share entries of codebooks |
| `eagles` | splats decoded from integer latents |
| `compact_3dgs/` | splats colored by a hash grid and a network |
| `scaffold_gs` | anchors and their networks, uncompressed |
| `cosa/` | anchors in a causal chain, entropy coded |
| `anchors` | a scene of such anchors, drawn on the CPU |
| `parts/` | what several of these are made of |

All of them are kept in one container (`compgs.formats.packed`), which says the method. Nothing here loads torch.
"""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.formats.packed import Packed
    from compgs.render.render_model import Renderable

# Opens the content of a container as a scene: on a device, over a background (RGB, 0 to 1). Raises SplatFileError.
Opens = Callable[["Packed", "Device", tuple[float, float, float]], "Renderable"]


def _opened_by(module: str) -> Opens:
    """The function `opened` of a module of this package, which is loaded when it is needed."""

    def opened(packed: "Packed", device: "Device", background: tuple[float, float, float]) -> "Renderable":
        scene: Renderable = import_module(f"{__name__}.{module}").opened(packed, device, background)
        return scene

    return opened


# By the method's name in `compgs.methods`.
READERS: dict[str, Opens] = {
    "c3dgs": _opened_by("c3dgs"),
    "compact3d": _opened_by("compact3d"),
    "lightgaussian": _opened_by("lightgaussian"),
    "eagles": _opened_by("eagles"),
    "compact-3dgs": _opened_by("compact_3dgs.file"),
    "scaffold-gs": _opened_by("scaffold_gs"),
    "cosa-gs": _opened_by("cosa.reader"),
}
