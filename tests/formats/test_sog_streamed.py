"""A streamed .sog is the rows of its parts that the tree names for a level, each part read by `sog`."""

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from compgs.errors import ConfigError, NotACompGSFile, SplatFileError
from compgs.formats import SplatArrays, sog, sog_streamed
from compgs.opening import check_scene, component_bytes, format_of, open_scene

Meta = dict[str, Any]
# A part each of 8, 4 and 3 splats, and one of the environment.
PARTS = {"0_0.sog": (8, 2), "0_1.sog": (4, 1), "1_0.sog": (3, 0), "env.sog": (2, 1)}


def reference(file: int, offset: int, count: int) -> Meta:
    return {"file": file, "offset": offset, "count": count}


def meta() -> Meta:
    near = {"bound": {}, "lods": {"0": reference(0, 3, 5), "1": reference(2, 0, 1)}}
    far = {"lods": {"0": reference(1, 0, 4), "1": reference(2, 1, 2)}}
    middle = {"lods": {"0": reference(0, 0, 2)}}  # the third row of the first part is nobody's
    return {
        "version": 1,
        "counts": [11, 3, 0],
        "lodLevels": 3,
        "environment": "env.sog",
        "filenames": ["0_0.sog", "0_1.sog", "1_0.sog"],
        "tree": {"children": [near, {"children": [far, middle]}]},
    }


@pytest.fixture
def scene(made, tmp_path: Path) -> Path:
    for i, (name, (count, degree)) in enumerate(PARTS.items()):
        (tmp_path / name).write_bytes(sog.encoded(made(count, degree, i)))
    return write(tmp_path, meta())


def write(folder: Path, content: Meta) -> Path:
    path = folder / "lod-meta.json"
    path.write_text(json.dumps(content))
    return path


def check_rows(read: SplatArrays, expected: list[tuple[SplatArrays, list[int]]], degree: int) -> None:
    assert read.degree == degree
    first = 0
    for part, rows in expected:
        here = read.rows(np.arange(first, first + len(rows)))
        for name in ("means", "log_scales", "quaternions", "opacity_logits", "dc"):
            assert np.array_equal(getattr(here, name), getattr(part, name)[rows]), name
        held = part.rest.shape[1]
        assert np.array_equal(here.rest[:, :held], part.rest[rows]) and not here.rest[:, held:].any()
        first += len(rows)
    assert first == len(read)


def test_the_finest_level_and_the_environment_are_opened(scene: Path) -> None:
    assert format_of(scene).name == "sog"
    check_scene(scene)
    parts = {name: sog.read(scene.parent / name) for name in PARTS}
    rows = [
        (parts["0_0.sog"], [0, 1, 3, 4, 5, 6, 7]),
        (parts["0_1.sog"], [0, 1, 2, 3]),
        (parts["env.sog"], [0, 1]),
    ]
    check_rows(sog_streamed.read(scene), rows, 2)
    assert open_scene(scene).counts == {"splats": 13}
    needed = ["lod-meta.json", "0_0.sog", "0_1.sog", "env.sog"]
    assert sum(component_bytes(scene).values()) == sum((scene.parent / n).stat().st_size for n in needed)
    needed = ["lod-meta.json", "1_0.sog", "env.sog"]
    assert sum(component_bytes(scene, 1).values()) == sum((scene.parent / n).stat().st_size for n in needed)


def test_parts_that_disagree_about_antialiasing_are_drawn_as_the_first_says(
    scene: Path, made: Callable[..., SplatArrays], caplog: pytest.LogCaptureFixture
) -> None:
    assert not sog_streamed.read(scene).antialiased and not caplog.messages
    count, degree = PARTS["0_1.sog"]
    (scene.parent / "0_1.sog").write_bytes(sog.encoded(replace(made(count, degree, 1), antialiased=True)))
    assert not sog_streamed.read(scene).antialiased
    (told,) = caplog.messages
    assert "0_0.sog is not antialiased, 0_1.sog antialiased: all of them are drawn not antialiased" in told


def test_another_level_is_opened_where_it_is_asked_for(scene: Path) -> None:
    parts = {name: sog.read(scene.parent / name) for name in PARTS}
    rows = [(parts["1_0.sog"], [0, 1, 2]), (parts["env.sog"], [0, 1])]
    check_rows(sog_streamed.read(scene, 1), rows, 1)
    assert open_scene(scene, level=1).counts == {"splats": 5}


