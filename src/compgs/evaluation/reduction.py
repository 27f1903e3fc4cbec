"""A given file, made smaller without training, and what that loses."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs import metrics
from compgs.cameras import Camera
from compgs.codec.content import FileContent
from compgs.codec.decoder import from_latents
from compgs.codec.reader import read_latents
from compgs.codec.reduce import with_coarser_covariances, without_coupled
from compgs.codec.row_fitting import with_fitted_rows
from compgs.codec.writer import Geometry, write_content
from compgs.devices import placed
from compgs.errors import ConfigError
from compgs.evaluation.importance import importance
from compgs.evaluation.measure import compared
from compgs.model.hybrid_model import HybridModel
from compgs.render import render
from compgs.scene.views import View

if TYPE_CHECKING:
    from compgs.devices import Device

COARSEST = 64.0  # times the covariances' step; beyond it, nothing of them is left
IDENTICAL = 99.0  # dB that identical images count for in a mean


@dataclass(frozen=True)
class Side:
    """A file, before or after it was made smaller."""

    bytes: int
    anchors: int
    coupled_primitives: int
    held_out_psnr: float | None  # dB against the held-out photographs; None without any


@dataclass(frozen=True)
class Reduction:
    """A file before and after it was made smaller, and the loss."""

    drop: float  # share of the coupled primitives left out
    coarser: float  # times the covariances' step
    before: Side
    after: Side
    cameras: int  # with which importance and loss were measured
    psnr: float  # dB of the new file's renderings against the old one's, mean over these cameras

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def reduce_file(
    data: bytes,
    *,
    drop: float = 0.0,
    coarser: float = 1.0,
    cameras: Sequence[Camera],
    held_out: Sequence[View] = (),
    geometry: Geometry = "octree",
    device: "Device | None" = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[bytes, Reduction]:
    """The bytes of a smaller file, and its loss.

    `drop`: share of the coupled primitives to leave out, those that contribute least to the images of the cameras;
    anchors without any go too. `coarser`: factor on the quantization step of the anchors' covariances. `progress(done,
    total)` counts cameras looked at.

    Raises ConfigError for other values, or if the file would not become smaller; BitstreamError if it is damaged.
    """
    check_reduction(drop, coarser)
    content, latents = read_latents(data)
    model = placed(from_latents(content, latents), device)
    smaller = content
    if drop > 0:
        smaller = without_coupled(smaller, most_important(model, cameras, drop, progress))
    if coarser > 1:
        smaller = with_coarser_covariances(smaller, coarser)
    if smaller.angular_dilation is not None:
        smaller = with_fitted_rows(smaller)
    smaller = replace(smaller, metadata={**content.metadata, "reduced": described(content, drop, coarser)})
    result = write_content(smaller, geometry)
    if len(result) >= len(data):
        raise ConfigError(
            f"drop {drop:g}, coarser {coarser:g}: the file would take {len(result)} bytes, it has {len(data)}; "
            "ask for more, or keep the file"
        )
    reduced = placed(from_latents(*read_latents(result)), device)
    return result, Reduction(
        drop=drop,
        coarser=coarser,
        before=_side(data, model, held_out),
        after=_side(result, reduced, held_out),
        cameras=len(cameras),
        psnr=fmean(
            min(IDENTICAL, metrics.psnr(_image(reduced, camera), _image(model, camera))) for camera in cameras
        ),
    )


def check_reduction(drop: float, coarser: float) -> None:
    """Raises ConfigError for values that mean nothing."""
    if not 0.0 <= drop < 1.0:
        raise ConfigError(f"drop = {drop:g}: expected a share of the coupled primitives, 0 up to below 1")
    if not 1.0 <= coarser <= COARSEST:
        raise ConfigError(
            f"coarser = {coarser:g}: expected a factor on the covariances' step, 1 to {COARSEST:g}"
        )
    if drop == 0.0 and coarser == 1.0:
        raise ConfigError("drop = 0, coarser = 1: nothing would change; give one of them")


def most_important(
    model: HybridModel,
    cameras: Sequence[Camera],
    drop: float,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:  # [P] bool
    """All coupled primitives but the share `drop` (rounded down) that contributes least; of equal ones the later go."""
    weights = importance(model, cameras, progress)
    kept = np.ones(len(weights), np.bool_)
    # From the end, so that of equal ones the first stay.
    order = len(weights) - 1 - np.argsort(weights[::-1], kind="stable")
    kept[order[: int(drop * len(weights))]] = False
    return kept


def described(content: FileContent, drop: float, coarser: float) -> str:
    """Text for the metadata: this reduction, after those that the file had before."""
    steps = [f"drop {drop:g}"] * (drop > 0) + [f"coarser {coarser:g}"] * (coarser > 1)
    earlier = content.metadata.get("reduced")
    return ", ".join([*([earlier] if earlier else []), *steps])


def _image(model: HybridModel, camera: Camera) -> np.ndarray:
    return metrics.to_8bit(render(model, camera).image)


def _side(data: bytes, model: HybridModel, held_out: Sequence[View]) -> Side:
    psnrs = [metrics.psnr(*compared(_image(model, view.camera), view)) for view in held_out]
    psnr = fmean(psnrs) if psnrs else None
    return Side(len(data), model.anchors, model.coupled, psnr)
