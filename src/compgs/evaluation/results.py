"""What an evaluation found, and how it is written down.

`results.json` (one object; every number from the decoded file, on held-out views):

| key | unit, meaning |
|---|---|
| schema | "compgs results 1" |
| compgs | version of the program that evaluated |
| scene, file | names |
| method | that wrote the file, if a run evaluated it; else null |
| views, width, height | number of held-out views; pixels of the first |
| psnr | dB, mean over the views; null if infinite: all renderings are perfect |
| ssim | mean over the views |
| psnr_colors_fitted, ssim_colors_fitted | the same, with the colors of each rendering fitted to its photograph |
| psnr_poses_aligned, ssim_poses_aligned | from where the file looks most like each photograph; null: not asked for |
| lpips | on VGG16, images given to it in [-1, 1]: mean over the views, or null; `lpips_note` then says why |
| lpips_3dgs | the same, images given in [0, 1] as the release of 3DGS does: what its field's tables have |
| flip | mean over the views, or null: it was not asked for |
| bytes | of the whole file, or of all files of a scene in tiles |
| components | bytes by component of the file; they sum to `bytes` |
| anchors, coupled_primitives, splats | counts; null what the file does not have: splats are of all files but .cgs |
| bits_per_anchor, bits_per_coupled_primitive, bits_per_splat | all bits of the file by each count, or null |
| first_decode_seconds, decode_seconds | file to model: first in a process (loads kernels, compiles none); again |
| render_seconds | median over the views, after one view to warm up |
| device, threads | where it ran |
| sha256 | of the file; of tiles that of the manifest, which has theirs |
| split | how the held-out views were chosen, in words; empty where that is not known |
| degrees_to_training | angle from a held-out view to the nearest training view, mean over the views; or null |
| notes | sentences: in what the scene is not what the file was trained on, as far as the file's cameras tell |

`per_view.json`: a list in the views' order with `name`, `file` (of `test/renders` and `test/gt`), `psnr`, `ssim`,
`psnr_colors_fitted`, `ssim_colors_fitted`, `psnr_poses_aligned`, `ssim_poses_aligned`, `lpips`, `lpips_3dgs`, `flip`,
`render_seconds`, `degrees_to_training`: the angle to the nearest training view (`compgs.scene.angles`), or null.
"""

import dataclasses
from dataclasses import dataclass
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

from compgs.pictures import table

if TYPE_CHECKING:
    from compgs.evaluation.error_account import ErrorAccount

SCHEMA = "compgs results 1"


@dataclass(frozen=True)
class ViewResult:
    """One held-out view."""

    name: str  # of the view, as the scene has it
    file: str  # of the image in test/renders and test/gt
    psnr: float  # dB
    ssim: float
    psnr_colors_fitted: float  # dB, after an affine fit of the rendering's colors (`evaluation/exposure.py`)
    ssim_colors_fitted: float
    lpips: float | None  # images given in [-1, 1]
    render_seconds: float
    flip: float | None = None
    psnr_poses_aligned: float | None = (
        None  # dB, from where the file looks most like it (`evaluation/alignment.py`)
    )
    ssim_poses_aligned: float | None = None
    lpips_3dgs: float | None = None  # images given in [0, 1]
    degrees_to_training: float | None = None  # angle to the nearest training view; None: there is none


