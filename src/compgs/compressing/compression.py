"""From a file of splats to a small .cgs file: the whole way, in the order in which it is gone.

splats ──place cameras──► views ──train──► model ──encode──► .cgs ──┐
   └──────────────── rendered by cameras not trained on ────────────┴──► PSNR, SSIM, beside .spz and .sog
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from compgs.codec import encode
from compgs.compressing import run
from compgs.compressing.comparison import Compared, compare
from compgs.compressing.deadline import ENOUGH, Deadline
from compgs.compressing.given import given_cameras
from compgs.compressing.pace import steps_within
from compgs.compressing.placing import Placed, between, place_cameras
from compgs.compressing.run import Begun, Looking, folder_of
from compgs.compressing.start import seen_weights, start_points
from compgs.compressing.surroundings import Lens
from compgs.compressing.teacher import teacher_scene
from compgs.config import Config, check_config, load_config
from compgs.devices import chosen_device
from compgs.errors import CheckpointError, ConfigError, NotACompGSFile, OutputError, SplatFileError
from compgs.evaluation import evaluate
from compgs.evaluation.results import Results
from compgs.methods import train
from compgs.model.splats import SplatModel
from compgs.occupied import occupied
from compgs.opening import component_bytes, format_of, open_scene
from compgs.outputs import check_output_file, check_output_folder, write_json
from compgs.paths import as_path
from compgs.progress import shown_training
from compgs.scene.views import Scene
from compgs.training import Plan, TrainingStatus, plan_for
from compgs.training.run.checkpoint import CHECKPOINT_NAME
from compgs.training.run.run import chosen_device as training_device

SPLATS_PER_ANCHOR = 4.0  # at the start; growth adds anchors, pruning removes them
HELD_OUT_EVERY = 8  # of given cameras, by name: as scenes are split (`load_scene`)
FOR_PLACES = 0.15  # of a given time: until places to look from are found
FOR_THE_REST = 0.1  # of a given time: the last look at all views, and writing the file
NEEDED_BYTES = 64 << 20  # checkpoint, file and pictures of a small scene
STEPS = 8000  # unless a preset or a time is asked for: minutes on two cores

Progress = Callable[[int, int], None]  # done, of how many


@dataclass(frozen=True, eq=False)
class Compressed:
    """A file of splats, made small, and what that lost: all figures are of the written file, read again."""

    source: Path
    source_bytes: int
    splats: int
    file: Path
    folder: Path  # of checkpoint, results and pictures
    steps: int
    results: Results  # on cameras that were not trained on
    others: tuple[Compared, ...]  # the same splats in other formats, by the same measure
    notes: tuple[str, ...] = ()  # why they are not in one of these

    def to_dict(self) -> dict[str, Any]:
        """The content of `results.json`: that of an evaluation, and `compress`."""
        return self.results.to_dict() | {
            "compress": {
                "source": self.source.name,
                "source_bytes": self.source_bytes,
                "source_splats": self.splats,
                "steps": self.steps,
                "others": [asdict(each) for each in self.others],
                "notes": list(self.notes),
            }
        }


def compress(
    source: str | Path,
    output: str | Path,
    *,
    config: Config | None = None,
    preset: str | None = None,
    looking: Looking | None = None,
    seconds: float | None = None,
    resume: bool = False,
    overwrite: bool = False,
    device: str | None = None,
    progress: Callable[[TrainingStatus], None] | Literal[False] | None = None,
) -> Compressed:
    """Write splats (.ply, .spz, .sog or another format that is read) as a .cgs file, by training on renderings of them.

    Settings are those of `config`, or of a preset; of neither, those of `default` with STEPS steps. With `seconds` the
    number of steps is chosen so that the file is there after about that long, and steps are passed over where the
    machine becomes slower meanwhile. `looking` says from
    where the splats are looked at: places are found where there is something to see, unless cameras are named.

    Beside the file, in `folder_of(output)`, are a checkpoint, from which `resume` goes on with the settings it began
    with, `results.json`, `per_view.json`, `cameras.json`, pictures and `contact_sheet.png`.

    Raises SplatFileError, NotACompGSFile, SceneError, ConfigError, CheckpointError, OutputError, TrainingError.
    """
    output, source = as_path(output, "output"), as_path(source, "source")
    if config is not None and preset is not None:
        raise ConfigError(f"config and preset={preset!r} were both given: give one")
    check_places(output, overwrite=overwrite or resume)
    with occupied(folder_of(output)):
        if resume:
            compression = resumed(output, source, device=device)
        else:
            chosen = config or default_config(preset)
            compression = begin(
                source, output, chosen, looking, seconds=seconds, overwrite=overwrite, device=device
            )
        with shown_training(progress) as show:
            compression.train(show)
        return compression.judge(_silent if progress is False else None)


def default_config(preset: str | None = None) -> Config:
    """Return the settings of a preset, or those meant for compression."""
    if preset is not None:
        return load_config(preset)
    config = load_config("default")
    return replace(config, training=replace(config.training, steps=STEPS))


@dataclass(frozen=True, eq=False)
class Compression:
    """A compression that has begun: its scene is there, to train on and to judge by."""

    begun: Begun
    splats: SplatModel
    scene: Scene
    file: Path
    device: str
    plan: Plan  # what the training has decided
    goes_on: bool = False  # from a checkpoint
    deadline: Deadline | None = None  # of the training

    def train(self, progress: Callable[[TrainingStatus], None] | None = None) -> int:
        """Train, or go on with it, and write the file; its bytes. Raises TrainingError, OutputError."""

        def tell(status: TrainingStatus) -> None:
            if self.deadline is not None:
                self.deadline.tell(status)
            if progress is not None:
                progress(status)

        watch: Any = self.deadline  # it asks the training to pass over steps, as only this method's can
        model = train(
            self.scene,
            self.begun.config,
            output=folder_of(self.file),
            resume=self.goes_on,
            progress=tell,
            device=self.device,
            plan=self.plan,
            watch=watch,
        )
        return encode(model, self.file, overwrite=True).bytes

    @property
    def steps(self) -> int:
        """Steps of the run that are, or were, learned in."""
        taken = 0 if self.deadline is None else self.deadline.taken
        return taken or self.begun.config.training.steps

    def judge(self, progress: Progress | None = None) -> Compressed:
        """The written file, and other formats, against the splats; all that is found is written down, too."""
        folder = folder_of(self.file)
        results = evaluate(
            self.file,
            self.scene,
            output=folder,
            overwrite=True,
            device=self.device,
            progress=progress,
            truth=self.begun.source.name,
        )
        compared = compare(self.splats, self.scene.test_views, device=self.device)
        compressed = Compressed(
            source=self.begun.source,
            source_bytes=sum(component_bytes(self.begun.source, self.begun.looking.level).values()),
            splats=len(self.splats.splats),
            file=self.file,
            folder=folder,
            steps=self.steps,
            results=results,
            others=compared.files,
            notes=compared.notes + (() if self.deadline is None else rough(self.steps)),
        )
        write_json(folder / "results.json", {**compressed.to_dict(), "plan": self.plan.to_dict()})
        return compressed


def begin(
    source: Path,
    output: Path,
    config: Config,
    looking: Looking | None = None,
    *,
    seconds: float | None = None,
    overwrite: bool = False,
    device: str | None = None,
    progress: Progress | None = None,
) -> Compression:
    """Find cameras, start anchors, and choose the steps if `seconds` are given. Raises as `compress` does."""
    start = time.monotonic()
    check_config(config)
    looking = looking or Looking()
    looking.check()
    if seconds is not None and not seconds > 0:
        raise ConfigError(f"seconds = {seconds}: expected more than none")
    check_places(output, overwrite=overwrite)
    splats = opened(source, looking, device)
    until = None if seconds is None else start + FOR_PLACES * seconds
    placed = placed_cameras(splats, looking, config.training.seed, progress, until)
    scene, size = scene_of(splats, placed, source, config)
    config = replace(config, model=replace(config.model, voxel_size=size))
    deadline = None
    if seconds is not None:
        end = start + seconds * (1 - FOR_THE_REST)
        fitting = steps_within(scene, config, end - time.monotonic(), device, points_at_hand=True)
        config = replace(config, training=replace(config.training, steps=fitting.steps))
        deadline = Deadline(end, fitting.steps, late=fitting.late)
    begun = Begun(source, digest(splats), looking, placed, config)
    run.save(folder_of(output), begun)
    device = chosen_device(device)
    plan = plan_for(scene, config, training_device(device), points_at_hand=True)
    return Compression(begun, splats, scene, output, device, plan, deadline=deadline)


def _silent(done: int, total: int) -> None:
    """Nothing is shown."""


def rough(steps: int) -> tuple[str, ...]:
    """What to say of a file that was trained for so many steps, if it is rough."""
    if steps >= ENOUGH:
        return ()
    return (
        f"{steps:,} steps are few, and the file is rough: from {ENOUGH:,} on it shows what the splats do, and "
        f"{STEPS:,} are the default; give it more time",
    )


def resumed(output: Path, source: Path | None = None, *, device: str | None = None) -> Compression:
    """Go on with what is in `folder_of(output)`; a `source` says where the splats are now.

    Raises CheckpointError if there is nothing to go on with, or the splats are others.
    """
    check_places(output, overwrite=True)
    folder = folder_of(output)
    begun = run.load(folder)
    if source is not None:
        begun = replace(begun, source=source)
    splats = opened(begun.source, begun.looking, device)
    if digest(splats) != begun.sha256:
        raise CheckpointError(
            f"{begun.source}: not the splats that {output} was begun with; compress them anew"
        )
    scene, _ = scene_of(splats, begun.placed, begun.source, begun.config)
    there = (folder / CHECKPOINT_NAME).is_file()
    device = chosen_device(device)
    plan = plan_for(scene, begun.config, training_device(device), points_at_hand=True)
    return Compression(begun, splats, scene, output, device, plan, goes_on=there)


def check_places(output: Path, *, overwrite: bool) -> None:
    """Raises OutputError, before anything is done, for a file or folder that cannot be written."""
    if output.suffix != ".cgs":
        raise OutputError(f"{output}: expected a name that ends in .cgs")
    check_output_file(output, overwrite=overwrite)
    check_output_folder(folder_of(output), overwrite=overwrite, needed_bytes=NEEDED_BYTES)


def opened(source: Path, looking: Looking, device: str | None) -> SplatModel:
    """The splats of a file. Raises SplatFileError, NotACompGSFile."""
    if format_of(source).name in ("cgs", "tiles"):
        raise NotACompGSFile(
            f"{source}: a .cgs file is compressed already; `compgs encode` makes one smaller without training"
        )
    model = open_scene(source, chosen_device(device), looking.background, looking.level)
    if not isinstance(model, SplatModel):
        raise SplatFileError(
            f"{source}: its splats are made anew for each camera by networks; expected splats that stay as they are"
        )
    return model


def digest(splats: SplatModel) -> str:
    """Return a digest by which the splats of a file, or of several files, are known again."""
    result = hashlib.sha256()
    for column in splats.splats.columns.values():
        result.update(np.ascontiguousarray(column).tobytes())
    return result.hexdigest()


def placed_cameras(
    splats: SplatModel,
    looking: Looking,
    seed: int,
    progress: Progress | None = None,
    until: float | None = None,
) -> Placed:
    """Cameras that are placed, or those that are given and more between them; `until` as in `place_cameras`.

    Raises SceneError.
    """
    if looking.cameras is None:
        lens = Lens(looking.width, looking.height)
        count = looking.views, looking.held_out
        return place_cameras(
            splats, *count, lens=lens, up=looking.up, seed=seed, progress=progress, until=until
        )
    given = [looking.fitted(camera) for camera in given_cameras(looking.cameras)]
    trained = [camera for i, camera in enumerate(given) if i % HELD_OUT_EVERY]
    more = max(0, looking.views - len(trained))
    added = between(splats, trained, more, np.random.default_rng(seed)) if len(trained) > 1 else []
    return Placed((*trained, *added), tuple(given[::HELD_OUT_EVERY]))


def scene_of(splats: SplatModel, placed: Placed, source: Path, config: Config) -> tuple[Scene, float]:
    """What training sees, and the size of its voxels in world units."""
    anchors = max(1, round(len(splats.splats) / SPLATS_PER_ANCHOR))
    weights = seen_weights(splats, placed.train)
    points, size = start_points(
        splats, weights, min(anchors, config.model.max_anchors), config.model.voxel_size
    )
    return teacher_scene(splats, placed, points, source), size
