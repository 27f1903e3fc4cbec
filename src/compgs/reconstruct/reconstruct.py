"""From photographs to a scene: the stages in order."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from PIL import Image

from compgs.errors import ConfigError, SceneError
from compgs.outputs import write_json
from compgs.reconstruct import video
from compgs.reconstruct.cameras import SharedCamera, lens_model, shared_camera
from compgs.reconstruct.mapping import (
    Job,
    Progress,
    Stage,
    check_colmap,
    run_colmap,
    silent,
    undistort_images,
)
from compgs.reconstruct.photographs import (
    JPEG_QUALITY,
    Photograph,
    find_photographs,
    store_masks,
    store_upright,
)
from compgs.reconstruct.reconstruction import Reconstruction
from compgs.reconstruct.report import picture, summary
from compgs.reconstruct.scene_folder import new_scene
from compgs.scene.colmap import SparseModel, read_sparse_model
from compgs.scene.masks import FOLDER as MASKS

# Photographs up to which each is compared with each; of more, those that look alike are (`retrieval`).
EXHAUSTIVE_UP_TO = 60
LENSES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")


@dataclass(frozen=True)
class ReconstructOptions:
    """How poses are found. The defaults suit some 30 to 300 photographs, or a video, of something that stands still."""

    matching: Literal["auto", "exhaustive", "sequential", "retrieval"] = "auto"
    overlap: int = 10  # sequential: neighbours with which a photograph is compared, on each side
    shared: Literal["auto"] | SharedCamera = "auto"  # photographs of one camera share its lens
    lens: str = "auto"  # one of LENSES; auto: OPENCV where many photographs determine it, else SIMPLE_RADIAL
    frames: int = 120  # of a video
    features: int = 4096  # most of a photograph; 8192 finds more in fine texture, in four times the time
    feature_size: int = (
        1600  # pixels of the longer side, beyond which photographs are shrunk to find features
    )
    undistort: bool = False  # write pinhole images, for programs that read no others
    threads: int | None = None
    seed: int = 0


def reconstruct(
    source: Path,
    scene: Path,
    options: ReconstructOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    note: Callable[[str], None] | None = None,
) -> Reconstruction:
    """Finds the poses of the photographs in the folder `source` (or of a video's frames), and writes a scene.

    `scene` gets images/, sparse/0 (COLMAP), reconstruction.json and reconstruction.png; all at once, at the end.
    Raises SceneError where no poses can be found, MissingDependency without pycolmap, OutputError, ConfigError.
    """
    options = options or ReconstructOptions()
    _check(options)
    check_colmap()
    if not source.exists():
        raise SceneError(f"{source}: does not exist; expected a folder of photographs, or a video")
    with new_scene(scene, overwrite=overwrite) as work:
        result = _reconstruct(source, scene, work, options, _Clock(progress or silent))
        if note is not None and result.matching == "exhaustive" and result.photographs > EXHAUSTIVE_UP_TO:
            note("every pair of photographs was compared; --matching retrieval is faster")
    return result


def _reconstruct(
    source: Path, scene: Path, work: Path, options: ReconstructOptions, clock: "_Clock"
) -> Reconstruction:
    target = work / "scene"
    images = target / "images"
    ordered = source.is_file() and video.is_video(source)
    if source.is_file() and not ordered:
        raise SceneError(
            f"{source}: expected a folder of photographs, or a video ({', '.join(video.SUFFIXES)})"
        )
    photographs = (
        _video_frames(source, images, options.frames)
        if ordered
        else _stored(source, images, masks=not options.undistort)
    )
    shared = shared_camera(photographs) if options.shared == "auto" else options.shared
    matching = chosen_matching(options, len(photographs), ordered=ordered)
    job = Job(
        images=str(images),
        database=str(work / "database.db"),
        models=str(work / "models"),
        lens=lens_model(shared, len(photographs)) if options.lens == "auto" else options.lens,
        shared=shared,
        matching=matching,
        overlap=options.overlap,
        features=options.features,
        feature_size=options.feature_size,
        threads=options.threads,
        seed=options.seed,
    )
    Path(job.models).mkdir()
    run_colmap(job, len(photographs), clock)
    seconds = clock.ended()
    best, model, models = _largest(Path(job.models), source, len(photographs))
    if options.undistort:
        best = _undistorted(target, best, work / "undistorted")
        model = read_sparse_model(best)
    (target / "sparse").mkdir(exist_ok=True)
    shutil.copytree(best, target / "sparse" / "0")
    names = {image.name for image in model.images}
    result = Reconstruction(
        scene=scene,
        photographs=len(photographs),
        registered=len(model.images),
        missing=tuple(p.name for p in photographs if p.name not in names),
        points=len(model.points.positions),
        reprojection_error=float(model.points.errors.mean()),
        observations=sum(int((image.point_ids >= 0).sum()) for image in model.images) / len(model.images),
        models=models,
        lens="PINHOLE" if options.undistort else job.lens,
        matching=job.matching,
        seconds=seconds,
        masks=sum(photograph.mask is not None for photograph in photographs),
        masks_kept=not options.undistort,
        video=ordered,
    )
    write_json(target / "reconstruction.json", summary(result, model))
    picture(model).save(target / "reconstruction.png")
    return result


def chosen_matching(
    options: ReconstructOptions, photographs: int, *, ordered: bool
) -> Literal["exhaustive", "sequential", "retrieval"]:
    """Which photographs are compared; `ordered`: they are frames of a video."""
    if options.matching != "auto":
        return options.matching
    if ordered and photographs > 2 * options.overlap:
        return "sequential"
    return "exhaustive" if photographs <= EXHAUSTIVE_UP_TO else "retrieval"


def _check(options: ReconstructOptions) -> None:
    if options.lens != "auto" and options.lens not in LENSES:
        raise ConfigError(f"lens {options.lens!r}: expected auto, {', '.join(LENSES)}")
    for name, low in (("overlap", 1), ("frames", 3), ("features", 128), ("feature_size", 128)):
        if getattr(options, name) < low:
            raise ConfigError(f"{name} {getattr(options, name)}: expected {low} or more")


def _stored(folder: Path, images: Path, *, masks: bool) -> list[Photograph]:
    photographs = find_photographs(folder)
    store_upright(photographs, images)
    if masks:
        store_masks(photographs, images.with_name(MASKS))
    return photographs


def _video_frames(source: Path, images: Path, count: int) -> list[Photograph]:
    """Writes frames as frame_0001.jpg, ..."""
    images.mkdir(parents=True)
    photographs = []
    for index, frame in enumerate(video.sharpest_frames(source, count)):
        path = images / f"frame_{index + 1:04}.jpg"
        Image.fromarray(frame).save(path, quality=JPEG_QUALITY, subsampling=0)
        photographs.append(Photograph(path, path.name, (frame.shape[1], frame.shape[0]), True, ()))
    if len(photographs) < 3:
        raise SceneError(f"{source}: {len(photographs)} frames; poses can be found from 3 on")
    return photographs


def _largest(models: Path, source: Path, photographs: int) -> tuple[Path, SparseModel, int]:
    """The model with the most photographs: its folder, its content, and how many models there are."""
    folders = sorted(path for path in models.iterdir() if path.is_dir())
    found = [(folder, read_sparse_model(folder)) for folder in folders]
    found = [
        (folder, model) for folder, model in found if len(model.images) >= 2 and len(model.points.positions)
    ]
    if not found:
        raise SceneError(
            f"{source}: no two of its {photographs} photographs could be joined; neighbouring ones should show two "
            "thirds of the same, from places apart (walk, do not turn), sharp, of something with texture that stands "
            "still"
        )
    folder, model = max(found, key=lambda pair: len(pair[1].images))
    return folder, model, len(found)


def _undistorted(target: Path, model: Path, place: Path) -> Path:
    """Puts undistorted images in the place of `target`/images; the folder of their sparse model."""
    place.mkdir()
    undistort_images(target / "images", model, place)
    shutil.rmtree(target / "images")
    (place / "images").rename(target / "images")
    return place / "sparse"


class _Clock:
    """Passes progress on, and takes the time of each stage."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.began: dict[Stage, float] = {}

    def __call__(self, stage: Stage, done: int, total: int) -> None:
        self.began.setdefault(stage, time.monotonic())
        self.progress(stage, done, total)

    def ended(self) -> dict[str, float]:
        """Seconds of each stage, the last of which ends now."""
        times = [*self.began.values(), time.monotonic()]
        return {stage: times[i + 1] - times[i] for i, stage in enumerate(self.began)}
