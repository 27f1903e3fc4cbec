"""Files that a command reads, where it takes none but .cgs files."""

from pathlib import Path

from compgs.errors import NotACompGSFile


def check_bitstream(path: Path) -> None:
    """Raises BitstreamError if there is no whole .cgs file to read, before anything else is read or made."""
    from compgs.codec.format import unpack
    from compgs.formats.cgs import named

    data = read_bitstream(path)
    with named(path):
        unpack(data)


def read_bitstream(path: Path) -> bytes:
    """The bytes of a .cgs file. Raises NotACompGSFile."""
    from compgs.formats import format_of

    found = format_of(path).name
    if found != "cgs":
        raise NotACompGSFile(
            f"{path}: expected a .cgs file, found a .{found}, which can be rendered and evaluated, no more"
        )
    return path.read_bytes()
