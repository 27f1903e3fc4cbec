"""What a method trained, as the content of its file: it is rendered as it would be opened, and written as it is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from compgs.errors import SplatFileError
from compgs.formats.packed import CODECS, Packed, write_packed

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.render.render_model import Renderable

Offset = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Content:
    """Is the content of a file that is not written yet; `compgs.render` takes it."""

    packed: Packed
    background: tuple[float, float, float]  # RGB, 0 to 1, of the scene: files of splats keep none
    opens: "Callable[[Packed, Device, tuple[float, float, float]], Renderable]"  # the method's own
    codecs: tuple[str, ...] = CODECS  # that its arrays may be compressed by
    device: "Device" = "cpu"

    def as_hybrid_model(self) -> "Renderable":
        """Return the scene as a reader of the file would have it."""
        return self.opens(self.packed, self.device, self.background)

    def write(self, path: Path) -> int:
        """The number of bytes. Raises OutputError."""
        return write_packed(path, self.packed, self.codecs)


def stored_place(packed: Packed, name: str = "offset") -> Offset:
    """A place among the facts; `offset` is what positions count from. Raises SplatFileError."""
    value = packed.facts.get(name)
    numbers = value if isinstance(value, list) and len(value) == 3 else []
    if not numbers or not all(type(n) in (int, float) and abs(n) < float("inf") for n in numbers):
        raise SplatFileError(f"{packed.path}: {name}: expected three numbers, found {value!r:.60}")
    x, y, z = map(float, numbers)
    return x, y, z
