from pathlib import Path

import numpy as np
import pytest

from compgs.errors import ConfigError, OutputError
from compgs.scene import load_scene
from compgs.scene import ray_tracing as rt
from compgs.scene.colmap import read_sparse_model
from compgs.scene.generated import MIN_TRACK, generate_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("generated") / "scene"
    generate_scene(path, views=9, width=48, height=36)
    return path


def test_it_loads_as_a_capture(folder: Path) -> None:
    scene = load_scene(folder)
    assert (len(scene.train_views), len(scene.test_views)) == (7, 2)
    assert scene.train_views[0].image.shape == (36, 48, 3)
    assert len(scene.points) > 1000
    assert scene.notes == ()


def test_observations_are_where_the_points_project(folder: Path) -> None:
    model = read_sparse_model(folder / "sparse" / "0")
    views = {v.name: v for v in load_scene(folder, holdout=False).train_views}
    positions = dict(zip(model.points.point_ids.tolist(), model.points.positions, strict=True))
    tracks = dict.fromkeys(positions, 0)
    for image in model.images:
        camera = views[image.name].camera
        for pixel, point_id in zip(image.observations, image.point_ids.tolist(), strict=True):
            if point_id == -1:
                continue
            x, y, z = camera.rotation @ positions[point_id] + camera.translation
            assert z > 0
            expected = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            np.testing.assert_allclose(pixel, expected, atol=1e-6)
            tracks[point_id] += 1
    assert min(tracks.values()) >= MIN_TRACK
    assert any((image.point_ids == -1).any() for image in model.images)


def test_points_have_the_colors_of_the_photographs(folder: Path) -> None:
    """A point's color is the mean of what its views show there: far closer to them than another point's."""
    scene = load_scene(folder, holdout=False)
    model = read_sparse_model(folder / "sparse" / "0")
    views = {v.name: v for v in scene.train_views}
    colors = model.points.colors.astype(int)
    own, other = [], []
    for image in model.images:
        seen = image.point_ids != -1
        columns, rows = image.observations[seen].astype(int).T
        pixels = views[image.name].image[rows, columns]
        index = image.point_ids[seen] - 1
        own.append(np.abs(pixels - colors[index]).mean(axis=1))
        other.append(np.abs(pixels - colors[np.roll(index, 1)]).mean(axis=1))
    assert np.median(np.concatenate(own)) < 0.35 * np.median(np.concatenate(other))


def test_the_same_seed_gives_the_same_files(folder: Path, tmp_path: Path) -> None:
    generate_scene(tmp_path / "again", views=9, width=48, height=36)
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(files) == 9 + 3 + 1  # photographs, the model, what was asked for
    assert all((folder / f).read_bytes() == (tmp_path / "again" / f).read_bytes() for f in files)
    generate_scene(tmp_path / "other", views=9, width=48, height=36, seed=1)
    image = Path("images") / "view_000.png"
    assert (folder / image).read_bytes() != (tmp_path / "other" / image).read_bytes()


def test_what_exists_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("keep")
    with pytest.raises(OutputError, match="exists"):
        generate_scene(tmp_path, views=2, width=16, height=16)
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]


def test_an_interrupted_generation_leaves_nothing_behind(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate_scene(tmp_path / "scene", views=2, width=16, height=16, progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_settings_out_of_range_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at least 2 views"):
        generate_scene(tmp_path / "scene", views=1)


def solid(kind: int, center: tuple, size: tuple, yaw: float = 0.0) -> rt.Solids:
    return rt.Solids(
        np.array([kind]),
        np.array([center], dtype=np.float64),
        np.array([size], dtype=np.float64),
        np.array([yaw]),
        np.array([rt.MARBLE]),
        np.full((1, 2, 3), 0.5),
        np.array([0.0]),
    )


def inside(points: np.ndarray, kind: int, center: tuple, size: tuple, yaw: float) -> np.ndarray:
    """[N] bool, from the definition of each solid."""
    x, y, z = (points - np.array(center)).T
    x, y = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
    if kind == rt.SPHERE:
        return x**2 + y**2 + z**2 < size[0] ** 2
    if kind == rt.CYLINDER:
        return (x**2 + y**2 < size[0] ** 2) & (abs(z) < size[2])
    return (abs(x) < size[0]) & (abs(y) < size[1]) & (abs(z) < size[2])


@pytest.mark.parametrize(
    ("kind", "size"),
    [(rt.SPHERE, (0.8, 0.8, 0.8)), (rt.BOX, (0.5, 0.7, 0.9)), (rt.CYLINDER, (0.6, 0.6, 0.9))],
)
def test_rays_end_where_marching_along_them_enters_the_solid(kind: int, size: tuple) -> None:
    rng = np.random.default_rng(0)
    center, yaw = (0.3, -0.2, 0.1), 0.6
    origins = rng.normal(size=(300, 3))
    origins *= 4 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-1, 1, size=(300, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = rt.trace(solid(kind, center, size, yaw), origins, directions)
    steps = np.arange(0, 8, 0.004)
    for origin, direction, distance in zip(origins, directions, found, strict=True):
        hit = inside(origin + steps[:, None] * direction, kind, center, size, yaw)
        if hit.any():
            assert distance == pytest.approx(steps[np.argmax(hit)], abs=0.0041)
        else:
            # none, or so close to an edge that a step goes past it
            beyond = (origin + (distance + 0.004) * direction)[None]
            assert distance > 8 or not inside(beyond, kind, center, size, yaw)[0]


def test_the_ground_and_the_backdrop_are_hit_from_above_and_within() -> None:
    origins = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 2.0]])
    down, up = np.array([0.0, 0.6, -0.8]), np.array([0.0, 0.6, 0.8])
    ground = rt.trace(solid(rt.GROUND, (0, 0, 0), (1, 1, 1)), origins, np.stack([down, up]))
    assert ground[0] == pytest.approx(2.5)
    assert ground[1] > 1e8
    dome = rt.trace(solid(rt.BACKDROP, (0, 0, 0), (9, 9, 9)), origins, np.stack([down, up]))
    assert np.linalg.norm(origins + dome[:, None] * np.stack([down, up]), axis=1) == pytest.approx(9.0)
