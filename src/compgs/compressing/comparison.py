"""What other formats make of the same splats: written, read again, and looked at from the same cameras."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from compgs import metrics
from compgs.devices import CPU
from compgs.errors import SplatFileError
from compgs.formats import encoded, told
from compgs.model.splats import ORIGIN, SplatModel
from compgs.opening import open_scene
from compgs.render import Renderable, render
from compgs.scene.views import View

COMPARED = ("spz", "sog")


@dataclass(frozen=True)
class Compared:
    """A file of another format, of the same splats."""

    format: str
    bytes: int
    psnr: float  # dB, mean over the views; infinite where all are the same
    ssim: float


@dataclass(frozen=True)
class Comparison:
    """What other formats make of the splats, and why some of them cannot hold these."""

    files: tuple[Compared, ...]
    notes: tuple[str, ...]


def compare(
    model: SplatModel, views: Sequence[View], formats: Sequence[str] = COMPARED, *, device: str = CPU
) -> Comparison:
    """Compare by the same measure as a file of ours: 8-bit pictures against those of the splats."""
    rows, notes = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name in formats:
            splats = model.at(ORIGIN).splats
            try:
                data = encoded(splats, name)
            except SplatFileError as error:  # what one of them cannot hold, ours may
                notes.append(f"the same splats as .{name}: {str(error).partition(';')[0]}")
                continue
            if text := told(splats, name):
                notes.append(f"the same splats as .{name}: {text}")
            file = Path(folder, f"same.{name}")
            file.write_bytes(data)
            again = open_scene(file, device, model.background)
            assert isinstance(again, SplatModel)
            # Neither format says where positions count from.
            again = again.at(model.world_offset)
            rows.append(Compared(name, len(data), *quality(again, views)))
    return Comparison(tuple(rows), tuple(notes))


def quality(model: Renderable, views: Sequence[View]) -> tuple[float, float]:
    """PSNR in dB and SSIM, means over the views."""
    found = []
    for view in views:
        image = metrics.to_8bit(render(model, view.camera).image)
        found.append((metrics.psnr(image, view.image), metrics.ssim(image, view.image)))
    return fmean(psnr for psnr, _ in found), fmean(ssim for _, ssim in found)
