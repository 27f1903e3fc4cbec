"""`compgs info`: what is in a file, and which of its beginnings are scenes, without the time and memory of decoding."""

from dataclasses import dataclass
from pathlib import Path

from compgs.cli.command import Command, FileArgument
from compgs.cli.console import console, print_components, print_ranges, print_tiles, say
from compgs.cli.inputs import read_bitstream, tiles_manifest
from compgs.words import size


@dataclass(frozen=True, kw_only=True)
class Info(Command, FileArgument):
    """Show what is in a .cgs file: bytes of every component, and bits per anchor and per coupled primitive.

    Then which beginnings of the file are scenes: after how many bytes the anchors up to each octree level are there. Of
    a scene in tiles: its tiles, and what each takes.

    Examples

    compgs info garden.cgs

    compgs info runs/city/city.tiles
    """

    def run(self) -> None:
        if manifest := tiles_manifest(self.file):
            tell_tiles(manifest)
            return
        data = read_bitstream(self.file)
        from compgs.codec.format import named
        from compgs.codec.reader import file_info

        with named(self.file):
            info = file_info(data)
        say(f"{self.file}: {size(len(data))} ({len(data):,} bytes), format version {info.version}")
        say(f"{info.anchors:,} anchors, {info.coupled:,} coupled primitives")
        console.print()
        print_components({s.name: s.bytes for s in info.sections}, info.anchors, info.coupled)
        console.print()
        print_ranges(info.ranges)


def tell_tiles(path: Path) -> None:
    """Raises BitstreamError."""
    from compgs.formats import check_scene, component_bytes
    from compgs.formats.tiled import read_manifest

    check_scene(path)
    manifest, components = read_manifest(path), component_bytes(path)
    tiles, whole = manifest.tiles, sum(components.values())
    anchors, coupled = sum(t.anchors for t in tiles), sum(t.coupled_primitives for t in tiles)
    say(f"{path.parent}: {len(tiles)} tiles, {size(whole)} ({whole:,} bytes)")
    say(
        f"{anchors:,} anchors, {coupled:,} coupled primitives, {size(sum(t.memory for t in tiles))} when all are open"
    )
    console.print()
    print_components(components, anchors, coupled)
    console.print()
    print_tiles(tiles)
