"""Our own files, as one format among others: `compgs.codec` reads them."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.model.hybrid_model import HybridModel


def begins(head: bytes) -> bool:
    """Whether a file begins as a .cgs does."""
    from compgs.codec.format import MAGIC

    return head.startswith(MAGIC)


def check(path: Path) -> None:
    """Raises BitstreamError if the file is not whole."""
    from compgs.codec.format import named, unpack

    with named(path):
        unpack(path.read_bytes())


def read(path: Path, device: "Device") -> "HybridModel":
    """Raises BitstreamError."""
    from compgs.codec.decoder import decode

    return decode(path, device)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    from compgs.codec.reader import file_info

    return {section.name: section.bytes for section in file_info(path.read_bytes()).sections}
