"""Writes a capture as hasty people take it, from a tidy one in COLMAP's layout: with what was done to it known.

    python tools/vary_capture.py plush_480 varied --photometry     # exposure, white balance, vignetting, two responses
    python tools/vary_capture.py plush_480 shaken --poses 3        # poses off by 3 pixels of these photographs
    python tools/vary_capture.py plush_480 visited --moving        # somebody stands in a third of the photographs

`truth.json` in the new folder says what was done to each photograph. Cameras must be pinhole. Held-out photographs, one
in eight by name, are changed like the others but for --moving: what moves is no part of the scene.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from compgs.numerics.rotations import quaternion_from_rotation, rotation_from_quaternion
from compgs.scene.colmap import ColmapCamera, ColmapImage, SparseModel, find_sparse_model, read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model

STOPS = 0.5  # standard deviation of the exposure, in stops of the pixels as they are displayed
BALANCE = 0.08  # standard deviation of the factors on red and blue
VIGNETTING = 0.35  # what the corners lose
GAMMAS = (0.9, 1.1)  # responses of the two phones; photographs take turns
HELD_OUT_EVERY = 8
MOVING_EVERY = 3  # of the photographs that are trained on
MOVING_SIZE = 0.3  # of the picture's height: what somebody takes of it, across


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--photometry", action="store_true")
    parser.add_argument("--poses", type=float, default=0.0, metavar="PIXELS")
    parser.add_argument("--moving", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.output.exists():
        parser.error(f"{given.output}: is there already; remove it, or name another folder")
    chance = np.random.default_rng(given.seed)
    sparse = find_sparse_model(given.scene)
    if sparse is None:
        parser.error(f"{given.scene}: no sparse model of COLMAP is there")
    model = read_sparse_model(sparse)
    model = replace(model, images=tuple(sorted(model.images, key=lambda image: image.name)))
    truth: dict[str, Any] = {"seed": given.seed, "photographs": {image.name: {} for image in model.images}}
    pictures = {
        image.name: np.asarray(Image.open(given.scene / "images" / image.name).convert("RGB"))
        for image in model.images
    }
    if given.moving:
        pictures = visited(pictures, chance, truth)
    if given.photometry:
        model, pictures = retaken(model, pictures, chance, truth)
    if given.poses:
        model = shaken(model, given.poses, chance, truth)
    write(given.output, model, pictures, truth)


def retaken(
    model: SparseModel, pictures: dict[str, np.ndarray], chance: np.random.Generator, truth: dict[str, Any]
) -> tuple[SparseModel, dict[str, np.ndarray]]:
    """The same views by two phones that choose exposure and white balance anew each time."""
    cameras, images, found = dict(model.cameras), [], {}
    second = {number: max(cameras) + 1 + i for i, number in enumerate(model.cameras)}
    for number, other in second.items():
        cameras[other] = second_phone(cameras[number], other)
    for number, image in enumerate(model.images):
        gain, balance = 2.0 ** chance.normal(0.0, STOPS), chance.normal(0.0, BALANCE, 2)
        gains = gain * np.array([1.0 + balance[0], 1.0, 1.0 + balance[1]])
        phone = number % 2
        found[image.name] = taken(pictures[image.name], gains, GAMMAS[phone])
        truth["photographs"][image.name] |= {"gains": gains.tolist(), "gamma": GAMMAS[phone]}
        images.append(replace(image, camera_id=second[image.camera_id] if phone else image.camera_id))
    return replace(model, cameras=cameras, images=tuple(images)), found


def second_phone(camera: ColmapCamera, number: int) -> ColmapCamera:
    """One whose focal length tells it from the first, and shifts nothing by a visible part of a pixel."""
    return replace(camera, camera_id=number, params=(camera.params[0] * (1 + 1e-6), *camera.params[1:]))


def taken(picture: np.ndarray, gains: np.ndarray, gamma: float) -> np.ndarray:
    """[H, W, 3] uint8 as a phone takes it: darker corners, its gains, and its response."""
    height, width = picture.shape[:2]
    down, across = np.mgrid[0:height, 0:width] + 0.5
    squares = ((across - width / 2) ** 2 + (down - height / 2) ** 2) / ((width**2 + height**2) / 4)
    light = picture / 255.0 * (1.0 - VIGNETTING * squares[..., None]) * gains
    return np.rint(255 * np.clip(light, 0.0, 1.0) ** gamma).astype(np.uint8)


def shaken(
    model: SparseModel, pixels: float, chance: np.random.Generator, truth: dict[str, Any]
) -> SparseModel:
    """Cameras turned and moved, each a little: what they show is off by so many pixels, root mean square."""
    images, errors = [], []
    for image in model.images:
        fx = model.cameras[image.camera_id].params[0]
        rotation = rotation_from_quaternion(image.quaternion)
        depth = float(np.median((model.points.positions @ rotation.T + image.translation)[:, 2]))
        # A half of the squares by turning, a half by moving; each of them across and down.
        turn = chance.normal(0.0, pixels / 2 / fx, 3)
        shift = chance.normal(0.0, pixels / 2 / fx * depth, 3)
        moved = replace(
            image,
            quaternion=quaternion_from_rotation(small_rotation(turn) @ rotation),
            translation=small_rotation(turn) @ image.translation + shift,
        )
        images.append(moved)
        off = displacement(model, image, moved)
        errors.append(off)
        truth["photographs"][image.name] |= {
            "quaternion": image.quaternion.tolist(),
            "translation": image.translation.tolist(),
            "off_pixels": off,
        }
    points = replace(model.points, errors=np.full(len(model.points.errors), float(np.mean(errors))))
    return replace(model, images=tuple(images), points=points)


def displacement(model: SparseModel, image: ColmapImage, moved: ColmapImage) -> float:
    """Pixels that the points in a picture are off, root mean square."""
    fx, fy, cx, cy = model.cameras[image.camera_id].params
    camera = model.cameras[image.camera_id]
    places = []
    for pose in (image, moved):
        rotation = rotation_from_quaternion(pose.quaternion)
        x, y, z = (model.points.positions @ rotation.T + pose.translation).T
        ahead = np.where(z > 1e-6, z, np.inf)
        places.append(np.stack([fx * x / ahead + cx, fy * y / ahead + cy], axis=1))
    there = places[0]
    inside = ((there > 0) & (there < (camera.width, camera.height))).all(axis=1) & (there[:, 0] != cx)
    return float(np.sqrt(((places[1] - there)[inside] ** 2).sum(axis=1).mean()))


def small_rotation(turn: np.ndarray) -> np.ndarray:
    """[3] radians about the axes, small -> [3, 3]."""
    half = turn / 2
    return rotation_from_quaternion(np.array([1.0, *half]))


def visited(
    pictures: dict[str, np.ndarray], chance: np.random.Generator, truth: dict[str, Any]
) -> dict[str, np.ndarray]:
    """Somebody in stripes stands somewhere in a third of the photographs that are trained on, elsewhere in each."""
    found = dict(pictures)
    trained = [name for number, name in enumerate(sorted(pictures)) if number % HELD_OUT_EVERY]
    for name in trained[::MOVING_EVERY]:
        picture = pictures[name].copy()
        height, width = picture.shape[:2]
        middle = chance.uniform(0.25, 0.75, 2) * (width, height)
        reach = MOVING_SIZE * height / 2 * chance.uniform(0.7, 1.3, 2) * (0.8, 1.4)
        down, across = np.mgrid[0:height, 0:width] + 0.5
        inside = ((across - middle[0]) / reach[0]) ** 2 + ((down - middle[1]) / reach[1]) ** 2 < 1
        colors = chance.uniform(20, 235, (2, 3))
        stripes = (np.floor(down / (height / 30)) % 2).astype(int)
        picture[inside] = colors[stripes[inside]].astype(np.uint8)
        found[name] = picture
        truth["photographs"][name] |= {"middle": middle.tolist(), "reach": reach.tolist()}
    return found


def write(output: Path, model: SparseModel, pictures: dict[str, np.ndarray], truth: dict[str, Any]) -> None:
    """The scene's folder; photographs as PNG where they were PNG, else as JPEG of hardly any loss."""
    for name, picture in pictures.items():
        target = output / "images" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        options = {} if target.suffix.lower() == ".png" else {"quality": 97, "subsampling": 0}
        Image.fromarray(picture).save(target, **options)
    write_sparse_model(output / "sparse" / "0", model.cameras.values(), model.images, model.points)
    (output / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
