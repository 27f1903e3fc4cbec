"""`compgs compress`: splats in, one small file out, without photographs; and what that loses."""

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.table import Table
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from compgs.cli.command import NO_DEFAULT, ComputingCommand
from compgs.cli.console import console, say, warn
from compgs.cli.levels import LevelOption
from compgs.cli.progress import counting, training
from compgs.cli.settings import assigned, with_settings
from compgs.cli.sizes import check_one_of_time_and_steps, parse_size, parse_time
from compgs.cli.usage import UsageError, settings_of_options
from compgs.occupied import occupied
from compgs.words import duration, size

if TYPE_CHECKING:
    from compgs.compressing import Compressed, Compression, Looking


@dataclass(frozen=True, kw_only=True)
class Compress(ComputingCommand, LevelOption):
    """Write splats as a small .cgs file, without photographs, and compare it with them.

    Places are found from which there is something to see, around the scene and inside it; the splats are rendered
    there, and the renderings are trained on like photographs. The file is then decoded and compared with the splats
    from other places, beside .spz and .sog files of the same splats.

    Beside OUT.cgs, in the folder OUT.run, are the checkpoint, results.json, per_view.json, pictures and
    contact_sheet.png.

    Examples

    compgs compress scene.ply -o scene.cgs

    compgs compress scene.ply -o scene.cgs --time 5min

    compgs compress scene.spz -o small.cgs --target-size 200kB --cameras scenes/garden

    compgs compress city/lod-meta.json -o city.cgs --level 2

    compgs compress -o scene.cgs --resume
    """

    asked_for = ("file", "output")

    file: Annotated[Positional[Path | None], arg(metavar="FILE", help_behavior_hint=NO_DEFAULT)] = None
    """Splats: .ply (also SuperSplat's .compressed.ply), .spz, .sog (or its meta.json or lod-meta.json), .glb, .gltf,
    .ksplat, .splat."""

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT.cgs", help_behavior_hint=NO_DEFAULT)] = (
        None
    )
    """The file to write."""

    preset: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: default)")] = None
    """Settings to start from: default, paper (as published) or quick. Without a preset it is default with 8,000
    steps."""

    lmbda: Annotated[float | None, arg(metavar="LAMBDA", help_behavior_hint="(default: the preset's)")] = None
    """Weight of the rate: larger means a smaller file."""

    target_size: Annotated[str | None, arg(metavar="SIZE", help_behavior_hint=NO_DEFAULT)] = None
    """Size of the file: 130kB, 2MB, 1.5MiB or plain bytes."""

    time: Annotated[str | None, arg(metavar="TIME", help_behavior_hint=NO_DEFAULT)] = None
    """How long it may take until the file is written, about: 5min, 90s, 1h30min. The steps are chosen for it before the
    training begins, and some are left out if the machine becomes slower; as its speed decides, --seed alone no longer
    gives the same file."""

    steps: Annotated[
        int | None, arg(aliases=["--iterations"], metavar="N", help_behavior_hint="(default: the preset's)")
    ] = None
    """Training steps, one view each; all schedules scale with it."""

    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    """Seed of every random choice, that of the cameras included."""

    views: Annotated[int, arg(metavar="N")] = 200
    """Places to look from. Of --cameras every 8th is kept for judging; if the others are fewer, more are placed
    between them."""

    width: Annotated[int, arg(metavar="PIXELS")] = 480
    """Longer side of the pictures."""

    cameras: Annotated[Path | None, arg(metavar="SCENE|JSON", help_behavior_hint=NO_DEFAULT)] = None
    """Cameras of the capture that the splats come from: the folder of a COLMAP model, transforms.json, or
    cameras.json as 3DGS and compgs write it. Photographs need not be there."""

    up: Annotated[tuple[float, float, float], arg(metavar="X Y Z")] = (0.0, -1.0, 0.0)
    """Where the sky is: from below, few places are chosen."""

    background: Annotated[tuple[float, float, float], arg(metavar="R G B")] = (0.0, 0.0, 0.0)
    """Color behind the splats, 0 to 1; the file keeps it."""

    set: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="SECTION.KEY=VALUE")] = ()
    """Any other setting of the run; sections: model, entropy, control, training."""

    resume: FlagCreatePairsOff[bool] = False
    """Continue from the last checkpoint in OUT.run, with the settings it began with."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a file that is there already; it stays until the new one is whole."""

    def run(self) -> None:
        if self.output is None:
            raise UsageError(
                "no file to write was given: name it with -o, as in `compgs compress FILE -o OUT.cgs`"
            )
        self.check_resume()
        from compgs.compressing import check_places, folder_of

        check_places(self.output, overwrite=self.overwrite or self.resume)
        with occupied(folder_of(self.output)):
            self.compress(self.output)

    def compress(self, output: Path) -> None:
        """Everything, in the run's folder, which is this process's until the end."""
        start = time.perf_counter()
        compression = self.continued(output) if self.resume else self.begun(output)
        say_what(compression)
        try:
            with training() as show:
                written = compression.train(show)
        except KeyboardInterrupt as stop:
            raise type(stop)(interrupted(output)) from None
        say(f"{output}: {size(written)}, {duration(time.perf_counter() - start)} after the beginning")
        with counting("comparing") as progress:
            compressed = compression.judge(progress)
        say("")
        print_compressed(compressed)
        say("")
        say(f"the file's pictures beside those of the splats: {compressed.folder / 'contact_sheet.png'}")
        say(f"for programs: {compressed.folder / 'results.json'}, {compressed.folder / 'per_view.json'}")

    def check_resume(self) -> None:
        """Raises UsageError for options that do not go together."""
        if self.resume and self.overwrite:
            raise UsageError("--resume continues a run and --overwrite replaces it; give one of them")
        check_one_of_time_and_steps(self.time, self.steps)
        if not self.resume:
            if self.file is None:
                raise UsageError(
                    "no splats were given: name their file, as in `compgs compress FILE -o OUT.cgs`"
                )
            return
        for name in ("preset", "time", "views", "width", "cameras", "up", "background", "level"):
            if getattr(self, name) != getattr(Compress, name):
                raise UsageError(f"--{name}: --resume continues with what the run began with; leave it out")
        for option in self.assignments():
            raise UsageError(f"{option}: --resume continues with what the run began with; leave it out")

    def continued(self, output: Path) -> "Compression":
        self.prepare()
        from compgs.compressing import resumed

        return resumed(output, self.file, device=self.device)

    def begun(self, output: Path) -> "Compression":
        seconds = None if self.time is None else parse_time(self.time, "--time")
        assignments = self.assignments()
        from compgs.compressing import begin, default_config
        from compgs.opening import check_scene

        assert self.file is not None
        check_scene(self.file)
        with settings_of_options():
            config = default_config(self.preset)
            self.looking().check()
        config = with_settings(config, assignments)
        self.prepare()
        with counting("looking for places to look from") as progress:
            return begin(
                self.file,
                output,
                config,
                self.looking(),
                seconds=seconds,
                overwrite=self.overwrite,
                device=self.device,
                progress=progress,
            )

    def looking(self) -> "Looking":
        """Return from where the splats are looked at."""
        from compgs.compressing import Looking

        return Looking(
            views=self.views,
            width=self.width,
            height=max(1, 3 * self.width // 4),
            up=self.up,
            background=self.background,
            cameras=None if self.cameras is None else str(self.cameras),
            level=self.level,
        )

    def assignments(self) -> tuple[str, ...]:
        """Options that are settings, as `section.key=value`."""
        named = {
            "training.lmbda": self.lmbda,
            "training.target_bytes": self.target_size and parse_size(self.target_size, "--target-size"),
            "training.steps": self.steps,
            "training.seed": self.seed,
        }
        return assigned(named, self.set)


def say_what(compression: "Compression") -> None:
    """What is about to happen."""
    from compgs.compressing.deadline import ENOUGH, FEWEST

    scene, begun = compression.scene, compression.begun
    camera = scene.train_views[0].camera
    say(
        f"{begun.source}: {len(compression.splats.splats):,} splats, {len(scene.train_views)} views of "
        f"{camera.width} x {camera.height} pixels to train with, {len(scene.test_views)} others to judge by, "
        f"{begun.config.training.steps:,} steps"
    )
    for line in compression.plan.in_words():
        say(line)
    if begun.config.training.steps < ENOUGH and compression.deadline is not None:
        warn(f"so little time gives a rough file: {ENOUGH:,} steps or more are wanted")
        if compression.deadline.late >= 1.0:
            warn(
                f"the time is too short for {FEWEST} steps, the fewest that show anything: at the present speed of "
                f"this machine the file comes about {duration(compression.deadline.late)} later"
            )
    if compression.goes_on:
        say("goes on from the last checkpoint")


def print_compressed(compressed: "Compressed") -> None:
    """The file beside others of the same splats."""
    table = Table(box=None, pad_edge=False)
    for heading in ("", "bytes", "of the input", "PSNR", "SSIM"):
        table.add_column(heading, justify="left" if heading == "" else "right")

    def row(name: str, count: int, psnr: float | None, ssim: float | None, style: str | None = None) -> None:
        quality = ("", "") if psnr is None or ssim is None else (f"{psnr:.2f} dB", f"{ssim:.4f}")
        table.add_row(
            name, f"{count:,}", f"{100 * count / compressed.source_bytes:.1f} %", *quality, style=style
        )

    row(compressed.source.name, compressed.source_bytes, None, None)
    for other in compressed.others:
        row(f"as .{other.format}", other.bytes, other.psnr, other.ssim)
    results = compressed.results
    row(compressed.file.name, results.bytes, results.psnr, results.ssim, "bold")
    say(f"against the splats' own pictures, {len(results.per_view)} cameras that were not trained on:")
    console.print(table)
    for note in compressed.notes:
        say(f"note: {note}")


def interrupted(output: Path) -> str:
    """What to tell someone who stopped it."""
    from compgs.compressing import folder_of
    from compgs.training.run.checkpoint import CHECKPOINT_NAME

    if not (folder_of(output) / CHECKPOINT_NAME).is_file():
        return "interrupted before the first checkpoint: nothing was kept"
    return f"interrupted\ncontinue with: compgs compress -o {shlex.quote(str(output))} --resume"
