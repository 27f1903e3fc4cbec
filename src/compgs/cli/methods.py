"""The methods that `compgs train` knows: how each trains, which settings it has, and the file it writes."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgs.cli.usage import OPTIONS, UsageError
from compgs.config import Config

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.trained_model import TrainedModel


@dataclass(frozen=True)
class Method:
    """One way from a scene to a file."""

    extension: str  # of the file
    settings: tuple[str, ...]  # sections (`splats`) and single settings (`training.steps`) that it uses
    train: Callable[..., Any]  # arguments as of `compgs.train`
    write: Callable[[Any, Path], int]  # model and path to write it to, replacing what is there; bytes


def _train_hybrid(*arguments: Any, **options: Any) -> "TrainedModel":
    from compgs.training import train

    return train(*arguments, **options)


def _write_hybrid(model: "TrainedModel", path: Path) -> int:
    from compgs.codec import encode

    return encode(model, path, overwrite=True).bytes


def _train_splats(*arguments: Any, **options: Any) -> "SplatModel":
    from compgs.training import train_splats

    return train_splats(*arguments, **options)


def _write_splats(model: "SplatModel", path: Path) -> int:
    from compgs.formats import write_ply

    return write_ply(model.splats, path, overwrite=True)


METHODS = {
    "compgs": Method(".cgs", ("model", "entropy", "control", "training"), _train_hybrid, _write_hybrid),
    "3dgs": Method(
        ".ply",
        (
            "splats",
            "training.steps",
            "training.seed",
            "training.ssim_weight",
            "training.checkpoint_minutes",
        ),
        _train_splats,
        _write_splats,
    ),
}


def check_settings_of(method: str, assignments: Iterable[str]) -> None:
    """Raises UsageError for a `section.key=value` assignment of a setting that the method does not use."""
    known = METHODS[method].settings
    for assignment in assignments:
        name = assignment.partition("=")[0].strip()
        section = name.partition(".")[0]
        if section in Config().to_dict() and section not in known and name not in known:
            ours = ", ".join(f"{k}.*" if "." not in k else k for k in known)
            raise UsageError(
                f"{OPTIONS.get(name, f'--set {name}')}: not a setting of --method {method}, which has {ours}"
            )
