"""PlayCanvas's .sog: images taken apart by hand, round trips within the steps, damage that is named."""

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

from compgs.errors import SplatFileError
from compgs.formats import sog
from compgs.formats.arrays import SplatArrays, normalized

Files = dict[str, bytes]


def image(rows: list[list[int]] | np.ndarray, kind: str = "WEBP") -> bytes:
    """One row of pixels."""
    buffer = io.BytesIO()
    Image.fromarray(np.array(rows, np.uint8)[None]).save(buffer, kind, lossless=True, exact=True)
    return buffer.getvalue()


def by_hand() -> Files:
    """Two splats and a spare pixel, degree 1."""
    book = [0.0] * 256
    meta = {
        "version": 2,
        "count": 2,
        "means": {"mins": [-1, 0, 0], "maxs": [1, 2, 0], "files": ["low.webp", "high.png"]},
        "scales": {"codebook": [-4.0, -3.0, -2.0, *book[3:]], "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": [-0.5, 0.0, 1.5, *book[3:]], "files": ["sh0.webp"]},
        "shN": {
            "count": 2,
            "bands": 1,
            "codebook": [0.0, 0.25, -0.125, *book[3:]],
            "files": ["c.webp", "l.webp"],
        },
        "later": "what is not known is ignored",
    }
    centroids = np.zeros((1, 64 * 3, 3), np.uint8)
    centroids[0, 3:6] = [[1, 0, 2], [0, 1, 0], [2, 2, 1]]  # of entry 1
    buffer = io.BytesIO()
    Image.fromarray(centroids).save(buffer, "WEBP", lossless=True, exact=True)
    return {
        "meta.json": json.dumps(meta).encode(),
        "low.webp": image([[0, 255, 9], [255, 0, 0], [7, 7, 7]]),
        "high.png": image([[0, 255, 9], [255, 0, 0], [7, 7, 7]], "PNG"),
        "scales.webp": image([[0, 1, 2], [2, 2, 2], [0, 0, 0]]),
        "quats.webp": image([[128, 128, 255, 253], [0, 128, 128, 252], [0, 0, 0, 0]]),
        "sh0.webp": image([[0, 1, 2, 51], [2, 1, 0, 255], [0, 0, 0, 0]]),
        "c.webp": buffer.getvalue(),
        "l.webp": image([[1, 0, 0], [0, 0, 0], [9, 9, 9]]),
    }


