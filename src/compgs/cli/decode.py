"""`compgs decode`: what a file holds, as arrays."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import NO_DEFAULT, DecodingCommand, FileArgument
from compgs.cli.console import say
from compgs.cli.inputs import check_bitstream, tiles_manifest
from compgs.cli.prefixes import parse_prefix
from compgs.cli.usage import UsageError
from compgs.numerics.compiling import working_seconds
from compgs.outputs import check_output_folder, write_bytes
from compgs.words import duration, size


@dataclass(frozen=True, kw_only=True)
class Decode(DecodingCommand, FileArgument):
    """Decode a .cgs file and write what it holds as NumPy arrays.

    latents.npz: positions [N, 3], log_scales [N, 6] and references [N, C] of the anchors; residuals [P, C]
    and anchor_index [P] of the coupled primitives. geometry.npz: their means, scales [P, 3] and quaternions
    [P, 4] (w-x-y-z) in world units. Positions and means count from the file's world_offset [3], which both
    files repeat in float64 and which is mostly zero: add it for world coordinates. Opacity and color depend
    on the view: `compgs render` shows them.

    Examples

    compgs decode garden.cgs

    compgs decode garden.cgs -o garden

    compgs decode garden.cgs --prefix 50kB
    """

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="FOLDER", help_behavior_hint=NO_DEFAULT)] = (
        None
    )
    """Folder for the arrays. Without it the file is only decoded, and checked by that."""

    prefix: Annotated[str | None, arg(metavar="BYTES|LEVEL", help_behavior_hint=NO_DEFAULT)] = None
    """Decode only the beginning of the file, a coarser scene: as many bytes as have arrived (20kB), or the ranges up to
    an octree level ("level 6"; `compgs info` lists them)."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the content of FOLDER."""

    def run(self) -> None:
        if manifest := tiles_manifest(self.file):
            self.decode_tiles(manifest)
            return
        if self.prefix is None:
            check_bitstream(self.file)
        prefix = None if self.prefix is None else parse_prefix(self.prefix, self.file)
        if self.output is not None:
            check_output_folder(self.output, overwrite=self.overwrite)
        self.prepare("decode")
        self.decode(self.file, self.output, prefix)

    def decode_tiles(self, manifest: Path) -> None:
        """Raises UsageError, BitstreamError, OutputError."""
        if self.prefix is not None:
            raise UsageError(
                f"--prefix {self.prefix}: {manifest} is of a scene in tiles; give the file of one"
            )
        from compgs.formats.tiled import read_manifest, tile_bytes
        from compgs.opening import check_scene

        check_scene(manifest)
        if self.output is not None:
            check_output_folder(self.output, overwrite=self.overwrite)
        self.prepare("decode")
        for tile in read_manifest(manifest).tiles:
            tile_bytes(manifest.parent, tile)  # it is the promised one
            output = None if self.output is None else self.output / tile.name
            self.decode(manifest.parent / tile.file, output, None)

    def decode(self, file: Path, output: Path | None, prefix: int | None) -> None:
        """One file, and what it holds to a folder. Raises BitstreamError, OutputError."""
        from compgs.codec import decode

        start = working_seconds()
        model = decode(file, self.device, prefix=prefix)
        seconds = working_seconds() - start
        taken = file.stat().st_size if prefix is None else min(prefix, file.stat().st_size)
        part = "" if prefix is None else "first "
        say(
            f"{file}: {part}{size(taken)}, {model.anchors:,} anchors, "
            f"{model.coupled:,} coupled primitives, decoded in {duration(seconds)}"
        )
        if output is None:
            return
        import numpy as np

        offset = np.array(model.world_offset, dtype=np.float64)
        p = model.primitives
        means, scales, quaternions = model.geometry
        contents: dict[str, dict[str, Any]] = {
            "latents.npz": {
                "positions": p.positions,
                "log_scales": p.log_scales,
                "references": p.references,
                "residuals": p.residuals,
                "anchor_index": p.anchor_index,
                "world_offset": offset,
            },
            "geometry.npz": {
                "means": means,
                "scales": scales,
                "quaternions": quaternions,
                "world_offset": offset,
            },
        }
        for name, arrays in contents.items():
            buffer = io.BytesIO()
            np.savez(buffer, **arrays)
            write_bytes(output / name, buffer.getvalue())
            say(f"{output / name}: {size(buffer.tell())}")
