"""Files that a command reads."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from compgs.errors import BitstreamError, CorruptSection, NotACompGSFile, TruncatedSection


def check_bitstream(path: Path) -> None:
    """Raises BitstreamError if there is no whole .cgs file to read, before anything else is read or made."""
    data = read_bitstream(path)
    from compgs.codec.format import unpack

    with named(path):
        unpack(data)


@contextmanager
def named(path: Path) -> Iterator[None]:
    """A BitstreamError inside becomes one that names the file, and what to do about it."""
    try:
        yield
    except (TruncatedSection, CorruptSection) as error:
        raise type(error)(f"{path}: {error}; download or copy the file again") from error
    except BitstreamError as error:
        raise type(error)(f"{path}: {error}") from error


def check_scene_file(path: Path) -> None:
    """Of a .cgs file, or a .ply file of splats: as `check_bitstream`. Raises BitstreamError, SplatFileError."""
    if path.suffix.lower() == ".ply":
        from compgs.export.ply import read_ply_header

        read_ply_header(path)
    else:
        check_bitstream(path)


def read_bitstream(path: Path) -> bytes:
    """The bytes of a file. Raises NotACompGSFile."""
    if path.is_dir():
        files = sorted(path.glob("*.cgs"))
        hint = f"; did you mean {files[0]}?" if files else ""
        raise NotACompGSFile(f"{path}: expected a .cgs file, found a folder{hint}")
    if not path.is_file():
        raise NotACompGSFile(f"{path}: there is no such file")
    if path.suffix.lower() == ".ply":
        raise NotACompGSFile(
            f"{path}: expected a .cgs file; .ply files can be rendered and evaluated, no more"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise NotACompGSFile(f"{path}: cannot be read ({error.strerror})") from error
    from compgs.codec.format import MAGIC

    if not data.startswith(MAGIC):
        found = "is empty" if not data else "is not a .cgs file"
        raise NotACompGSFile(f"{path}: {found}")
    return data