@dataclass(frozen=True)
class Results:
    """A decoded file against the held-out views of a scene."""

    compgs: str
    scene: str
    file: str
    width: int  # pixels
    height: int  # pixels
    bytes: int
    components: dict[str, int]  # bytes
    anchors: int | None
    coupled_primitives: int | None
    splats: int | None
    first_decode_seconds: float
    decode_seconds: float
    device: str
    threads: int
    sha256: str
    lpips_note: str | None  # why there is no LPIPS
    method: str | None  # that wrote the file, where it is known
    per_view: tuple[ViewResult, ...]
    notes: tuple[str, ...] = ()  # in what the scene is not what the file was trained on (`evaluation/fit.py`)
    errors: "ErrorAccount | None" = None  # where the error is, if that was asked for; written to errors.json
    split: str = ""  # how the held-out views were chosen, in words

    @property
    def psnr(self) -> float:
        """dB, mean over the views."""
        return fmean(view.psnr for view in self.per_view)

    @property
    def ssim(self) -> float:
        return fmean(view.ssim for view in self.per_view)

    @property
    def psnr_colors_fitted(self) -> float:
        """dB, mean over the views: with the colors of each rendering fitted to its photograph."""
        return fmean(view.psnr_colors_fitted for view in self.per_view)

    @property
    def ssim_colors_fitted(self) -> float:
        return fmean(view.ssim_colors_fitted for view in self.per_view)

    @property
    def psnr_poses_aligned(self) -> float | None:
        """dB, mean over the views: from where the file looks most like each photograph; None: not asked for."""
        return self._mean("psnr_poses_aligned")

    @property
    def ssim_poses_aligned(self) -> float | None:
        return self._mean("ssim_poses_aligned")

    @property
    def lpips(self) -> float | None:
        return self._mean("lpips")

    @property
    def lpips_3dgs(self) -> float | None:
        return self._mean("lpips_3dgs")

    @property
    def flip(self) -> float | None:
        return self._mean("flip")

    @property
    def degrees_to_training(self) -> float | None:
        """Mean over the views of the angle to the nearest training view."""
        return self._mean("degrees_to_training")

    def _mean(self, measure: str) -> float | None:
        """Mean over the views, or None where not all have it."""
        values = [value for view in self.per_view if (value := getattr(view, measure)) is not None]
        return fmean(values) if len(values) == len(self.per_view) else None

    @property
    def render_seconds(self) -> float:
        return median(view.render_seconds for view in self.per_view)

    @property
    def bits_per_anchor(self) -> float | None:
        return self._bits_per(self.anchors)

    @property
    def bits_per_coupled_primitive(self) -> float | None:
        return self._bits_per(self.coupled_primitives)

    @property
    def bits_per_splat(self) -> float | None:
        return self._bits_per(self.splats)

    def _bits_per(self, count: int | None) -> float | None:
        return None if count is None else 8 * self.bytes / count

    def __repr__(self) -> str:
        return f"Results({self.file!r}, PSNR {self.psnr:.2f} dB, SSIM {self.ssim:.4f}, {self.bytes:,} bytes)"

    def _repr_html_(self) -> str:
        """Show in a notebook what there is."""
        facts = {"PSNR": f"{self.psnr:.2f} dB", "SSIM": f"{self.ssim:.4f}", "bytes": f"{self.bytes:,}"}
        return table(self.file, {**facts, "views": len(self.per_view)})

    def to_dict(self) -> dict[str, Any]:
        """The content of `results.json`."""
        return {
            "schema": SCHEMA,
            "compgs": self.compgs,
            "scene": self.scene,
            "file": self.file,
            "method": self.method,
            "views": len(self.per_view),
            "width": self.width,
            "height": self.height,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "psnr_colors_fitted": self.psnr_colors_fitted,
            "ssim_colors_fitted": self.ssim_colors_fitted,
            "psnr_poses_aligned": self.psnr_poses_aligned,
            "ssim_poses_aligned": self.ssim_poses_aligned,
            "lpips": self.lpips,
            "lpips_3dgs": self.lpips_3dgs,
            "lpips_note": self.lpips_note,
            "flip": self.flip,
            "bytes": self.bytes,
            "components": self.components,
            "anchors": self.anchors,
            "coupled_primitives": self.coupled_primitives,
            "splats": self.splats,
            "bits_per_anchor": self.bits_per_anchor,
            "bits_per_coupled_primitive": self.bits_per_coupled_primitive,
            "bits_per_splat": self.bits_per_splat,
            "first_decode_seconds": self.first_decode_seconds,
            "decode_seconds": self.decode_seconds,
            "render_seconds": self.render_seconds,
            "device": self.device,
            "threads": self.threads,
            "sha256": self.sha256,
            "split": self.split,
            "degrees_to_training": self.degrees_to_training,
            "notes": list(self.notes),
        }

    def per_view_list(self) -> list[dict[str, Any]]:
        """The content of `per_view.json`."""
        return [dataclasses.asdict(view) for view in self.per_view]
