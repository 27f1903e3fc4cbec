"""A file in tiles: together they have its primitives bit by bit, and each one stands alone."""

from pathlib import Path

import numpy as np
import pytest

from compgs.codec.content import FileContent, Role, dequantize
from compgs.codec.reader import read_content
from compgs.errors import ConfigError, NotACompGSFile, NotEncodable, OutputError
from compgs.exporting import export
from compgs.formats.tiled import Core, read_manifest
from compgs.formats.tiled_ground import contains, grid_of, ground_across
from compgs.opening import open_scene
from compgs.render import render

GOLDEN = Path(__file__).parents[1] / "golden"
# With hyperpriors; neighbours; neighbours, own residuals and viewpoints; one mean a channel; as published.
FILES = ["default", "dilated", "rows", "shallow", "constant", "paper"]


def latents_by_place(content: FileContent) -> dict[tuple[int, ...], list[list[int]]]:
    """What a decoder has of each anchor that has primitives, by its voxel: its mask, and its latents of all groups."""
    first = np.concatenate([[0], np.cumsum(content.mask.sum(1))])
    found: dict[tuple[int, ...], list[list[int]]] = {}
    latents = dequantize(content)
    for i, place in enumerate(content.coordinates.tolist()):
        if not content.mask[i].any():
            continue
        rows = [
            x[first[i] : first[i + 1]] if group.shape.role == Role.RESIDUAL else x[i]
            for group, x in zip(content.groups, latents, strict=True)
        ]
        found[tuple(place)] = [content.mask[i].tolist(), *(row.ravel().tolist() for row in rows)]
    return found


@pytest.mark.parametrize("name", FILES)
def test_tiles_have_the_latents_of_the_file_and_its_networks(name: str, tmp_path: Path) -> None:
    source = GOLDEN / f"{name}.cgs"
    done = export(source, tmp_path / "a.tiles", grid="2x2")
    whole, together = read_content(source.read_bytes()), {}
    files = sorted((tmp_path / "a.tiles").glob("*.cgs"))
    for file in files:
        part = read_content(file.read_bytes())
        assert [t.tobytes() for t in heads(part)] == [t.tobytes() for t in heads(whole)]
        found = latents_by_place(part)
        assert not together.keys() & found.keys()
        together |= found
    assert together == latents_by_place(whole)
    assert (done.tiles, done.splats, done.psnr) == (4, None, ()) and len(files) == 4
    assert done.bytes == sum(file.stat().st_size for file in (tmp_path / "a.tiles").iterdir())


def heads(content: FileContent) -> list[np.ndarray]:
    return [tensor.values for _, tensor in content.heads]


def test_their_picture_is_that_of_the_file(tiny_cgs: Path, tmp_path: Path) -> None:
    export(tiny_cgs, tmp_path / "tiny.tiles", grid="3x1")
    whole, tiles = open_scene(tiny_cgs), open_scene(tmp_path / "tiny.tiles")
    assert tiles.counts == whole.counts and tiles.background == whole.background
    assert len(tiles.viewpoints) == len(whole.viewpoints) > 1
    for camera in whole.viewpoints[:4]:
        np.testing.assert_allclose(render(tiles, camera).image, render(whole, camera).image, atol=2e-6)


def test_anchors_are_in_the_cores_of_their_tiles_about_as_many_in_each(
    tiny_cgs: Path, tmp_path: Path
) -> None:
    export(tiny_cgs, tmp_path / "tiny.tiles", grid="2x3")
    manifest = read_manifest(tmp_path / "tiny.tiles" / "manifest.json")
    assert manifest.ground is not None
    right, forward = np.array(manifest.ground.right), np.array(manifest.ground.forward)
    counts = []
    for tile in manifest.tiles:
        content = read_content((tmp_path / "tiny.tiles" / tile.file).read_bytes())
        positions = content.coordinates * content.voxel_size + np.array(content.world_offset)
        away = positions - np.array(manifest.ground.origin)
        assert isinstance(tile.core, Core)
        assert contains(tile.core, np.stack([away @ right, away @ forward], 1)).all()
        counts.append(len(content.coordinates))
    assert len(counts) == 6 and max(counts) - min(counts) <= 4


def test_by_default_a_small_file_is_one_tile_and_tiles_of_large_ones_are_about_square() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(size=(10_000, 2)) * [40.0, 10.0]
    assert grid_of(1, places) == (1, 1)
    assert grid_of(16, places) == (8, 2)
    assert grid_of(16, places[:, ::-1]) == (2, 8)


def test_the_ground_lies_across_the_sky_along_which_points_spread_most() -> None:
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(2_000, 3)) * [1.0, 5.0, 3.0]
    ground = ground_across((0.0, 0.0, 1.0), positions)
    np.testing.assert_allclose(ground.right, [0.0, 1.0, 0.0], atol=0.05)
    np.testing.assert_allclose(ground.forward, [-1.0, 0.0, 0.0], atol=0.05)


def test_latents_that_depend_on_the_place_in_the_whole_scene_are_refused(tmp_path: Path) -> None:
    with pytest.raises(NotEncodable, match=r"odd\.cgs: latents depend on where an anchor is"):
        export(GOLDEN / "odd.cgs", tmp_path / "a.tiles", grid="2x2")
    assert not (tmp_path / "a.tiles").exists()


def test_what_cannot_be_tiles_is_refused(tiny_cgs: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="grid 2y1: expected auto, or columns and rows"):
        export(tiny_cgs, tmp_path / "a.tiles", grid="2y1")
    with pytest.raises(ConfigError, match="cannot be cut into 30 parts; use fewer tiles"):
        export(tiny_cgs, tmp_path / "a.tiles", grid="30x30")
    with pytest.raises(ConfigError, match="max_bytes = 1000"):
        export(tiny_cgs, tmp_path / "a.tiles", max_bytes=1000)
    with pytest.raises(ConfigError, match=r"grid = 2x1: only folders of tiles have one"):
        export(tiny_cgs, tmp_path / "a.spz", grid="2x1")
    export(tiny_cgs, tmp_path / "a.ply", refine=0)
    with pytest.raises(NotACompGSFile, match=r"tiles are made of a \.cgs file, found a \.ply"):
        export(tmp_path / "a.ply", tmp_path / "a.tiles")
    assert not (tmp_path / "a.tiles").exists()


def test_a_folder_that_is_there_is_replaced_only_if_that_is_asked_for(tiny_cgs: Path, tmp_path: Path) -> None:
    export(tiny_cgs, tmp_path / "a.tiles", grid="2x2")
    with pytest.raises(OutputError, match="exists already and is not empty"):
        export(tiny_cgs, tmp_path / "a.tiles", grid="2x1")
    assert export(tiny_cgs, tmp_path / "a.tiles", grid="2x1", overwrite=True).tiles == 2
    assert len(list((tmp_path / "a.tiles").glob("*.cgs"))) == 2
