"""Files that a command reads."""

from pathlib import Path

from compgs.errors import NotACompGSFile


def check_bitstream(path: Path) -> None:
    """Raises NotACompGSFile if there is no file to read, before anything is loaded."""
    if path.is_dir():
        files = sorted(path.glob("*.cgs"))
        hint = f"; did you mean {files[0]}?" if files else ""
        raise NotACompGSFile(f"{path}: expected a .cgs file, found a folder{hint}")
    if not path.is_file():
        raise NotACompGSFile(f"{path}: there is no such file")


def read_bitstream(path: Path) -> bytes:
    """The bytes of a file. Raises NotACompGSFile."""
    check_bitstream(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise NotACompGSFile(f"{path}: cannot be read ({error.strerror})") from error