def zipped(path: Path, files: Files, method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def check_by_hand(arrays: SplatArrays) -> None:
    assert len(arrays) == 2 and arrays.degree == 1
    e = np.e
    np.testing.assert_allclose(arrays.means, [[1 - e, e * e - 1, 0], [e - 1, 0, 0]], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(arrays.log_scales, [[-4, -3, -2], [-2, -2, -2]])
    small, half = (128 / 255 - 0.5) * 2**0.5, 0.5 * 2**0.5
    first = [small, (1 - 2 * small**2 - half**2) ** 0.5, small, half]  # tag 253: x is missing
    second = [(1 - 2 * small**2 - half**2) ** 0.5, -half, small, small]  # 252: w
    np.testing.assert_allclose(arrays.quaternions, [first, second], atol=1e-6)
    np.testing.assert_array_equal(arrays.dc, [[-0.5, 0, 1.5], [1.5, 0, -0.5]])
    np.testing.assert_allclose(arrays.opacities, [0.2, 1], atol=2e-6)
    entry = [[0.25, 0, -0.125], [0, 0.25, 0], [-0.125, -0.125, 0.25]]
    np.testing.assert_array_equal(arrays.rest, [entry, np.zeros((3, 3))])


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_file_made_by_hand_holds_the_splats_it_describes(tmp_path: Path, method: int) -> None:
    path = zipped(tmp_path / "a.sog", by_hand(), method)
    check_by_hand(sog.read(path))
    sizes = sog.component_bytes(path)
    assert sum(sizes.values()) == path.stat().st_size and sizes["harmonics"] > 0


def test_a_meta_json_beside_its_images_is_read(tmp_path: Path) -> None:
    for name, content in by_hand().items():
        (tmp_path / name).write_bytes(content)
    check_by_hand(sog.read(tmp_path / "meta.json"))
    sizes = sog.component_bytes(tmp_path / "meta.json")
    assert sum(sizes.values()) == sum(file.stat().st_size for file in tmp_path.iterdir())


@pytest.mark.parametrize("degree", range(4))
def test_a_round_trip_is_off_by_the_steps_of_the_images(made, tmp_path: Path, degree: int) -> None:
    arrays = made(800, degree)
    path = tmp_path / "a.sog"
    path.write_bytes(sog.encoded(arrays))
    again = sog.read(path)
    arrays = arrays.rows(sog.morton_order(arrays.means))
    assert again.degree == degree
    logs = np.sign(arrays.means) * np.log1p(np.abs(arrays.means))
    steps = (logs.max(0) - logs.min(0)) / 65535
    limit = 0.51 * steps * (1 + np.abs(arrays.means)) + 1e-6
    assert (np.abs(again.means - arrays.means) <= limit).all()
    np.testing.assert_allclose(again.opacities, arrays.opacities, atol=0.5001 / 255)
    one, other = normalized(arrays.quaternions), normalized(again.quaternions)
    assert np.abs((one * other).sum(1)).min() > 1 - 4e-5  # 1/255 of sqrt(2) a part
    for name in ("log_scales", "dc", "rest"):
        error = getattr(again, name) - getattr(arrays, name)
        # 256 levels, and of the harmonics as many entries as there are splats
        assert not error.size or (error**2).mean() < 3e-4 * getattr(arrays, name).var()


def test_the_same_splats_give_the_same_bytes(made) -> None:
    assert sog.encoded(made(50)) == sog.encoded(made(50))


def test_a_palette_smaller_than_the_splats_is_used(
    made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sog, "palette_size", lambda count: 70)
    path = tmp_path / "a.sog"
    arrays = made(400, 1)
    path.write_bytes(sog.encoded(arrays))
    with zipfile.ZipFile(path) as archive:
        assert json.loads(archive.read("meta.json"))["shN"]["count"] == 70
        with Image.open(io.BytesIO(archive.read("shN_centroids.webp"))) as entries:
            assert entries.size == (64 * 3, 2)
    again = sog.read(path)
    assert len(np.unique(again.rest.reshape(400, -1), axis=0)) <= 70
    error = again.rest - arrays.rows(sog.morton_order(arrays.means)).rest
    assert (error**2).mean() < 0.5 * arrays.rest.var()


def test_palettes_stay_within_sixteen_bits() -> None:
    assert [sog.palette_size(count) for count in (1, 5000, 10**6)] == [1024, 2500, 65_536]


def test_colors_of_transparent_splats_are_kept(made, tmp_path: Path) -> None:
    arrays = made(30, 0)
    path = tmp_path / "a.sog"
    path.write_bytes(sog.encoded(replace(arrays, opacity_logits=np.full(30, -30, np.float32))))
    again = sog.read(path)
    assert again.opacities.max() < 1e-5
    np.testing.assert_allclose(again.dc, arrays.rows(sog.morton_order(arrays.means)).dc, atol=1e-4)


def test_one_splat_is_enough(made, tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    path.write_bytes(sog.encoded(made(1)))
    np.testing.assert_allclose(sog.read(path).means, made(1).means, atol=1e-5)


def test_the_order_is_along_the_interleaved_bits_of_the_positions() -> None:
    corners = np.array([[1, 1, 1], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 1, 0]], np.float32)
    np.testing.assert_array_equal(sog.morton_order(corners), [4, 2, 3, 5, 1, 0])


def meta_with(change: Callable[[dict[str, Any]], Any]) -> Callable[[Files], None]:
    def edit(files: Files) -> None:
        meta = json.loads(files["meta.json"])
        changed = change(meta)
        files["meta.json"] = json.dumps(changed if isinstance(changed, list) else meta).encode()

    return edit


def file_with(name: str, content: bytes) -> Callable[[Files], None]:
    return lambda files: files.update({name: content})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda files: files.pop("meta.json"), r"a zip without meta\.json"),
        (file_with("meta.json", b"{"), "not JSON"),
        (file_with("meta.json", b"[" * 100_000), "not JSON"),
        (meta_with(lambda m: []), "does not describe splats"),
        (meta_with(lambda m: m.update(version=3)), "version 3 of SOG"),
        (meta_with(lambda m: m.update(version=None)), "version None of SOG"),
        (meta_with(lambda m: m.pop("version")), "means.shape is None"),
        (meta_with(lambda m: m.update(count="many")), "count is 'many'"),
        (meta_with(lambda m: m.update(count=-1)), "count is -1"),
        (meta_with(lambda m: m.update(count=0)), "holds no splats"),
        (meta_with(lambda m: m.update(count=1 << 30)), "promises 1073741824 splats"),
        (meta_with(lambda m: m.update(count=4)), "has 3 pixels for 4 splats"),
        (meta_with(lambda m: m.pop("quats")), "has no quats"),
        (meta_with(lambda m: m.update(quats={"files": "q"})), "names files 'q'"),
        (meta_with(lambda m: m["quats"].update(files=["gone.webp"])), "gone.webp, which meta.json names"),
        (meta_with(lambda m: m["means"].update(mins=[0, 0])), "means.mins: expected 3"),
        (meta_with(lambda m: m["scales"].update(codebook=[0] * 255)), "expected 256 numbers"),
        (
            meta_with(lambda m: m["scales"].update(codebook=[1e300] * 256)),
            "2 of 2 splats cannot be drawn: 2 without a size",
        ),
        (meta_with(lambda m: m["scales"].update(codebook=["a"] * 256)), "expected numbers, found 'a'"),
        (
            meta_with(lambda m: m["scales"].update(codebook=[99] * 256)),
            "2 of 2 splats cannot be drawn: 2 without a size",
        ),
        (meta_with(lambda m: m["shN"].update(bands=4)), "4 bands"),
        (meta_with(lambda m: m["shN"].update(count=0)), "0 entries"),
        (meta_with(lambda m: m["shN"].update(count=65)), "expected 192 x 2"),
        (meta_with(lambda m: m["shN"].update(bands=2)), "expected 512 x 1"),
        (file_with("low.webp", b"no image"), "low.webp: is not an image"),
        (file_with("low.webp", image(np.zeros((16_000, 3)))[:-400]), "is not an image"),
        (file_with("sh0.webp", image(np.zeros((16_000, 4)))), None),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(
    tmp_path: Path, damage: Callable[[Files], None], message: str | None
) -> None:
    files = by_hand()
    damage(files)
    path = zipped(tmp_path / "a.sog", files)
    if message is None:
        sog.read(path)  # spare pixels do no harm
        return
    with pytest.raises(SplatFileError, match=message) as caught:
        sog.read(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (file_with("quats.webp", image([[1, 2, 3, 251], [0, 0, 0, 252]])), "without a rotation"),
        (meta_with(lambda m: m["shN"].update(count=1)), "without a color"),
        (meta_with(lambda m: m["means"].update(maxs=[0, 0, 1e4])), "without a position"),
    ],
)
def test_a_pixel_that_says_nothing_costs_its_splat_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, change: Callable[[Files], None], reason: str
) -> None:
    files = by_hand()
    change(files)
    assert len(sog.read(zipped(tmp_path / "a.sog", files))) == 1
    assert f"1 of 2 splats were left out: 1 {reason}" in caplog.text


