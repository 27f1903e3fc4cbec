"""`compgs info`: what is in a file, and which of its beginnings are scenes, without the time and memory of decoding."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgs.cli.command import Command, JsonOption, SceneFileOrRunArgument
from compgs.cli.console import (
    console,
    print_components,
    print_json,
    print_ranges,
    print_shares,
    print_tiles,
    say,
)
from compgs.cli.inputs import read_bitstream, tiles_manifest
from compgs.cli.run_folder import file_and_run
from compgs.words import size

if TYPE_CHECKING:
    from compgs.codec.reader import FileInfo


OF_TILES = ("name", "bytes", "sha256", "anchors", "coupled_primitives", "memory")


@dataclass(frozen=True, kw_only=True)
class Info(JsonOption, Command, SceneFileOrRunArgument):
    """Show the parts of a file: bytes of every component; for a .cgs file also bits per anchor and coupled primitive.

    Then which beginnings of the file are scenes: after how many bytes the anchors up to each octree level are there. Of
    a scene in tiles: its tiles, and what each takes.

    Examples

    compgs info garden.cgs

    compgs info runs/garden

    compgs info runs/city/city.tiles

    compgs info garden.cgs --json
    """

    def run(self) -> None:
        from compgs.opening import format_of

        if manifest := tiles_manifest(self.file):
            tell_tiles(manifest, json=self.json)
            return
        file, _ = file_and_run(self.file)
        if format_of(file).name != "cgs":
            tell_splats(file, json=self.json)
            return
        data = read_bitstream(file)
        from compgs.codec.format import named
        from compgs.codec.reader import file_info

        with named(file):
            info = file_info(data)
        if self.json:
            print_json(file_facts(file, info))
            return
        say(f"{file}: {size(len(data))} ({len(data):,} bytes), format version {info.version}")
        say(f"{info.anchors:,} anchors, {info.coupled:,} coupled primitives")
        console.print()
        print_components({s.name: s.bytes for s in info.sections}, info.anchors, info.coupled)
        console.print()
        print_ranges(info.ranges)


def tell_splats(path: Path, *, json: bool) -> None:
    """Say what is in a file of another format. Raises SplatFileError, MissingDependency."""
    from compgs.model.splats import SplatModel
    from compgs.opening import check_scene, component_bytes, format_of, open_scene

    check_scene(path)
    model = open_scene(path)
    components, primitives = component_bytes(path), len(model.bounds[1])
    whole, name = sum(components.values()), format_of(path).name
    if json:
        print_json(
            {
                "file": str(path),
                "format": name,
                "bytes": whole,
                "primitives": primitives,
                "components": components,
            }
        )
        return
    say(f"{path}: {size(whole)} ({whole:,} bytes), .{name}")
    say(f"{primitives:,} {'splats' if isinstance(model, SplatModel) else 'anchors'}")
    console.print()
    print_shares(components, {"bits each": primitives})


def file_facts(path: Path, info: "FileInfo") -> dict[str, Any]:
    """What `--json` prints of a file."""
    return {
        "file": str(path),
        "format": "cgs",
        "bytes": info.bytes,
        "version": info.version,
        "anchors": info.anchors,
        "coupled_primitives": info.coupled,
        "components": {section.name: section.bytes for section in info.sections},
        "prefixes": [asdict(part) for part in info.ranges],
    }


def tell_tiles(path: Path, *, json: bool) -> None:
    """Raises BitstreamError."""
    from compgs.formats.tiled import read_manifest
    from compgs.opening import check_scene, component_bytes

    check_scene(path)
    manifest, components = read_manifest(path), component_bytes(path)
    tiles, whole = manifest.tiles, sum(components.values())
    anchors, coupled = sum(t.anchors for t in tiles), sum(t.coupled_primitives for t in tiles)
    if json:
        print_json(
            {
                "file": str(path),
                "format": "tiles",
                "bytes": whole,
                "anchors": anchors,
                "coupled_primitives": coupled,
                "components": components,
                "tiles": [{name: getattr(tile, name) for name in OF_TILES} for tile in tiles],
            }
        )
        return
    say(f"{path.parent}: {len(tiles)} tiles, {size(whole)} ({whole:,} bytes)")
    say(
        f"{anchors:,} anchors, {coupled:,} coupled primitives, {size(sum(t.memory for t in tiles))} when all are open"
    )
    console.print()
    print_components(components, anchors, coupled)
    console.print()
    print_tiles(tiles)
