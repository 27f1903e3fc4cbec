"""A file is what its first bytes say, whatever it is called."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import NotACompGSFile, OutputError, SplatFileError
from compgs.formats import WRITERS, encoded, writer_of
from compgs.model.hybrid_model import HybridModel
from compgs.model.splats import SplatModel
from compgs.opening import FORMATS, check_scene, component_bytes, format_of, open_scene
from compgs.render import Renderable

from .foreign import gltf_file, ksplat_file

SPLAT = np.array([0, 0, 1, 0.1, 0.1, 0.1], "<f4").tobytes() + bytes([200, 100, 50, 255, 255, 128, 128, 128])


@pytest.fixture
def contents(made, cgs_bytes: bytes) -> dict[str, bytes]:
    written = {name: encoded(made(20, 1), name) for name in WRITERS}
    return {
        **written,
        "cgs": cgs_bytes,
        "splat": SPLAT * 3,
        "ksplat": ksplat_file(2),
        "gltf": gltf_file(written["glb"]),
    }


def test_every_format_is_known_by_its_content_alone(contents: dict[str, bytes], tmp_path: Path) -> None:
    # (files of methods: tests/methods; folders of tiles: test_tiled.py)
    assert contents.keys() | {"packed", "tiles"} == {each.name for each in FORMATS}
    for name, content in contents.items():
        for suffix in (".ply", ".cgs", ""):
            path = tmp_path / f"{name}-as{suffix}"
            path.write_bytes(content)
            assert format_of(path).name == name
            check_scene(path)
            assert sum(component_bytes(path).values()) == len(content)


def test_every_format_opens_as_something_that_can_be_rendered(
    contents: dict[str, bytes], tmp_path: Path
) -> None:
    for name, content in contents.items():
        path = tmp_path / "scene"
        path.write_bytes(content)
        model = open_scene(path, "cpu", (0.25, 0.5, 0.75))
        assert isinstance(model, Renderable)
        assert isinstance(model, HybridModel if name == "cgs" else SplatModel)
        if name != "cgs":
            assert model.background == (0.25, 0.5, 0.75)
            assert model.counts == {"splats": {"splat": 3, "ksplat": 18}.get(name, 20)}
        assert model.over((1.0, 0.0, 0.0)).background == (1.0, 0.0, 0.0)
        assert len(model.bounds[0]) == len(model.bounds[1]) == next(iter(model.counts.values()))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"something else that is longer than a splat of 32 bytes", r"is not a \.cgs file, nor one of \.ply"),
        (gzip.compress(b"a text", mtime=0), r"is not a \.cgs file"),
        (b"solid cube", r"is not a \.cgs file"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    for look in (check_scene, open_scene, component_bytes):
        with pytest.raises(NotACompGSFile, match=message):
            look(path)


def test_zips_and_json_of_other_kinds_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    path.write_bytes(b'{"version": 2}')
    with pytest.raises(SplatFileError, match="does not describe splats"):
        check_scene(path)


def test_folders_and_missing_files_are_named_with_a_hint(tmp_path: Path) -> None:
    with pytest.raises(NotACompGSFile, match="there is no such file"):
        format_of(tmp_path / "nowhere.spz")
    with pytest.raises(NotACompGSFile, match=r"found a folder$"):
        format_of(tmp_path)
    (tmp_path / "meta.json").touch()
    with pytest.raises(NotACompGSFile, match=r"did you mean .*meta\.json\?"):
        format_of(tmp_path)


def test_what_is_written_is_said_by_the_name() -> None:
    assert [writer_of(Path(f"a.{name}")) for name in ("ply", "SPZ", "Sog", "glb")] == list(WRITERS)
    for name in ("a.splat", "a", "a.cgs"):
        with pytest.raises(OutputError, match=r"ends in \.ply, \.spz, \.sog, \.glb"):
            writer_of(Path(name))


def test_nothing_is_not_written(made) -> None:
    for name in WRITERS:
        with pytest.raises(SplatFileError, match="no splats"):
            encoded(made(3).rows(np.array([], np.int64)), name)