@pytest.mark.parametrize(
    ("level", "error", "message"),
    [
        (3, ConfigError, "level 3: expected 0, the finest, to 2, the coarsest"),
        (-1, ConfigError, "level -1: expected 0"),
        (2, SplatFileError, "level 2 holds no splats; there are some in 0, 1"),
    ],
)
def test_a_level_that_is_not_there_is_refused(
    scene: Path, level: int, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        open_scene(scene, level=level)


def test_a_level_of_a_scene_without_levels_is_refused(scene: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"0_0\.sog: --level is for scenes of several levels \(lod-meta\.json\)"
    ):
        open_scene(scene.parent / "0_0.sog", level=0)


def test_older_files_without_version_and_counts_are_read(scene: Path) -> None:
    expected = sog_streamed.read(scene)
    older = {name: value for name, value in meta().items() if name not in ("version", "counts")}
    write(scene.parent, {**older, "environment": None})
    read = sog_streamed.read(scene)
    assert np.array_equal(read.means, expected.means[:11])


def test_rows_stay_in_place_where_a_part_has_splats_that_cannot_be_drawn(scene: Path) -> None:
    whole, part = sog_streamed.read(scene), scene.parent / "0_0.sog"
    with zipfile.ZipFile(part) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    pixels = np.array(Image.open(io.BytesIO(files["quats.webp"])))
    pixels[0, 0, 3] = 7  # a tag that says nothing: the first splat has no rotation
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True)
    with zipfile.ZipFile(part, "w") as archive:
        for name, content in {**files, "quats.webp": buffer.getvalue()}.items():
            archive.writestr(name, content)
    assert np.array_equal(sog_streamed.read(scene).means, whole.means[1:])


def changed(change: Callable[[Meta], object]) -> Callable[[Meta], str]:
    def edit(content: Meta) -> str:
        change(content)
        return json.dumps(content)

    return edit


def first_leaf(content: Meta) -> Meta:
    leaf: Meta = content["tree"]["children"][0]["lods"]["0"]
    return leaf


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda m: json.dumps(m)[:-9], "is not JSON"),
        (lambda m: '{"lodLevels":' + "[" * 100_000, "is not JSON"),
        (changed(lambda m: m.update(version=2)), "version 2 of streamed SOG; expected 1"),
        (changed(lambda m: m.update(lodLevels=0)), "0 levels; expected 1 to 1024"),
        (changed(lambda m: m.update(lodLevels=True)), "True levels"),
        (changed(lambda m: m.pop("tree")), "does not describe a streamed SOG"),
        (changed(lambda m: m.update(tree=7)), "does not describe a streamed SOG"),
        (changed(lambda m: m.update(filenames={})), r"names level 0 of 3, file 0 of 0"),
        (changed(lambda m: m.update(counts=[11, 4, 0])), r"promises \[11, 4, 0\] splats, its tree names \[11, 3, 0\]"),
        (changed(lambda m: m["filenames"].__setitem__(1, "../0_1.sog")), "'../0_1.sog' is not the name"),
        (changed(lambda m: m["filenames"].__setitem__(1, "/0_1.sog")), "'/0_1.sog' is not the name"),
        (changed(lambda m: m["filenames"].__setitem__(1, "..\\0_1.sog")), "is not the name"),
        (changed(lambda m: m["filenames"].__setitem__(1, 7)), "7 is not the name"),
        (changed(lambda m: m["filenames"].__setitem__(1, "")), "'' is not the name"),
        (changed(lambda m: m["filenames"].__setitem__(1, "gone.sog")), "gone.sog, which it names, is missing"),
        (changed(lambda m: m.update(environment="../env.sog")), "'../env.sog' is not the name"),
        (changed(lambda m: m.update(environment="gone.sog")), "gone.sog, which it names, is missing"),
        (changed(lambda m: first_leaf(m).update(file=3)), "names level 0 of 3, file 3 of 3"),
        (changed(lambda m: first_leaf(m).update(file=-1)), "expected whole numbers in its tree"),
        (changed(lambda m: first_leaf(m).update(offset=1.5)), "expected whole numbers in its tree"),
        (changed(lambda m: first_leaf(m).update(offset=1)), "names splats of 0_0.sog twice"),
        (changed(lambda m: m["filenames"].__setitem__(1, "./0_0.sog")), "names splats of 0_0.sog twice"),
        (changed(lambda m: first_leaf(m).update(offset=4)), "names 9 splats of 0_0.sog, which holds 8"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_with_what_is_wrong(
    scene: Path, damage: Callable[[Meta], str], message: str
) -> None:
    scene.write_text(damage(meta()))
    with pytest.raises(SplatFileError, match=message) as caught:
        sog_streamed.read(scene)
    assert str(caught.value).startswith(f"{scene}: ")


def test_a_deep_tree_is_walked_without_a_deep_stack(scene: Path) -> None:
    content = meta()
    for _ in range(400):
        content["tree"] = {"children": [content["tree"]]}
    write(scene.parent, content)
    assert len(sog_streamed.read(scene)) == 13


def test_what_the_file_says_and_nothing_uses_is_told(scene: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(scene.parent, {**meta(), "fog": 1, "annotations": []})
    sog_streamed.read(scene)
    assert f"{scene}: not used: annotations, fog" in caplog.messages


def test_a_folder_is_answered_with_the_file_in_it(scene: Path) -> None:
    (scene.parent / "meta.json").touch()
    with pytest.raises(NotACompGSFile, match=r"did you mean .*lod-meta\.json\?"):
        format_of(scene.parent)
