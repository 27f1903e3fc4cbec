"""`compgs export`: a scene for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.command import NO_DEFAULT, DecodingCommand, SceneFileArgument
from compgs.cli.console import say
from compgs.cli.levels import LevelOption
from compgs.cli.progress import counting
from compgs.cli.sizes import parse_size
from compgs.cli.usage import check_range, settings_of_options
from compgs.words import size

if TYPE_CHECKING:
    from compgs.exporting import Exported


@dataclass(frozen=True, kw_only=True)
class Export(DecodingCommand, SceneFileArgument, LevelOption):
    """Write a scene as splats (.ply, .spz, .sog, .glb), levels (lod-meta.json), a web page (.html) or tiles (.tiles).

    In a .cgs file opacity and color depend on where one stands; other programs know harmonics. They are fitted
    over the cameras that the file holds, and what that costs is measured: the new file is read again and its
    pictures are compared with those of the scene. Files of splats of any kind are converted, too. A page holds the
    .cgs file itself; a folder of tiles has its primitives as they are, and viewers fetch of it what they look at.

    Examples

    compgs export garden.cgs garden.spz

    compgs export garden.cgs garden.sog --max-bytes 2MB

    compgs export garden.ply garden.glb

    compgs export city/lod-meta.json city.ply --level 2

    compgs export garden.cgs garden/lod-meta.json

    compgs export garden.cgs garden.tiles --grid 4x2
    """

    output: Annotated[Positional[Path], arg(metavar="OUT")]
    """The file to write; what it becomes is said by what its name ends in."""

    degree: Annotated[int | None, arg(metavar="N", help_behavior_hint=NO_DEFAULT)] = None
    """Degree of the harmonics, 0 (the same color from everywhere) to 3. By default 3; with --max-bytes the highest with
    which all splats fit, 1 at least."""

    refine: Annotated[int, arg(metavar="STEPS")] = 100
    """Steps in which baked splats are fitted to the scene's own pictures; 0 is faster."""

    max_splats: Annotated[int | None, arg(metavar="N", help_behavior_hint=NO_DEFAULT)] = None
    """Keep those splats that contribute most to the pictures."""

    max_bytes: Annotated[str | None, arg(metavar="SIZE", help_behavior_hint=NO_DEFAULT)] = None
    """Keep as many as fit into a file of this size, such as 2MB or 500kB."""

    spz_version: Literal[3, 4] = 3
    """Version of .spz files: 4 is a little smaller, and read by newer programs only (needs `pip install '.[spz]'` in
    the project's folder)."""

    grid: Annotated[str | None, arg(metavar="CxR", help_behavior_hint=NO_DEFAULT)] = None
    """Columns and rows of tiles, for OUT.tiles; by default tiles of about 20,000 anchors."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace OUT if it is there already."""

    def run(self) -> None:
        if self.degree is not None:
            check_range("--degree", self.degree, 0, 3)
        check_range("--refine", self.refine, 0, 100_000)
        most = None if self.max_bytes is None else parse_size(self.max_bytes, "--max-bytes")
        from compgs.opening import check_scene

        check_scene(self.file)
        self.prepare("decode", "render")
        from compgs.exporting import export

        with settings_of_options(), counting("baking and comparing") as progress:
            exported = export(
                self.file,
                self.output,
                degree=self.degree,
                refine=self.refine,
                max_splats=self.max_splats,
                max_bytes=most,
                spz_version=self.spz_version,
                level=self.level,
                grid=self.grid,
                overwrite=self.overwrite,
                device=self.device,
                progress=progress,
            )
        for line in report(self.file, self.output, exported):
            say(line)


def report(source: Path, path: Path, exported: "Exported") -> list[str]:
    """What was written, and what it costs, in words."""
    if exported.tiles:
        return [
            f"{path}: {size(exported.bytes)} in {exported.tiles:,} tiles, with the primitives of {source.name} as they "
            f"are; that file has {size(source.stat().st_size)}"
        ]
    if exported.splats is None:
        return [f"{path}: {size(exported.bytes)}, a page that shows {source.name} without anything else"]
    splats = f"{exported.splats:,} splats of degree {exported.degree}"
    lines = [f"{path}: {size(exported.bytes)} ({exported.bytes:,} bytes), {splats}"]
    if not exported.psnr:
        lines.append("too many to be compared with the scene here")
    elif exported.worst == float("inf"):
        lines.append(f"its pictures are those of {source.name}, from {len(exported.psnr)} cameras")
    else:
        lines.append(
            f"beside {source.name}: {exported.mean:.2f} dB, {exported.worst:.2f} dB from the worst of "
            f"{len(exported.psnr)} cameras, in pictures as large as its photographs"
        )
        if exported.viewing_psnr:
            lines.append(
                f"beside it as people look at it, 1,280 pixels across: {exported.viewing_mean:.2f} dB"
            )
    if exported.dropped:
        total = exported.splats + exported.dropped
        advice = "; a lower --degree leaves room for more of them" if exported.degree else ""
        lines.append(f"{exported.dropped:,} of {total:,} splats were left out{advice}")
    if any(exported.origin):
        place = " ".join(f"{x:.12g}" for x in exported.origin)
        lines.append(
            f"note: positions count from {place}: {path.suffix} has no place for that; .ply and .glb do"
        )
    if exported.refined == 0:
        lines.append(
            "note: the splats were not fitted to the scene's pictures; --refine 100, the default, brings them nearer, "
            "by 0.3 dB in photographs of a street scene: docs/export.md, What it costs"
        )
    if exported.softer:
        lines.append(
            f"note: other programs draw splats softer than {source.name} is, in pictures as small as its photographs: "
            "docs/export.md, Sharpness"
        )
    return lines
