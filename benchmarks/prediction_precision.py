"""How far prediction in float32 is from the same in float64: the table of docs/bitstream_prediction.md, "Precision".

    python benchmarks/prediction_precision.py

Content is made up. "Tolerance" is a share of what the document allows: 1 would just conform.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from compgs.cameras import Camera
from compgs.codec.decoder import from_latents
from compgs.codec.reader import read_latents
from compgs.codec.writer import write_content
from compgs.gaussians import Gaussians
from compgs.model import HybridModel
from compgs.tensors.prediction import predict_by_torch, see
from compgs.tensors.scenes import HybridOnDevice

sys.path.append(str(Path(__file__).parent.parent / "tools"))
from made_content import make_content, make_dimensions, paper_groups
from made_heads import make_heads
from make_golden_gaussians import plain_content
from plain_prediction import CUTOFF, Arrays, Content, primitives, rounded, stacked, tolerances

DIMENSIONS = (
    make_dimensions(),
    make_dimensions(heads="separate"),
    make_dimensions(3, paper_groups(256, 64, 2, 2), "paired", 512),
)
FIELDS = {
    "mean": "means",
    "scales": "scales",
    "quaternion": "quaternions",
    "opacity": "opacities",
    "color": "colors",
}


def camera_at(center: tuple[float, float, float]) -> Camera:
    """A camera with the axes of the world."""
    pose = np.eye(4)
    pose[:3, 3] = -np.array(center)
    return Camera(pose, 50, 50, 32, 32, 64, 64)


def arrays(gaussians: Gaussians) -> Arrays:
    return {name: np.asarray(getattr(gaussians, field), np.float64) for name, field in FIELDS.items()}


def by_torch(model: HybridModel, camera: Camera) -> Gaussians:
    """The readable prediction in float32; its networks run in kernels."""
    scene = HybridOnDevice.of(model, torch.device("cpu"))
    p, center = scene.primitive_tensors, torch.tensor(camera.center, dtype=torch.float32)
    seen = see(p.references, p.positions, center, model.distance_unit)
    with torch.no_grad():
        return predict_by_torch(scene.networks, p, seen).gaussians


def deviations(found: Arrays, truth: Arrays) -> dict[str, float]:
    """Largest deviation of each kind of number, in units of its tolerance."""
    allowed = tolerances(truth)
    return {name: float((np.abs(found[name] - truth[name]) / allowed[name]).max()) for name in FIELDS}


def ways() -> dict[str, Callable[[HybridModel, Content, Camera, list[int]], Arrays]]:
    """Ways to compute the Gaussians that are drawn; the last argument are their rows."""

    def plain(dtype: type) -> Callable[[HybridModel, Content, Camera, list[int]], Arrays]:
        def compute(_: HybridModel, content: Content, camera: Camera, rows: list[int]) -> Arrays:
            found = list(primitives(rounded(content, dtype), tuple(camera.center)))
            return stacked([found[row] for row in rows])

        return compute

    return {
        "kernels": lambda model, _, camera, rows: arrays(model.gaussians(camera)),
        "torch": lambda model, _, camera, rows: arrays(by_torch(model, camera)),
        "numpy, float32": plain(np.float32),
        "numpy, float16": plain(np.float16),
    }


def cases() -> Iterator[tuple[str, HybridModel, Content]]:
    for d in DIMENSIONS:
        made = make_content(120, 1, d, kept=0.7)
        made = replace(made, heads=make_heads(np.random.default_rng(2), d))
        content, latents = read_latents(write_content(made))
        model = from_latents(content, latents)
        yield f"{d.heads}, width {d.width}", model, plain_content(content, latents)


def main() -> None:
    print("| Content | Computed by | " + " | ".join(FIELDS) + " |")
    print("|---" * (2 + len(FIELDS)) + "|")
    for name, model, content in cases():
        middle = content.coordinates.mean(0) * content.voxel_size
        center = tuple(middle + np.array([0.3, -1.0, 2.0]))
        truth = list(primitives(content, center))
        rows = [row for row, p in enumerate(truth) if p.opacity > CUTOFF]
        for way, compute in ways().items():
            found = compute(model, content, camera_at(center), rows)
            shares = deviations(found, stacked([truth[row] for row in rows]))
            print(f"| {name} | {way} | " + " | ".join(f"{share:.2g}" for share in shares.values()) + " |")


if __name__ == "__main__":
    main()
