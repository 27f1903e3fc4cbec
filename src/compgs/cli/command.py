"""What all commands have in common."""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.console import say
from compgs.cli.run_folder import SceneSource
from compgs.cli.sizes import AUTO, parse_downscale, parse_size
from compgs.cli.usage import UsageError, check_range, settings_of_options
from compgs.errors import ConfigError
from compgs.extras import require

if TYPE_CHECKING:
    from compgs.devices import Choice

NO_DEFAULT = ""  # instead of "(default: None)" in the help


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command: its fields are its arguments, its docstring is its help, `run` does it."""

    debug: FlagCreatePairsOff[bool] = False
    """Show where in the program an error came from."""

    quiet: Annotated[FlagCreatePairsOff[bool], arg(aliases=["-q"])] = False
    """Say nothing but warnings and errors."""

    # Arguments that are asked for, although the parser does without them: the usage line shows them as such.
    asked_for: ClassVar[tuple[str, ...]] = ()

    @property
    def prints_results_alone(self) -> bool:
        """Whether standard output is for a program that reads it."""
        return False

    def check_machine(self) -> None:
        """Check, before anything is read, that this machine has what is asked for. Raises ConfigError, UsageError."""

    def run(self) -> None:
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """Results for programs."""

    json: FlagCreatePairsOff[bool] = False
    """Print the results as JSON, and everything else on standard error."""

    @property
    def prints_results_alone(self) -> bool:
        """Whether standard output is for a program that reads it."""
        return self.json


@dataclass(frozen=True, kw_only=True)
class ComputingCommand(Command):
    """A command that computes for a while."""

    threads: Annotated[int | None, arg(metavar="N", help_behavior_hint=NO_DEFAULT)] = None
    """Threads to use; all cores by default. What a file decodes to does not depend on it; a training may, in its
    last bits."""

    device: Annotated[str | None, arg(metavar="cpu|cuda", help_behavior_hint=NO_DEFAULT)] = None
    """Where to compute; a CUDA GPU by default where there is one."""

    def check_machine(self) -> None:
        """Check, before anything is read, that `device` is there. Raises ConfigError, UsageError."""
        if self.device is not None:
            check_device(self.device)

    def prepare(self, *stages: str) -> None:
        """Apply `threads`; let helpers compile what some stages of work need, where nothing has been
        compiled yet. Raises UsageError."""
        self.start_helpers(*stages)
        if self.threads is not None:
            use_threads(self.threads)

    def start_helpers(self, *stages: str) -> None:
        """Let helpers compile the kernels of some stages of work. With one thread there are none."""
        if self.threads != 1:
            from compgs.numerics.ahead import start_helpers

            start_helpers(*stages)

    def prepare_training(self, *stages: str) -> None:
        """`prepare`, for what trains models: say where it computes, and compile what a GPU needs before the first step.
        Raises MissingDependency without torch, too."""
        require("train", "training")
        chosen = choose_device(self.device)
        on_gpu = chosen.name != "cpu"
        # On a GPU no kernel of the CPU trains; files are written and read by them all the same.
        self.start_helpers(*(stage for stage in stages if not on_gpu or stage in ("encode", "decode")))
        if self.threads is not None:
            use_threads(self.threads)
        if on_gpu or "GPU," in chosen.reason:
            say(f"computing on {chosen.name}" + (f": {chosen.reason}" if chosen.reason else ""))
        prepare_device(chosen.name)
        if self.threads is not None:
            import torch

            torch.set_num_threads(self.threads)


@dataclass(frozen=True, kw_only=True)
class DecodingCommand(ComputingCommand):
    """A command that decodes a file."""

    tmc3: FlagCreatePairsOff[bool] = False
    """Let the program tmc3 from PATH decode anchor positions that a file has by G-PCC."""

    def prepare(self, *stages: str) -> None:
        """Apply `threads` and `tmc3`; start helpers. Raises UsageError."""
        super().prepare(*stages)
        if self.tmc3:
            allow_tmc3()


@dataclass(frozen=True, kw_only=True)
class MemoryOption:
    """How much of a scene in tiles may be open."""

    memory: Annotated[
        str | None, arg(metavar="SIZE", help_behavior_hint="(default: half of the machine's)")
    ] = None
    """Memory that open tiles of a scene in tiles may take, such as 500MB or 2GB; others are opened again when they are
    in view. The pictures are the same."""

    def allow_memory(self) -> None:
        """Raises UsageError for what is no size."""
        if self.memory is not None:
            from compgs.formats.tiled_scene import ASKED_BY

            os.environ[ASKED_BY] = str(parse_size(self.memory, "--memory"))


@dataclass(frozen=True, kw_only=True)
class FileArgument:
    """Which file."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The .cgs file."""


@dataclass(frozen=True, kw_only=True)
class SceneFileArgument:
    """Which file, of those that hold a scene."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A .cgs file, or splats: .ply (also SuperSplat's .compressed.ply), .spz, .sog (or its meta.json or
    lod-meta.json), .glb, .gltf, .ksplat, .splat."""


