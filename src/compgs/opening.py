"""Opening any file of a scene: its format is known by the first bytes, never by the name.

`compgs.formats` has the formats of splats and our own, `compgs.published` the files of the other methods.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from compgs.devices import placed
from compgs.errors import ConfigError, NotACompGSFile, SplatFileError
from compgs.formats import (
    cgs,
    glb,
    gltf,
    ksplat,
    packed,
    ply,
    ply_compressed,
    ply_text,
    sog,
    sog_streamed,
    splat,
    spz,
    tiled,
)
from compgs.formats.arrays import SplatArrays
from compgs.model.splats import SplatModel
from compgs.paths import as_path
from compgs.published import READERS

if TYPE_CHECKING:
    from compgs.devices import Device
    from compgs.render.render_model import Renderable

HEAD_BYTES = 1 << 12  # enough to tell the formats apart
Background = tuple[float, float, float]


@dataclass(frozen=True)
class Format:
    """What can be done with files of one kind."""

    name: str  # as its suffix, without the dot
    begins: Callable[[bytes], bool]  # whether the first bytes are those of such a file
    check: Callable[[Path], None]  # raises for what can be known without reading everything
    component_bytes: Callable[[Path], dict[str, int]]  # by component; they sum to the file's size
    open: "Callable[[Path, Device, Background], Renderable]"


class SplatReader(Protocol):
    """What a module of a format of splats has."""

    def begins(self, head: bytes, /) -> bool: ...

    def check(self, path: Path, /) -> None: ...

    def component_bytes(self, path: Path, /) -> dict[str, int]: ...

    def read(self, path: Path, /) -> SplatArrays: ...


def _of_splats(name: str, module: SplatReader) -> Format:
    def open_splats(path: Path, device: "Device", background: Background) -> "Renderable":
        return placed(SplatModel(module.read(path), background), device)

    return Format(name, module.begins, module.check, module.component_bytes, open_splats)


def _open_cgs(path: Path, device: "Device", background: Background) -> "Renderable":
    return cgs.read(path, device)


def _open_packed(path: Path, device: "Device", background: Background) -> "Renderable":
    content = packed.read(path)
    if content.method not in READERS:
        known = ", ".join(READERS)
        raise SplatFileError(f"{path}: a file of method {content.method}; known here are those of {known}")
    return READERS[content.method](content, device, background)


def _open_tiles(path: Path, device: "Device", background: Background) -> "Renderable":
    from compgs.formats.tiled_scene import open_tiles  # with what draws them

    return open_tiles(path, device)


STREAMED = _of_splats("sog", sog_streamed)

# In the order in which they are asked: .ply of text and of chunks before the plain one; the meta.json of .sog, which
# nothing marks, after all other JSON, and .splat, which nothing marks either, at the end.
FORMATS = (
    Format("cgs", cgs.begins, cgs.check, cgs.component_bytes, _open_cgs),
    _of_splats("ply", ply_text),
    _of_splats("ply", ply_compressed),
    _of_splats("ply", ply),
    _of_splats("spz", spz),
    Format("tiles", tiled.begins, tiled.check, tiled.component_bytes, _open_tiles),
    STREAMED,
    _of_splats("gltf", gltf),
    _of_splats("sog", sog),
    _of_splats("glb", glb),
    _of_splats("ksplat", ksplat),
    Format("packed", packed.begins, packed.check, packed.component_bytes, _open_packed),
    _of_splats("splat", splat),
)


def scene_file(path: Path) -> Path:
    """The path itself; of a folder of tiles, its manifest."""
    manifest = path / tiled.MANIFEST
    return manifest if manifest.is_file() else path


def scene_name(path: Path) -> str:
    """What to call a scene: the name of its file, or of the folder that a manifest describes."""
    return path.parent.name if path.name == tiled.MANIFEST else path.name


def format_of(path: Path) -> Format:
    """Return the format of a file that is there. Raises NotACompGSFile for one that is of no known format, or is no
    file.
    """
    path = scene_file(path)
    names = ", ".join(dict.fromkeys(f".{each.name}" for each in FORMATS[1:]))
    if path.is_dir():
        names_inside = "*.cgs", sog_streamed.NAME, "meta.json", "*.gltf"
        files = [file for pattern in names_inside for file in sorted(path.glob(pattern))]
        hint = f"; did you mean {files[0]}?" if files else ""
        raise NotACompGSFile(f"{path}: expected a .cgs file or one of {names}, found a folder{hint}")
    if not path.is_file():
        raise NotACompGSFile(f"{path}: there is no such file")
    try:
        with open(path, "rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise NotACompGSFile(f"{path}: cannot be read ({error.strerror})") from error
    found = next((each for each in FORMATS if each.begins(head)), None)
    if found is None:
        what = f"is not a .cgs file, nor one of {names}" if head else "is empty"
        hint = f"; {splat.doubt(head)}" if head and path.suffix.lower() == ".splat" else ""
        raise NotACompGSFile(f"{path}: {what}{hint}")
    return found


def check_scene(path: str | Path) -> None:
    """Raises BitstreamError, SplatFileError if there is no whole file to read, before anything is decoded."""
    path = scene_file(Path(path))
    format_of(path).check(path)


def open_scene(
    path: str | Path,
    device: "Device" = "cpu",
    background: Background = (
        0.0,
        0.0,
        0.0,
    ),  # RGB, 0 to 1, where the file does not know its own: all but .cgs and tiles
    level: int | None = None,  # of a streamed .sog, 0 is the finest and the default
) -> "Renderable":
    """A scene that can be rendered, of any format.

    Raises BitstreamError, SplatFileError, MissingDependency; ConfigError for a level that is not there.
    """
    path = scene_file(as_path(path, "path"))
    found = format_of(path)
    if level is None:
        return found.open(path, device, background)
    _check_has_levels(path)
    return placed(SplatModel(sog_streamed.read(path, level), background), device)


def component_bytes(path: str | Path, level: int | None = None) -> dict[str, int]:
    """Bytes of each component of a file; they sum to its size. Raises as `open_scene` does."""
    path = scene_file(Path(path))
    if level is None:
        return format_of(path).component_bytes(path)
    _check_has_levels(path)
    return sog_streamed.component_bytes(path, level)


def _check_has_levels(path: Path) -> None:
    """Raises ConfigError."""
    if format_of(path) is not STREAMED:
        raise ConfigError(f"{path}: --level is for scenes of several levels ({sog_streamed.NAME})")
