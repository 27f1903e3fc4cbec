"""Export from a file to a file: what is written, what is measured, what is refused."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import compgs
from compgs import exporting
from compgs.codec.reader import read_content
from compgs.codec.writer import write_content
from compgs.errors import ConfigError, MissingDependency, NotACompGSFile, OutputError
from compgs.evaluation.camera_path import surround
from compgs.exporting import Exported, export, own_cameras, smaller
from compgs.formats import encoded, read_ply, sog_streamed
from compgs.formats.arrays import normalized
from compgs.formats.ply import ply_size
from compgs.formats.tiled import read_manifest
from compgs.formats.tiled_writer import NewTile, write_tiles
from compgs.metrics import psnr, to_8bit
from compgs.model.splats import SplatArrays, SplatModel
from compgs.opening import open_scene
from compgs.ordering.order import canonical_order, level_counts
from compgs.render import RasterSettings, render


@pytest.fixture(autouse=True)
def fewer_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight all around, for the tests to take less time."""
    monkeypatch.setattr(exporting, "surround", lambda positions: surround(positions)[::9])


@pytest.fixture
def ply(tmp_path: Path, random_splats: Callable[..., SplatArrays]) -> Path:
    path = tmp_path / "a.ply"
    path.write_bytes(encoded(random_splats(), "ply"))
    return path


def test_the_public_face_has_it() -> None:
    assert compgs.export is export and compgs.open_scene is open_scene


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_splats_that_nothing_is_asked_of_keep_their_numbers(
    ply: Path, tmp_path: Path, kind: str, random_splats: Callable[..., SplatArrays]
) -> None:
    out = tmp_path / f"b.{kind}"
    done = export(ply, out)
    assert done.bytes == out.stat().st_size and done.splats == 60 and done.dropped == 0
    assert done.worst > 90 and len(done.psnr) == 20
    again = open_scene(out)
    assert isinstance(again, SplatModel)
    for name, array in vars(random_splats()).items():
        found = getattr(again.splats, name)
        if name == "quaternions":
            array, found = normalized(array), normalized(found)
        np.testing.assert_allclose(found, array, atol=1e-5, rtol=0)


def test_the_loss_of_quantization_is_measured_on_the_written_file(ply: Path, tmp_path: Path) -> None:
    done = export(ply, tmp_path / "b.spz")
    assert 25 < done.worst < done.mean < 90


@pytest.mark.parametrize("kind", ["ply", "spz", "sog"])
def test_antialiased_splats_stay_so(
    tmp_path: Path, kind: str, random_splats: Callable[..., SplatArrays]
) -> None:
    """Thin ones, of which plain dilation makes pictures of another brightness."""
    thin = replace(random_splats(), log_scales=np.full((60, 3), -7, np.float32), antialiased=True)
    source, out = tmp_path / "a.ply", tmp_path / f"b.{kind}"
    source.write_bytes(encoded(thin, "ply"))
    done = export(source, out)
    assert open_scene(out).antialiased and done.worst > 45
    plain = tmp_path / "plain.ply"
    plain.write_bytes(encoded(replace(thin, antialiased=False), "ply"))
    camera = own_cameras(open_scene(plain))[0]
    dim, bright = (render(open_scene(file), camera).image.sum() for file in (source, plain))
    assert 0 < dim < bright / 2


def test_a_file_that_cannot_say_that_splats_are_antialiased_is_told_of(
    tmp_path: Path, random_splats: Callable[..., SplatArrays], caplog: pytest.LogCaptureFixture
) -> None:
    source = tmp_path / "a.ply"
    thin = replace(random_splats(), log_scales=np.full((60, 3), -6, np.float32), antialiased=True)
    source.write_bytes(encoded(thin, "ply"))
    done = export(source, tmp_path / "b.glb")
    assert done.worst < 60  # the loss that a program sees that opens it
    assert f"{tmp_path / 'b.glb'}: its splats are antialiased" in caplog.text


@pytest.mark.slow
def test_harmonics_above_the_degree_are_left_out_and_the_rest_is_fitted(ply: Path, tmp_path: Path) -> None:
    plain = export(ply, tmp_path / "b.ply", degree=0, refine=0)
    fitted = export(ply, tmp_path / "c.ply", degree=0, refine=60)
    assert read_ply(tmp_path / "b.ply").degree == 0
    assert plain.mean < fitted.mean < 60


