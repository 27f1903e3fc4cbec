"""Writes tests/golden/gaussians.json: the Gaussians that a camera sees of each golden file, by plain float64. And a
picture NAME.png of files that were trained, from the first of their viewpoints, by the readable rasterizer in float64.

    python tools/make_golden_gaussians.py

Run it with make_golden_files.py, after it. Everything is in the local frame of docs/bitstream_prediction.md: world
coordinates minus the file's world offset.
"""

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from compgs.codec.content import FileContent, Latents, Role
from compgs.codec.decoder import decode
from compgs.codec.integer_network import FRACTION_BITS
from compgs.codec.reader import read_latents
from compgs.metrics import to_8bit
from compgs.render import render
from compgs.tensors.scenes import HybridOnDevice

ROOT = Path(__file__).parent.parent
GOLDEN = ROOT / "tests" / "golden"
sys.path += [str(ROOT / "tools"), str(ROOT / "benchmarks")]
from make_golden_files import FOREIGN, TRAINED  # noqa: E402
from plain_prediction import CUTOFF, Content, Primitive, is_drawn, primitives  # noqa: E402

FIELDS = ("mean", "scales", "quaternion", "opacity", "color")
# Their networks' numbers are beyond what the tolerance holds for; a sum over `long` is slow here and says nothing new.
UNLIKELY = (*FOREIGN, "long")
SHOWN = 8  # Gaussians that are written in full
# No opacity may be so near to the threshold that another implementation counts otherwise.
MARGIN = 5e-4
DIRECTIONS = ((0.5, -1.0, 0.25), (-1.0, 0.75, 0.5), (0.25, 0.5, -1.5), (2.0, 0.25, 1.0), (0.0, 0.0, 0.0))


def plain_content(content: FileContent, latents: Latents) -> Content:
    """What was read, as docs/bitstream_prediction.md names it, in the local frame and in float64."""
    heads = {name: tensor.values * 2.0**-tensor.exponent for name, tensor in content.heads}

    def floats(role: Role) -> np.ndarray:
        parts = [
            fixed * (np.array(group.shape.steps) * 2.0**-FRACTION_BITS)
            for group, fixed in zip(content.groups, latents, strict=True)
            if group.shape.role == role
        ]
        return np.concatenate(parts, 1) if parts else np.zeros((0, 0))

    return Content(
        heads=heads,
        layout=content.heads_layout,
        coordinates=content.coordinates,
        mask=content.mask,
        references=floats(Role.REFERENCE),
        log_scales=floats(Role.LOG_SCALES),
        residuals=floats(Role.RESIDUAL),
        voxel_size=content.voxel_size,
        view_distance_scale=content.view_distance_scale,
    )


def golden_gaussians(content: Content) -> dict[str, Any]:
    """Camera, number of Gaussians, the first ones in full, and the sums over all."""
    for center in _centers(content):
        everything = list(primitives(content, center))
        seen = [p for p in everything if is_drawn(p)]
        if seen and all(abs(p.opacity - CUTOFF) > MARGIN for p in everything):
            return {
                "camera_center": list(center),
                "count": len(seen),
                "first": [_as_lists(p) for p in seen[:SHOWN]],
                "sums": {name: _digits(sum(np.array(getattr(p, name)) for p in seen)) for name in FIELDS},
            }
    raise ValueError(
        f"golden Gaussians: from every camera tried nothing is drawn or an opacity is within {MARGIN} of {CUTOFF}; "
        "expected one without: change DIRECTIONS or the made-up heads"
    )


def golden_picture(path: Path) -> np.ndarray:
    """[H, W, 3] uint8 from the first viewpoint: networks, projection and blending by plain torch in float64."""
    model = replace(HybridOnDevice.of(decode(path), torch.device("cpu")), dtype=torch.float64)
    return to_8bit(render(model, model.viewpoints[0]).image)


def _centers(content: Content) -> Iterator[tuple[float, float, float]]:
    """Where to look from: beside the middle of the anchors, in whole voxels, which every precision holds exactly."""
    extent = np.ptp(content.coordinates, axis=0).max() + 4
    for direction in DIRECTIONS:
        voxels = np.rint(content.coordinates.mean(0) + extent * np.array(direction))
        x, y, z = (float(v) * content.voxel_size for v in voxels)
        yield x, y, z


def _as_lists(primitive: Primitive) -> dict[str, Any]:
    numbers = {name: _digits(getattr(primitive, name)) for name in FIELDS}
    return {"anchor": primitive.anchor, "slot": primitive.slot, **numbers}


def _digits(values: Any) -> Any:
    """Nine digits: enough to tell any two float32 numbers apart."""
    if np.ndim(values) == 0:
        return float(f"{float(values):.9g}")
    return [float(f"{v:.9g}") for v in np.asarray(values)]


def main() -> None:
    names = sorted(json.loads((GOLDEN / "hashes.json").read_text(encoding="utf-8")))
    pinned = {}
    for name in names:
        if name in UNLIKELY:
            continue
        content = plain_content(*read_latents((GOLDEN / f"{name}.cgs").read_bytes()))
        pinned[name] = golden_gaussians(content)
        print(f"{name}: {pinned[name]['count']} Gaussians from {pinned[name]['camera_center']}")
    for name in TRAINED:
        Image.fromarray(golden_picture(GOLDEN / f"{name}.cgs")).save(GOLDEN / f"{name}.png", optimize=True)
    path = GOLDEN / "gaussians.json"
    temporary = path.with_name(f".{path.name}.partial")
    temporary.write_text(json.dumps(pinned, indent=2) + "\n", encoding="utf-8")
    os.replace(temporary, path)


if __name__ == "__main__":
    main()
