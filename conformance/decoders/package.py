"""The package's decoder, as conformance/run.py asks it.

python conformance/run.py python conformance/decoders/package.py
"""

import sys
from pathlib import Path

import numpy as np

from compgs.cameras import Camera
from compgs.codec.content import FileContent, Latents
from compgs.codec.decoder import from_latents
from compgs.codec.reader import read_latents
from compgs.errors import BitstreamError
from compgs.gaussians import Gaussians
from compgs.model.hybrid_model import HybridModel
from compgs.render import render

LARGEST = 2.0**127  # of a number of a Gaussian that is drawn
SMALLEST_NORM = 2.0**-60  # of a quaternion


def decode(file: Path, folder: Path, *size: str) -> None:
    data = file.read_bytes()
    content, latents = read_latents(data[: int(size[0])], prefix=True) if size else read_latents(data)
    from_latents(content, latents)  # refuses heads of another layout
    for name, array in arrays(content, latents).items():
        (folder / name).write_bytes(array.astype("u1" if array.dtype == np.bool_ else "<i4").tobytes())


def arrays(content: FileContent, latents: Latents) -> dict[str, np.ndarray]:
    heads = dict(content.heads)
    tensors = [heads[name] for name in content.dimensions.head_shapes]
    found = {
        "coordinates": content.coordinates,
        "mask": content.mask,
        "heads": np.concatenate([np.append(tensor.exponent, tensor.values) for tensor in tensors]),
    }
    for i, (group, values) in enumerate(zip(content.groups, latents, strict=True)):
        found |= {f"symbols{i}": group.symbols, f"latents{i}": values}
    return found


def model_of(file: Path) -> HybridModel:
    return from_latents(*read_latents(file.read_bytes()))


def predict(file: Path, folder: Path, *center: str) -> None:
    pose = np.eye(4)
    pose[:3, 3] = -np.array(center, np.float64)
    rows = stacked(model_of(file).gaussians(Camera(pose, 1, 1, 1, 1, 1, 1)))
    drawn = (np.abs(rows) < LARGEST).all(1) & (np.linalg.norm(rows[:, 6:10], axis=1) >= SMALLEST_NORM)
    (folder / "gaussians").write_bytes(rows[drawn].astype("<f4").tobytes())


def stacked(gaussians: Gaussians) -> np.ndarray:  # [M, 14]
    fields = ("means", "scales", "quaternions", "opacities", "colors")
    return np.concatenate([getattr(gaussians, field).reshape(len(gaussians), -1) for field in fields], 1)


def render_picture(file: Path, folder: Path, *numbers: str) -> None:
    values = [float(number) for number in numbers]
    pose = np.eye(4)
    pose[:3] = np.array(values[:12]).reshape(3, 4)
    width, height = int(values[16]), int(values[17])
    model = model_of(file)
    pose[:3, 3] -= pose[:3, :3] @ np.array(model.world_offset)  # from the local frame to the world
    image = render(model, Camera(pose, *values[12:16], width, height)).image
    pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    (folder / "picture.ppm").write_bytes(b"P6\n%d %d\n255\n" % (width, height) + pixels.tobytes())


ACTIONS = {"decode": decode, "predict": predict, "render": render_picture}


def main() -> None:
    for line in sys.stdin:
        action, file, folder, *more = line.rstrip("\n").split("\t")
        try:
            ACTIONS[action](Path(file), Path(folder), *more)
            answer = "ok"
        except BitstreamError as error:
            answer = type(error).__name__
        print(answer, flush=True)


if __name__ == "__main__":
    main()
