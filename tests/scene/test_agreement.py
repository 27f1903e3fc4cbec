"""Whether cameras took the photographs that they are said to have taken."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.cli.cameras import warn_of_other_cameras
from compgs.scene import Points, Scene, View
from compgs.scene.agreement import LEAST_AGREEMENT, color_agreement

SIDE, FOCAL, DISTANCE = 64, 80.0, 5.0


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colors [..., 3] uint8 of a wall at places x, y: waves as long as a fifth of a photograph."""
    waves = [np.sin(4 * x + 5 * y), np.sin(6 * x - 3 * y + 1), np.cos(5 * x + 2 * y)]
    return np.round(127.5 + 120 * np.stack(waves, axis=-1)).astype(np.uint8)


def wall(shifts: np.ndarray) -> Scene:
    """A wall at z = 0, seen straight on by cameras beside each other, with points on it. A closed form: the place that
    a pixel shows is a line's."""
    rows, columns = np.mgrid[0:SIDE, 0:SIDE] + 0.5
    views = []
    for i, shift in enumerate(shifts):
        x = (columns - SIDE / 2) * DISTANCE / FOCAL + shift
        y = (rows - SIDE / 2) * DISTANCE / FOCAL
        world_to_camera = np.eye(4)
        world_to_camera[:3, 3] = -shift, 0.0, DISTANCE
        camera = Camera(world_to_camera, FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)
        views.append(View(f"{i}.png", camera, texture(x, y)))
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.uniform(-4, 12, 2000), rng.uniform(-2, 2, 2000), np.zeros(2000)])
    points = Points(places, texture(places[:, 0], places[:, 1]))
    return Scene("wall", tuple(views), (), points, (0.0, 0.0, 0.0), 5.0, Path("wall"))


def exchanged(scene: Scene) -> Scene:
    """The scene where each camera has the photograph that the one three further on took."""
    views = scene.train_views
    return replace(
        scene,
        train_views=tuple(
            replace(view, pixels=views[(i + 3) % len(views)].image) for i, view in enumerate(views)
        ),
    )


def test_points_have_the_colors_of_the_photographs_that_the_cameras_took() -> None:
    scene = wall(np.linspace(0, 8, 9))
    own, others = color_agreement(scene), color_agreement(exchanged(scene))
    assert own is not None and own > 10
    assert others is not None and others < LEAST_AGREEMENT


def test_points_that_are_few_or_guessed_or_of_one_color_say_nothing() -> None:
    scene = wall(np.linspace(0, 8, 9))
    few = Points(scene.points.positions[:20], scene.points.colors[:20])
    gray = Points(scene.points.positions, np.full_like(scene.points.colors, 128))
    plain = tuple(replace(view, pixels=np.full((SIDE, SIDE, 3), 130, np.uint8)) for view in scene.train_views)
    assert color_agreement(replace(scene, points=few)) is None
    assert color_agreement(replace(scene, guessed=True)) is None
    assert color_agreement(replace(scene, points=gray, train_views=plain)) is None
    assert color_agreement(replace(scene, train_views=())) is None


def test_exchanged_photographs_are_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    scene = wall(np.linspace(0, 8, 9))
    warn_of_other_cameras(scene)
    assert capsys.readouterr().err == ""
    warn_of_other_cameras(exchanged(scene))
    said = " ".join(capsys.readouterr().err.split())
    assert (
        said.startswith("warning: wall: the photographs do not look as if") and "compgs reconstruct" in said
    )
