"""What is written as streamed SOG is what its reader finds, in the layout that PlayCanvas documents."""

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats import SplatArrays, sog, sog_streamed
from compgs.formats import sog_streamed_writer as writer
from compgs.formats.sog_streamed_writer import write_levels

Tree = dict[str, Any]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves and parts of some dozen splats."""
    monkeypatch.setattr(writer, "MOST_IN_LEAF", 50)
    monkeypatch.setattr(writer, "MOST_IN_PART", 120)


@pytest.fixture
def levels(made: Callable[..., SplatArrays]) -> list[SplatArrays]:
    return [made(400, 1, 0), made(90, 1, 1), made(5, 1, 2)]


@pytest.fixture
def path(levels: list[SplatArrays], tmp_path: Path) -> Path:
    place = tmp_path / "city" / "lod-meta.json"
    write_levels(place, 3, iter([levels]))
    return place


def nodes(tree: Tree) -> Iterator[Tree]:
    yield tree
    for child in tree.get("children", []):
        yield from nodes(child)


def leaves(path: Path) -> list[Tree]:
    return [node for node in nodes(json.loads(path.read_text())["tree"]) if "lods" in node]


def test_the_finest_level_is_read_back_as_it_was(path: Path, levels: list[SplatArrays]) -> None:
    read, level = sog_streamed.read(path), levels[0]
    assert len(read) == len(level)
    distances = np.linalg.norm(read.means[:, None] - level.means[None], axis=2)
    assert distances.min(1).max() < 1e-3 * np.ptp(level.means)
    match = distances.argmin(1)
    assert len(set(match)) == len(level)
    np.testing.assert_allclose(read.opacities, level.opacities[match], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(read.dc, level.dc[match], atol=0.1)


def test_a_part_is_exactly_the_runs_of_leaves_of_one_level(path: Path) -> None:
    meta = json.loads(path.read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == 3 and meta["count"] == sum(meta["counts"])
    assert list(sog_streamed.read_meta(path).counts) == meta["counts"]
    runs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for leaf in leaves(path):
        assert set(leaf["lods"]) == {"0", "1", "2"}
        for level, run in leaf["lods"].items():
            runs.setdefault((int(level), run["file"]), []).append((run["offset"], run["count"]))
    assert len({file for _, file in runs}) == len(runs) == len(meta["filenames"]) > 3
    for (level, file), found in runs.items():
        name = meta["filenames"][file]
        assert name.startswith(f"{level}_")
        ends = list(itertools.accumulate(count for _, count in found))
        assert [offset for offset, _ in found] == [0, *ends[:-1]]
        assert ends[-1] == json.loads((path.parent / name).read_text())["count"] <= 120


def test_boxes_hold_what_is_in_them_and_nodes_have_two_children(path: Path) -> None:
    meta = json.loads(path.read_text())
    parts = [sog.read(path.parent / name) for name in meta["filenames"]]
    for node in nodes(meta["tree"]):
        low, high = np.array(node["bound"]["min"]), np.array(node["bound"]["max"])
        if "children" in node:
            assert len(node["children"]) == 2
            bounds = [child["bound"] for child in node["children"]]
            assert np.array_equal(low, np.min([each["min"] for each in bounds], 0))
            assert np.array_equal(high, np.max([each["max"] for each in bounds], 0))
            continue
        assert node["lods"]["0"]["count"] <= 50
        for run in node["lods"].values():
            means = parts[run["file"]].means[run["offset"] : run["offset"] + run["count"]]
            slack = 1e-3 * np.ptp(parts[0].means)
            assert (means >= low - slack).all() and (means <= high + slack).all()


def test_where_a_level_has_nothing_there_are_finer_splats(path: Path, levels: list[SplatArrays]) -> None:
    counts = sog_streamed.read_meta(path).counts
    assert counts[0] == 400 and counts[2] > len(levels[2])
    assert all(leaf["lods"]["2"]["count"] for leaf in leaves(path))


def test_places_are_written_side_by_side(made: Callable[..., SplatArrays], tmp_path: Path) -> None:
    places = [[made(60, 0, i), made(20, 0, i + 10)] for i in range(5)]
    write_levels(tmp_path / "lod-meta.json", 2, iter(places))
    assert sog_streamed.read_meta(tmp_path / "lod-meta.json").counts[0] == 300
    assert (
        len(sog_streamed.parts(tmp_path / "lod-meta.json")) < 10
    )  # coarse levels of several places share a part


def test_parts_of_an_earlier_scene_go(path: Path, made: Callable[..., SplatArrays]) -> None:
    (path.parent / "notes").mkdir()
    write_levels(path, 1, iter([[made(20, 0, 3)]]))
    assert sorted(file.name for file in path.parent.iterdir()) == ["0_0", "lod-meta.json", "notes"]
    assert len(sog_streamed.read(path)) == 20


def test_what_fails_leaves_the_folder_as_it_was(path: Path, made: Callable[..., SplatArrays]) -> None:
    before = path.read_bytes()
    with pytest.raises(SplatFileError, match="2 levels"):
        write_levels(path, 2, iter([[made(20, 0, 3), made(5, 0, 3)], [made(20, 0, 4)]]))
    assert path.read_bytes() == before and len(sog_streamed.read(path)) == 400
