"""`compgs info`: what is in a file, without the time and memory of decoding it."""

from dataclasses import dataclass

from compgs.cli.command import Command, FileArgument
from compgs.cli.console import console, print_components, say, size
from compgs.cli.inputs import read_bitstream


@dataclass(frozen=True, kw_only=True)
class Info(Command, FileArgument):
    """Show what is in a .cgs file: bytes, bits per anchor and per coupled primitive of every component.

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