def test_a_limit_on_splats_keeps_those_that_count(
    ply: Path, tmp_path: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    done = export(ply, tmp_path / "b.ply", max_splats=20, refine=0)
    kept = read_ply(tmp_path / "b.ply")
    assert len(kept) == done.splats == 20 and done.dropped == 40
    # All are of one size and in one place: the opaque ones count.
    assert kept.opacity_logits.mean() > np.median(random_splats().opacity_logits)


@pytest.mark.parametrize("kind", ["ply", "spz"])
def test_a_limit_on_bytes_is_kept_and_used(ply: Path, tmp_path: Path, kind: str) -> None:
    whole = export(ply, tmp_path / f"whole.{kind}").bytes
    limit = whole * 2 // 3
    done = export(ply, tmp_path / f"b.{kind}", max_bytes=limit, refine=3)
    assert done.degree == 1
    assert 0.85 * limit < done.bytes <= limit
    assert done.splats is not None and done.splats + done.dropped == 60 > done.splats
    with pytest.raises(ConfigError, match=r"max_bytes = 50: too few for any splat, expected .* or more"):
        export(ply, tmp_path / f"c.{kind}", max_bytes=50)
    assert not (tmp_path / f"c.{kind}").exists()


@pytest.mark.parametrize(
    ("limit", "degree", "kept"),
    [
        (None, 3, 60),
        (ply_size(60, 3), 3, 60),
        (ply_size(60, 3) - 1, 2, 60),
        (ply_size(60, 2) - 1, 1, 60),
        (ply_size(60, 1) - 1, 1, 59),
        (ply_size(30, 1), 1, 29),
    ],
)
def test_degrees_are_lowered_before_splats_are_left_out(
    tmp_path: Path, limit: int | None, degree: int, kept: int, random_splats: Callable[..., SplatArrays]
) -> None:
    source = tmp_path / "a.ply"
    source.write_bytes(encoded(random_splats(degree=3), "ply"))
    done = export(source, tmp_path / "b.ply", max_bytes=limit, refine=0)
    assert done.degree == degree and done.splats is not None and abs(done.splats - kept) <= 1
    assert limit is None or done.bytes <= limit


def test_a_degree_that_is_asked_for_is_kept_whatever_the_limit(ply: Path, tmp_path: Path) -> None:
    done = export(ply, tmp_path / "b.ply", degree=0, max_bytes=ply_size(60, 0), refine=0)
    assert done.degree == 0 and done.splats == 60
    done = export(ply, tmp_path / "c.ply", degree=1, max_bytes=ply_size(60, 0), refine=0)
    assert done.degree == 1 and done.splats is not None and done.splats < 60


def test_spz_files_are_of_the_version_that_is_asked_for(ply: Path, tmp_path: Path) -> None:
    pytest.importorskip("zstandard")
    export(ply, tmp_path / "b.spz")
    export(ply, tmp_path / "c.spz", spz_version=4)
    assert (tmp_path / "b.spz").read_bytes()[:2] == b"\x1f\x8b"
    assert (tmp_path / "c.spz").read_bytes()[:8] == b"NGSP\x04\0\0\0"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"degree": 4}, "degree = 4: expected 0 to 3"),
        ({"degree": -1}, "degree = -1"),
        ({"spz_version": 2}, "spz_version = 2"),
        ({"refine": -1}, "refine = -1"),
        ({"max_splats": 0}, "max_splats = 0: expected 1 to any number"),
        ({"max_bytes": 0}, "max_bytes = 0"),
    ],
)
def test_settings_out_of_range_are_named(
    ply: Path, tmp_path: Path, options: dict[str, int], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        export(ply, tmp_path / "b.ply", **options)


def test_what_cannot_be_written_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere.cgs"
    with pytest.raises(OutputError, match=r"ends in \.ply, \.spz, \.sog, \.glb, \.html"):
        export(nowhere, tmp_path / "b.splat")
    (tmp_path / "b.ply").touch()
    with pytest.raises(OutputError, match="overwrite=True"):
        export(nowhere, tmp_path / "b.ply")
    with pytest.raises(NotACompGSFile, match="no such file"):
        export(nowhere, tmp_path / "c.ply")


def test_places_in_the_world_are_kept_where_the_format_can(
    tmp_path: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    source = tmp_path / "a.glb"
    offset = (4.2e6, 5e5, -20.0)
    source.write_bytes(encoded(replace(random_splats(), world_offset=offset), "glb"))
    assert export(source, tmp_path / "b.glb").origin == (0.0, 0.0, 0.0)
    assert open_scene(tmp_path / "b.glb").world_offset == offset
    for kind in ("spz", "sog"):
        done = export(source, tmp_path / f"b.{kind}")
        assert done.origin == offset and done.worst > 25
    export(source, tmp_path / "b.ply")
    expected = random_splats().means + np.array(offset)
    assert np.array_equal(read_ply(tmp_path / "b.ply").means, expected.astype(np.float32))


def test_progress_ends_at_its_total(ply: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    export(ply, tmp_path / "b.ply", max_splats=30, refine=4, progress=lambda *counts: seen.append(counts))
    total = seen[0][1]
    assert seen == [(i + 1, total) for i in range(total)]


def test_without_viewpoints_a_scene_is_looked_at_from_all_around(
    random_splats: Callable[..., SplatArrays],
) -> None:
    model = SplatModel(replace(random_splats(), world_offset=(1e6, 0.0, 0.0)), (0.0, 0.0, 0.0))
    cameras = own_cameras(model)
    middle = np.median(random_splats().means, 0) + np.array(model.world_offset)
    directions = np.stack([camera.center - middle for camera in cameras])
    assert len(cameras) == 8 and np.abs(directions).max() < 10
    assert np.abs(directions.mean(0)[[0, 2]]).max() < 0.2 * np.linalg.norm(directions, axis=1).mean()


def test_large_views_are_baked_from_smaller_ones(random_splats: Callable[..., SplatArrays]) -> None:
    camera = own_cameras(SplatModel(random_splats(), (0.0, 0.0, 0.0)))[0]
    large = camera.resized(1600, 1200)
    assert (smaller(large).width, smaller(large).height) == (800, 600)
    assert smaller(large).fx == pytest.approx(large.fx / 2)
    assert smaller(camera).width == camera.width


def test_equal_pictures_do_not_hide_the_others() -> None:
    infinite = float("inf")
    assert Exported(1, 1, 3, 0, (infinite, 40.0), (0.0, 0.0, 0.0)).mean == 70.0
    assert Exported(1, 1, 3, 0, (infinite, infinite), (0.0, 0.0, 0.0)).mean == infinite


def test_a_page_holds_the_file_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_cgs: Path
) -> None:
    viewer = SimpleNamespace(html_page=lambda data, title: f"<title>{title}</title>{len(data)}")
    monkeypatch.setitem(sys.modules, "compgs.viewer", viewer)
    done = export(tiny_cgs, tmp_path / "garden.html")
    assert (tmp_path / "garden.html").read_text() == f"<title>tiny</title>{tiny_cgs.stat().st_size}"
    assert done.splats is None and done.psnr == ()


def test_a_build_without_the_viewer_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_cgs: Path, ply: Path
) -> None:
    monkeypatch.setitem(sys.modules, "compgs.viewer", None)
    with pytest.raises(MissingDependency, match="no viewer for web pages"):
        export(tiny_cgs, tmp_path / "garden.html")
    with pytest.raises(NotACompGSFile, match=r"a page shows a \.cgs file, found a \.ply"):
        export(ply, tmp_path / "b.html")
    assert not list(tmp_path.glob("*.html"))


def test_a_neural_scene_is_baked_over_its_own_viewpoints(
    tmp_path: Path, tiny_cgs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = export(tiny_cgs, tmp_path / "a.ply", degree=1, refine=20)
    model = compgs.decode(tiny_cgs)
    assert done.splats is not None and 0 < done.splats <= model.coupled
    assert len(done.psnr) == len(model.viewpoints) + 12
    assert done.mean > 30


def with_dilation(tiny_cgs: Path, pixels: float, path: Path) -> Path:
    """The same scene, drawn with so many pixels^2 in its own cameras."""
    camera = compgs.decode(tiny_cgs).viewpoints[0]
    content = read_content(tiny_cgs.read_bytes())
    angle = float(np.float32(pixels / (camera.fx * camera.fy)))
    path.write_bytes(write_content(replace(content, angular_dilation=angle)))
    return path


def test_splats_are_fitted_in_smaller_pictures_as_others_draw_them_in_large_ones(
    tmp_path: Path, tiny_cgs: Path
) -> None:
    plain = compgs.decode(tiny_cgs)
    assert exporting.as_others_draw(plain, plain.viewpoints) == RasterSettings(plain.background)
    model = compgs.decode(with_dilation(tiny_cgs, 0.02, tmp_path / "b.cgs"))
    camera = model.viewpoints[0]
    large = exporting.at_least(exporting.VIEWING_SIDE, camera)
    assert max(large.width, large.height) == 1280
    half = camera.resized(large.width // 2, large.height // 2)
    settings = exporting.as_others_draw(model, model.viewpoints)
    assert settings.dilation_of(large) == pytest.approx(0.3)
    assert settings.dilation_of(half) == pytest.approx(0.3 / 4, rel=0.01)


def test_splats_are_measured_as_people_look_at_them_too(tmp_path: Path, tiny_cgs: Path) -> None:
    small = compgs.decode(tiny_cgs).viewpoints[0]
    viewed = exporting.viewing_cameras([small] * 20)
    assert len(viewed) == 5 and {max(camera.width, camera.height) for camera in viewed} == {1280}
    assert viewed[0].fx / viewed[0].width == pytest.approx(small.fx / small.width, rel=1e-2)
    assert exporting.viewing_cameras([exporting.at_least(1280, small)]) == ()
    done = export(tiny_cgs, tmp_path / "a.ply", degree=1, refine=0)
    assert len(done.viewing_psnr) == 6 and done.viewing_mean == pytest.approx(np.mean(done.viewing_psnr))


def test_who_exports_a_scene_that_is_sharper_than_others_draw_it_is_told(
    tmp_path: Path, tiny_cgs: Path
) -> None:
    for pixels, softer in ((0.3, False), (0.02, True)):
        file = with_dilation(tiny_cgs, pixels, tmp_path / f"{pixels}.cgs")
        assert export(file, tmp_path / f"{pixels}.ply", degree=0, refine=0).softer == softer


def from_coarse_to_fine(tiny_cgs: Path, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> bytes:
    """A scene with two ranges, somewhere in the world."""
    content = read_content(tiny_cgs.read_bytes())
    counts = level_counts(content.coordinates[canonical_order(content.coordinates)])
    half = next(level for level, count in enumerate(counts) if count >= 0.3 * counts[-1])
    return write_content(replace(content, world_offset=offset), levels=[half, len(counts) - 1])


def test_levels_of_a_file_are_its_beginnings_each_like_the_whole(tmp_path: Path, tiny_cgs: Path) -> None:
    source = tmp_path / "scene.cgs"
    source.write_bytes(from_coarse_to_fine(tiny_cgs))
    counted: list[tuple[int, int]] = []
    exported = compgs.export(
        source,
        tmp_path / "levels" / "lod-meta.json",
        refine=5,
        degree=1,
        progress=lambda *done: counted.append(done),
    )
    path = tmp_path / "levels" / "lod-meta.json"
    files = [file for file in path.parent.rglob("*") if file.is_file()]
    assert exported.bytes == sum(file.stat().st_size for file in files)
    finest, coarsest = sog_streamed.read_meta(path).counts
    assert exported.splats == finest and 0 < coarsest <= 0.5 * finest
    assert exported.degree == 1 == sog_streamed.read(path, 1).degree
    assert min(exported.psnr) > 25
    assert counted == [(1, 2), (2, 2)]
    # Fitting to pictures of the whole makes the coarse level more like it than baking alone.
    scene = open_scene(source)
    values = []
    for steps in (0, 40):
        compgs.export(source, path, refine=steps, degree=1, overwrite=True, progress=False)
        model = SplatModel(sog_streamed.read(path, 1), scene.background).at(scene.world_offset)
        views = scene.viewpoints[:3]
        values.append(
            np.mean([psnr(*(to_8bit(render(m, view).image) for m in (scene, model))) for view in views])
        )
    assert values[1] > values[0]


def test_tiles_become_levels_in_one_frame(tmp_path: Path, tiny_cgs: Path) -> None:
    offsets = ((5.0, 0.0, 0.0), (9.0, 0.0, 0.0))
    tiles = [NewTile(f"t{i}", from_coarse_to_fine(tiny_cgs, offset)) for i, offset in enumerate(offsets)]
    manifest = write_tiles(tmp_path / "town.tiles", tiles)
    path = tmp_path / "levels" / "lod-meta.json"
    exported = compgs.export(tmp_path / "town.tiles", path, refine=0, degree=0, progress=False)
    assert exported.origin == read_manifest(manifest).world_offset == (7.0, 0.0, 0.0)
    assert sog_streamed.read_meta(path).levels == 2
    assert min(exported.psnr) > 20
    splats = sog_streamed.read(path)
    one = open_scene(tmp_path / "town.tiles" / "t0.cgs")
    middle = np.median(one.bounds[0], axis=0) + one.world_offset - (7.0, 0.0, 0.0)
    assert (np.abs(np.median(splats.means[splats.means[:, 0] < middle[0] + 2], axis=0) - middle) < 1).all()


@pytest.mark.parametrize("limit", ["max_splats", "max_bytes"])
def test_levels_are_not_thinned(limit: str, tmp_path: Path, tiny_cgs: Path) -> None:
    with pytest.raises(ConfigError, match=f"{limit} = 100: .* viewers choose"):
        compgs.export(tiny_cgs, tmp_path / "lod-meta.json", **{limit: 100})
    assert not list(tmp_path.glob("*_*"))
