"""`compgs train`: photographs in, one small file out, and proof of what the file is worth."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import NO_DEFAULT
from compgs.cli.console import say
from compgs.cli.plan import PLANNED, with_time
from compgs.cli.ranks import several
from compgs.cli.run_folder import RunSettings
from compgs.cli.settings import check_settings_of, with_settings
from compgs.cli.sizes import check_one_of_time_and_steps, parse_size, parse_time
from compgs.cli.training_command import TrainingCommand
from compgs.cli.usage import UsageError, settings_of_options
from compgs.cli.viewing import check_viewing, viewing
from compgs.methods import METHODS, Method, settings_of

if TYPE_CHECKING:
    from compgs.cli.viewing import Viewing
    from compgs.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Train(TrainingCommand):
    """Train a scene, write its file, decode the file and compare it with the held-out views.

    The file is a .cgs. With --method the scene is trained by another method, and the file is that method's: with 3dgs
    a .ply of plain, uncompressed 3D Gaussian Splatting, which compression is compared with.

    The run's folder then holds the file, results.json, per_view.json, config.json, the renders beside the
    photographs (test/renders, test/gt, contact_sheet.png) and a checkpoint.

    Examples

    compgs train scenes/garden -o runs/garden

    compgs train scenes/garden --plan

    compgs train scenes/garden -o runs/hour --time 1h

    compgs train scenes/garden -o runs/quick --preset quick -r 4

    compgs train -s scenes/garden -m runs/garden --eval --iterations 30000

    compgs train scenes/garden -o runs/small --lmbda 0.01 --set model.coupled_primitives=5

    compgs train scenes/garden -o runs/two --target-size 2MB

    compgs train scenes/garden -o runs/garden-3dgs --method 3dgs

    compgs train scenes/garden -o runs/garden --viewer

    compgs train -o runs/garden --resume

    torchrun --nproc-per-node 8 -m compgs train scenes/garden -o runs/eight --set training.views_per_step=8 --steps 1875
    """

    method: Annotated[
        str | None,
        arg(
            metavar="NAME",
            help="; ".join(f"{name}: {each.description}" for name, each in METHODS.items()),
            help_behavior_hint="(default: compgs)",
        ),
    ] = None

    from_splats: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=NO_DEFAULT)] = None
    """Splats that were trained already, as another run's .ply, in place of the plain 3DGS that a method begins
    with."""

    target_size: Annotated[str | None, arg(metavar="SIZE", help_behavior_hint=NO_DEFAULT)] = None
    """Size of the file: 130kB, 2MB, 1.5MiB or plain bytes. The weight of the rate is then found while training, and
    --lmbda is where it begins."""

    time: Annotated[str | None, arg(metavar="TIME", help_behavior_hint=NO_DEFAULT)] = None
    """How long the training may take, about: 5min, 1h, 1h30min. The steps are chosen for it before the training begins;
    as the machine's speed decides, --seed alone no longer gives the same file."""

    profile: FlagCreatePairsOff[bool] = False
    """Print where a step's time goes; training.json has it too."""

    viewer: FlagCreatePairsOff[bool] = False
    """Show the scene as it grows, in the browser, for less than a tenth of the training's speed; the file is the same
    (needs `pip install '.[view]'` in the project's folder)."""

    viewer_host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address at which the viewer listens; 0.0.0.0 is all addresses of this machine."""

    viewer_port: Annotated[int, arg(metavar="N")] = 8080
    """Port at which it listens; 0 takes a free one."""

    @property
    def profiled(self) -> bool:
        """Whether it is asked for where a step's time goes."""
        return self.profile

    def check_onlookers(self) -> None:
        """Raises UsageError, MissingDependency where nobody could look on."""
        if self.viewer:
            check_viewing(self.viewer_port, "--viewer-port")

    @contextmanager
    def viewing(self, scene: "Scene", title: str) -> "Iterator[Viewing | None]":
        """Where the training is looked at, if it is to be. Raises UsageError."""
        if not self.viewer:
            yield None
            return
        with viewing(scene, title, self.viewer_host, self.viewer_port) as view:
            say(f"the scene as it grows: {view.address}")
            yield view

    def timed(self, settings: RunSettings, scene: "Scene") -> RunSettings:
        if self.time is None:
            return settings
        return with_time(settings, scene, parse_time(self.time, "--time"), self.device)

    def check_time(self, method: str) -> None:
        """Raises UsageError where no time can be given."""
        if self.time is None:
            return
        parse_time(self.time, "--time")
        check_one_of_time_and_steps(self.time, self.steps)
        if method != PLANNED:
            raise UsageError(f"--time: nothing is known of the pace of --method {method}; give --steps")
        if several():
            raise UsageError("--time: the pace of several processes is not known; give --steps")

    def settings_of_new(self) -> RunSettings:
        """Return the command line's settings. Raises UsageError."""
        preset, method = self.preset or "default", self.method or "compgs"
        self.check_time(method)
        source = self.scene_source(holdout=self.eval)
        if method not in METHODS:
            raise UsageError(f"--method {method}: expected one of {', '.join(METHODS)}")
        self.check_splats(METHODS[method])
        check_settings_of(METHODS[method], self.assignments())
        with settings_of_options():
            start = settings_of(method, preset)
        config = with_settings(start, self.assignments())
        splats = None if self.from_splats is None else str(self.from_splats)
        return RunSettings(preset, source, config, method, splats)

    def settings_of_begun(self, folder: Path) -> RunSettings:
        """Return the settings of a run to continue, which must be those that are given. Raises UsageError,
        CheckpointError.
        """
        if self.time is not None:
            raise UsageError("--time: --resume continues with the steps the run began with; leave it out")
        begun = super().settings_of_begun(folder)
        if begun.tiles is not None:
            raise UsageError(
                f"--resume: {folder} is a capture in tiles; continue it with compgs tiles -o {folder} --resume"
            )
        if self.method not in (None, begun.method):
            raise UsageError(f"--method {self.method}: the run to continue began with {begun.method}")
        if self.from_splats is not None and str(self.from_splats) != begun.splats:
            raise UsageError(
                f"--from-splats {self.from_splats}: the run to continue began with {begun.splats}"
            )
        return begun

    def check_splats(self, method: Method) -> None:
        """Raises UsageError, SplatFileError for splats that the method has no use for, or that are none."""
        if self.from_splats is None:
            return
        from compgs.opening import check_scene

        if not method.from_splats:
            raise UsageError(f"--from-splats: --method {method.name} does not begin with plain 3DGS")
        check_scene(self.from_splats)

    def named_settings(self) -> dict[str, object]:
        """Options that are settings, by the settings' names. Raises UsageError."""
        target = self.target_size and parse_size(self.target_size, "--target-size")
        return {**super().named_settings(), "training.target_bytes": target}