def test_null_in_a_codebook_costs_the_splats_that_use_it(
    made, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """JSON has no infinity: writers in JavaScript make null of it."""
    path = tmp_path / "a.sog"
    path.write_bytes(sog.encoded(made(40)))
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    with Image.open(io.BytesIO(files["scales.webp"])) as opened:
        used = np.asarray(opened.convert("RGB")).reshape(-1, 3)[:40]
    entry = int(used[7, 0])
    meta_with(lambda m: m["scales"]["codebook"].__setitem__(entry, None))(files)
    assert len(sog.read(zipped(path, files))) == (used != entry).all(1).sum() < 40
    assert "without a size" in caplog.text


@pytest.mark.parametrize(
    ("said", "antialiased"),
    [
        ({}, False),
        ({"antialias": False}, False),
        ({"antialias": True}, True),
        ({"model": "default"}, False),
        ({"model": "antialiased"}, True),
    ],
)
def test_antialiased_splats_are_known_by_what_meta_says(
    tmp_path: Path, said: dict[str, Any], antialiased: bool
) -> None:
    files = by_hand()
    meta_with(lambda m: m.update(said))(files)
    assert sog.read(zipped(tmp_path / "a.sog", files)).antialiased is antialiased


def test_antialiased_splats_are_written_as_such(made, tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    for antialiased in (False, True):
        path.write_bytes(sog.encoded(replace(made(3), antialiased=antialiased)))
        with zipfile.ZipFile(path) as archive:
            meta = json.loads(archive.read("meta.json"))
        assert meta["antialias"] is antialiased
        assert meta.get("model") == ("antialiased" if antialiased else None)
        assert sog.read(path).antialiased is antialiased


def test_what_meta_says_and_nothing_uses_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = by_hand()
    meta_with(lambda m: m.update(model="2dgs", weather="fine", extras={"of": "an application"}))(files)
    path = zipped(tmp_path / "a.sog", files)
    assert sog.read(path).antialiased is False
    (record,) = caplog.records
    assert (
        record.getMessage()
        == f"{path}: meta.json: not used: later, weather, model '2dgs': drawn as plain splats"
    )


def test_images_far_larger_than_the_splats_are_not_decoded(tmp_path: Path) -> None:
    files = by_hand()
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((1000, 1000, 3), np.uint8)).save(buffer, "WEBP", lossless=True)
    files["low.webp"] = buffer.getvalue()
    path = zipped(tmp_path / "a.sog", files)
    with pytest.raises(SplatFileError, match="1000 x 1000 pixels for 2 splats"):
        sog.read(path)


def test_files_inside_that_unpack_to_more_than_the_zip_are_not_unpacked_to_their_end(tmp_path: Path) -> None:
    files = {**by_hand(), "meta.json": b" " * (1 << 24) + by_hand()["meta.json"]}
    path = zipped(tmp_path / "a.sog", files, zipfile.ZIP_DEFLATED)
    with pytest.raises(SplatFileError, match=r"meta\.json is larger than the whole file may hold"):
        sog.read(path)


def test_a_meta_json_names_no_file_elsewhere(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, content in by_hand().items():
        (folder / name).write_bytes(content)
    meta = json.loads(by_hand()["meta.json"])
    meta["quats"]["files"] = ["../quats.webp"]
    (folder / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(SplatFileError, match="not the name of a file beside it"):
        sog.read(folder / "meta.json")


def test_a_file_that_ends_early_is_named(made, tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    path.write_bytes(sog.encoded(replace(made(30)))[:-30])
    with pytest.raises(SplatFileError, match=r"a\.sog: is damaged"):
        sog.read(path)
