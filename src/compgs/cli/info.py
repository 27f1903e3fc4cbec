"""`compgs info`: what is in a file, and which of its beginnings are scenes, without the time and memory of decoding."""

from dataclasses import dataclass

from compgs.cli.command import Command, FileArgument
from compgs.cli.console import console, print_components, print_ranges, say, size
from compgs.cli.inputs import read_bitstream


@dataclass(frozen=True, kw_only=True)
class Info(Command, FileArgument):
    """Show what is in a .cgs file: bytes of every component, and bits per anchor and per coupled primitive.

    Then which beginnings of the file are scenes: after how many bytes the anchors up to each octree level are there.

    Example

    compgs info garden.cgs
    """

    def run(self) -> None:
        data = read_bitstream(self.file)
        from compgs.codec.reader import file_info
        from compgs.formats.cgs import named

        with named(self.file):
            info = file_info(data)
        say(f"{self.file}: {size(len(data))} ({len(data):,} bytes), format version {info.version}")
        say(f"{info.anchors:,} anchors, {info.coupled:,} coupled primitives")
        console.print()
        print_components({s.name: s.bytes for s in info.sections}, info.anchors, info.coupled)
        console.print()
        print_ranges(info.ranges)
