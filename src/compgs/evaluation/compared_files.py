"""What a comparison of two files found.

`results.json` (one object):

| key | unit, meaning |
|---|---|
| schema | "compgs comparison 1" |
| compgs | version of the program that compared |
| a, b | the files, see below |
| scene | name of the scene whose photographs both were compared with, or null |
| cameras | where the cameras come from, in words |
| views, width, height | number of cameras; pixels of the first |
| identical | every picture of b is equal to that of a |
| psnr | dB, of b's pictures against a's, mean over the views; equal ones count as 100; null if all are |
| ssim | of b's pictures against a's, mean over the views |
| lpips, lpips_3dgs | the same, in both conventions (`compgs.metrics`), or null; `lpips_note` then says why |
| worst_view, worst_psnr | name of the view in which they differ most; its dB, null if identical |
| device, threads | where it ran |
| notes | what was decided, one sentence each |

Of each file:

| key | unit, meaning |
|---|---|
| file, format, bytes, sha256 | name, kind by its first bytes, size and hash |
| components | bytes by component; they sum to `bytes` |
| primitives | that are drawn: coupled primitives or splats |
| anchors, coupled_primitives, splats | counts, null what the file does not have |
| psnr, ssim, lpips, lpips_3dgs | against the photographs, mean over the views; null without photographs |
| decode_seconds, render_seconds | file to model, kernels loaded; median over the views |

`per_view.json`: a list in the views' order with `name`, `file` (of the pictures in `a`, `b`, `difference` and `gt`),
`psnr`, `ssim`, `lpips`, `lpips_3dgs` (of b against a), the same with `a_` and `b_` before it (of each against the
photograph, or null) and `difference_scale`: levels, of 255, at which `difference` is white.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from compgs import metrics

SCHEMA = "compgs comparison 1"


@dataclass(frozen=True)
class ComparedFile:
    """One of the two files."""

    file: str
    format: str
    bytes: int
    sha256: str
    components: dict[str, int]  # bytes
    primitives: int
    anchors: int | None
    coupled_primitives: int | None
    splats: int | None
    psnr: float | None  # dB, against the photographs
    ssim: float | None
    lpips: float | None
    lpips_3dgs: float | None
    decode_seconds: float
    render_seconds: float


@dataclass(frozen=True)
class ComparedView:
    """One camera."""

    name: str
    file: str  # of the pictures in a, b, difference and gt
    psnr: float  # dB, of b's picture against a's; infinite if they are equal
    ssim: float
    lpips: float | None
    lpips_3dgs: float | None
    a_psnr: float | None  # dB, against the photograph
    a_ssim: float | None
    a_lpips: float | None
    a_lpips_3dgs: float | None
    b_psnr: float | None
    b_ssim: float | None
    b_lpips: float | None
    b_lpips_3dgs: float | None
    difference_scale: int  # levels, of 255, at which the picture of the difference is white


@dataclass(frozen=True)
class Comparison:
    """What two files are to each other, and to the photographs."""

    compgs: str
    a: ComparedFile
    b: ComparedFile
    scene: str | None
    cameras: str  # where they come from
    width: int  # pixels
    height: int  # pixels
    device: str
    threads: int
    lpips_note: str | None  # why there is no LPIPS
    notes: tuple[str, ...]
    per_view: tuple[ComparedView, ...]

    @property
    def psnr(self) -> float:
        """dB, of b against a; infinite if all pictures are equal (`metrics.mean_psnr`)."""
        return metrics.mean_psnr([view.psnr for view in self.per_view])

    @property
    def ssim(self) -> float:
        """Return the mean SSIM of b's pictures, with a's as reference."""
        return fmean(view.ssim for view in self.per_view)

    @property
    def lpips(self) -> float | None:
        """Return LPIPS of b's pictures against a's, images given in [-1, 1]."""
        return _mean([view.lpips for view in self.per_view])

    @property
    def lpips_3dgs(self) -> float | None:
        """Return LPIPS of b's pictures against a's, images given in [0, 1]."""
        return _mean([view.lpips_3dgs for view in self.per_view])

    @property
    def identical(self) -> bool:
        return math.isinf(self.psnr)

    @property
    def worst(self) -> ComparedView:
        """The view in which b differs most from a."""
        return min(self.per_view, key=lambda view: view.psnr)

    def in_words(self) -> list[str]:
        """What there is to say about two files, a sentence a line."""
        of_views = (
            f"{len(self.per_view)} {self.cameras}" if len(self.per_view) > 1 else f"1 of {self.cameras}"
        )
        size = f"{self.width} x {self.height} pixels"
        if self.identical:
            same = self.a.sha256 == self.b.sha256 and self.a.bytes == self.b.bytes
            lines = ["The files are the same, byte for byte."] if same else []
            return [*lines, f"Their pictures are identical, in {of_views} ({size})."]
        equal = sum(view.psnr == float("inf") for view in self.per_view)
        also = (
            f" {equal} of the pictures are identical and count as {metrics.SAME_PICTURE:.0f} dB."
            if equal
            else ""
        )
        perceived = (
            ""
            if self.lpips is None
            else f", LPIPS {self.lpips:.4f} (as 3DGS measures it {self.lpips_3dgs:.4f})"
        )
        return [
            f"{self.b.file} against {self.a.file}: PSNR {self.psnr:.2f} dB, SSIM {self.ssim:.4f}{perceived}, mean of "
            f"{of_views} ({size}).{also}",
            f"They differ most in {self.worst.name}: {self.worst.psnr:.2f} dB.",
        ]

    def to_dict(self) -> dict[str, Any]:
        """The content of `results.json`."""
        return {
            "schema": SCHEMA,
            "compgs": self.compgs,
            "a": dataclasses.asdict(self.a),
            "b": dataclasses.asdict(self.b),
            "scene": self.scene,
            "cameras": self.cameras,
            "views": len(self.per_view),
            "width": self.width,
            "height": self.height,
            "identical": self.identical,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "lpips": self.lpips,
            "lpips_3dgs": self.lpips_3dgs,
            "lpips_note": self.lpips_note,
            "worst_view": self.worst.name,
            "worst_psnr": self.worst.psnr,
            "device": self.device,
            "threads": self.threads,
            "notes": list(self.notes),
        }

    def per_view_list(self) -> list[dict[str, Any]]:
        """The content of `per_view.json`."""
        return [dataclasses.asdict(view) for view in self.per_view]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None