@dataclass(frozen=True, kw_only=True)
class SceneFileOrRunArgument:
    """Which file; one that a run has left brings its scene along."""

    file: Annotated[Positional[Path], arg(metavar="FILE|RUN")]
    """A .cgs file, the manifest.json of a scene in tiles, or splats: .ply (also SuperSplat's .compressed.ply), .spz,
    .sog (or its meta.json or lod-meta.json), .glb, .gltf, .ksplat, .splat; or the folder of a run, for its file, and
    its scene read as in training."""


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How a scene is read."""

    downscale: Annotated[
        str | None,
        arg(
            aliases=["-r", "--resolution"],
            metavar="N|auto",
            help_behavior_hint="(default: 1; auto where there is no GPU)",
        ),
    ] = None
    """Read images N times smaller; images_N is used where it exists. auto: photographs of more than 2 megapixels at
    1600 pixels of their longer side."""

    images: Annotated[str, arg(aliases=["-i"], metavar="FOLDER")] = "images"
    """Folder of the images inside the scene."""

    test_every: Annotated[int, arg(metavar="N")] = 8
    """Every N-th view, by name, is held out for evaluation."""

    hold_out: Annotated[Literal["auto", "every", "sector"], arg(metavar="auto|every|sector")] = "auto"
    """Which views are held out. every: one in N by name, between training views. sector: as many around the first by
    name, a part of the scene that no training view sees from there. auto: those that the capture itself names, else as
    every."""

    background: Annotated[
        tuple[float, float, float] | None, arg(metavar="R G B", help_behavior_hint=NO_DEFAULT)
    ] = None
    """Color behind everything, 0 to 1; by default white for Blender scenes, else black."""

    def source_at(self, path: Path, *, holdout: bool = True) -> SceneSource:
        """Raises UsageError for options that no scene could be read by."""
        self.check_reading()
        ordinary = SceneSource(str(path), 1, "images", 8, holdout, None)
        given = self.given_reading()
        if "downscale" not in given and self.is_on_cpu():
            given["downscale"] = AUTO
        return dataclasses.replace(ordinary, **given)

    def is_on_cpu(self) -> bool:
        """Whether the command will compute there. Raises ConfigError for a device that is not there."""
        from compgs.devices import CPU, chosen_device

        return chosen_device(getattr(self, "device", None)) == CPU

    def given_reading(self) -> dict[str, Any]:
        """Return the fields of a `SceneSource` that were given. Raises UsageError."""
        options = {field.name: field.default for field in dataclasses.fields(ReadingOptions)}
        given = {name: getattr(self, name) for name in options if getattr(self, name) != options[name]}
        if "downscale" in given:
            given["downscale"] = parse_downscale(str(given["downscale"]))
        if "hold_out" in given:
            given["split"] = given.pop("hold_out")
        return given

    def check_reading(self) -> None:
        """Raises UsageError."""
        from compgs.scene import check_reading

        downscale = self.given_reading().get("downscale", 1)
        with settings_of_options():
            check_reading(downscale, self.test_every, self.background, self.hold_out)


@dataclass(frozen=True, kw_only=True)
class SceneOptions(ReadingOptions):
    """Which scene, and how it is read."""

    scene: Annotated[Positional[Path | None], arg(metavar="SCENE", help_behavior_hint=NO_DEFAULT)] = None
    """Folder of the scene: COLMAP (images/ and sparse/), Blender or nerfstudio (transforms*.json)."""

    source: Annotated[
        Path | None, arg(aliases=["-s", "--source-path"], metavar="SCENE", help_behavior_hint=NO_DEFAULT)
    ] = None
    """The same, spelled as 3DGS does."""

    def scene_source(self, *, holdout: bool = True) -> SceneSource:
        """Raises UsageError if not exactly one scene was given."""
        return self.source_at(one_scene(self.scene, self.source), holdout=holdout)

    def source_of_run(self, begun: SceneSource) -> SceneSource:
        """Return how a run read its scene, with what is given here in its place. Raises UsageError."""
        self.check_reading()
        given = self.given_reading()
        if self.scene or self.source:
            given["path"] = str(one_scene(self.scene, self.source))
        return dataclasses.replace(begun, **given)


def one_scene(scene: Path | None, source: Path | None) -> Path:
    """SCENE or --source, whichever was given. Raises UsageError for none or two."""
    if scene is not None and source is not None and scene != source:
        raise UsageError(f"two scenes were given: {scene} and --source {source}; give one")
    chosen = scene or source
    if chosen is None:
        raise UsageError("no scene was given: name its folder; --help shows how")
    return chosen


def use_threads(count: int) -> None:
    """Set the number of numba's threads. Raises UsageError."""
    import numba

    limit = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    check_range("--threads", count, 1, limit)
    numba.set_num_threads(count)


def allow_tmc3() -> None:
    """Let this process call tmc3 from now on."""
    from compgs.codec.tmc3 import ASKED_BY

    os.environ[ASKED_BY] = "1"


def check_measures(*, lpips: bool | Path, flip: bool) -> None:
    """Raises MissingDependency, with the remedy, where one that is asked for cannot be measured.

    `lpips`: a path is that of the weights.
    """
    from compgs.metrics import check_flip, lpips_network

    if lpips:
        lpips_network(None if lpips is True else lpips)
    if flip:
        check_flip()


def choose_device(device: str | None) -> "Choice":
    """The device that a command computes on, and why. Raises ConfigError, MissingDependency."""
    from compgs import devices

    if device is not None:
        check_device(device)
    return devices.choose(device)


def prepare_device(name: str) -> None:
    """Load or compile what computes on a device; say so where that takes minutes. Raises MissingDependency."""
    from compgs import devices

    devices.prepare_device(name, say)


def check_device(name: str) -> None:
    """Raises ConfigError for a device that is not known or not there, UsageError for what is no device."""
    from compgs import devices

    try:
        devices.check_device(name)
    except ConfigError as error:
        kind = type(error) if name.startswith("cuda") else UsageError
        raise kind(f"--{error}") from error
