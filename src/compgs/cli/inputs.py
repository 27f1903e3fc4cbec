"""Files that a command reads, where it takes none but .cgs files."""

from pathlib import Path

from compgs.errors import NotACompGSFile


def check_bitstream(path: Path) -> None:
    """Raises BitstreamError if there is no whole .cgs file to read, before anything else is read or made."""
    from compgs.codec.format import named, unpack

    data = read_bitstream(path)
    with named(path):
        unpack(data)


def tiles_manifest(path: Path) -> Path | None:
    """The manifest, where the path is one, or a folder of tiles, or of a run in tiles. Raises NotACompGSFile."""
    from compgs.cli.run_folder import manifest_of
    from compgs.opening import format_of, scene_file

    of_run = manifest_of(path)
    file = of_run if path.is_dir() and of_run.is_file() else scene_file(path)
    return file if file.is_file() and format_of(file).name == "tiles" else None


def read_bitstream(path: Path) -> bytes:
    """The bytes of a .cgs file. Raises NotACompGSFile."""
    from compgs.opening import format_of

    found = format_of(path).name
    if found != "cgs":
        raise NotACompGSFile(
            f"{path}: expected a .cgs file, found a .{found}, which can be rendered and evaluated, no more"
        )
    return path.read_bytes()
