"""Our own files, as one format among others: `compgs.codec` reads them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from compgs.errors import BitstreamError, CorruptSection, TruncatedSection

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.model.hybrid_model import HybridModel


def begins(head: bytes) -> bool:
    """Whether a file begins as a .cgs does."""
    from compgs.codec.format import MAGIC

    return head.startswith(MAGIC)


def check(path: Path) -> None:
    """Raises BitstreamError if the file is not whole."""
    from compgs.codec.format import unpack

    with named(path):
        unpack(path.read_bytes())


@contextmanager
def named(path: Path) -> Iterator[None]:
    """A BitstreamError inside becomes one that names the file, and what to do about it."""
    try:
        yield
    except (TruncatedSection, CorruptSection) as error:
        raise type(error)(f"{path}: {error}; download or copy the file again") from error
    except BitstreamError as error:
        raise type(error)(f"{path}: {error}") from error


def read(path: Path, device: "Device") -> "HybridModel":
    """Raises BitstreamError."""
    from compgs.codec.decoder import decode

    return decode(path, device)


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size."""
    from compgs.codec.reader import file_info

    return {section.name: section.bytes for section in file_info(path.read_bytes()).sections}
