"""Two files beside each other: numbers by closed form, cameras and places found, and what is written."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import compgs
from compgs import metrics
from compgs.cameras import Camera
from compgs.errors import NotACompGSFile, OutputError, SceneError, UnsupportedCamera
from compgs.evaluation import compare, comparison
from compgs.evaluation.camera_path import camera_entry, read_cameras
from compgs.evaluation.comparison import PAGE_NAME
from compgs.formats import encoded, write_ply
from compgs.formats.splat import ROW
from compgs.model.spherical_harmonics import Y0
from compgs.model.splats import SplatArrays
from compgs.scene.views import Points, Scene, View

from .reports.parsed_page import ParsedPage

WALL = 5.0  # world units in front of the cameras
WIDTH, HEIGHT = 32, 24


def camera(shift: float = 0.0) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = shift
    return Camera(pose, 40.0, 40.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def wall(level: int) -> SplatArrays:
    """One splat that covers every picture of `camera` with a level of gray, whatever is behind."""
    return SplatArrays(
        means=np.array([[0.0, 0.0, WALL]]),
        log_scales=np.full((1, 3), math.log(100.0)) + np.array([[0.0, 0.0, -9.0]]),
        quaternions=np.array([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logits=np.array([20.0]),
        dc=np.full((1, 3), (level / 255 - 0.5) / Y0),
        rest=np.zeros((1, 0, 3)),
    ).each(np.float32)


def photographs(levels: list[int]) -> Scene:
    """Flat ones, all held out."""
    views = tuple(
        View(f"{i}.jpg", camera(0.1 * i), np.full((HEIGHT, WIDTH, 3), level, np.uint8))
        for i, level in enumerate(levels)
    )
    points = Points(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    return Scene("flat", views[:1], views, points, (0.0, 0.0, 0.0), 1.0, Path("flat"))


@pytest.fixture
def walls(tmp_path: Path) -> tuple[Path, Path]:
    """Files whose pictures have the levels 100 and 110."""
    for name, level in (("a", 100), ("b", 110)):
        write_ply(wall(level), tmp_path / f"{name}.ply")
    return tmp_path / "a.ply", tmp_path / "b.ply"


@pytest.fixture(autouse=True)
def fewer_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "AROUND_EVERY", 18)


def db(difference: float) -> float:
    return 20 * math.log10(255 / difference)


def test_a_known_change_gives_the_closed_form(walls: tuple[Path, Path]) -> None:
    found = compare(*walls, scene=photographs([105, 90]), device="cpu")
    assert [view.psnr for view in found.per_view] == pytest.approx([db(10)] * 2, abs=1e-6)
    assert [view.a_psnr for view in found.per_view] == pytest.approx([db(5), db(10)], abs=1e-6)
    assert [view.b_psnr for view in found.per_view] == pytest.approx([db(5), db(20)], abs=1e-6)
    assert found.a.psnr == pytest.approx((db(5) + db(10)) / 2, abs=1e-6)
    assert found.b.psnr == pytest.approx((db(5) + db(20)) / 2, abs=1e-6)
    assert found.psnr == pytest.approx(db(10), abs=1e-6) and not found.identical
    # Levels 100 and 110 everywhere: means 100 and 110, no variance but that of the margin.
    assert 0.9 < found.ssim < 1.0 and found.a.ssim is not None
    assert found.cameras == "held-out views of flat" and found.scene == "flat"
    assert (found.a.bytes, found.b.bytes) == tuple(path.stat().st_size for path in walls)


def test_lpips_is_measured_in_both_conventions_between_the_files_and_against_photographs(
    walls: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Network:
        def distances(self, a: np.ndarray, b: np.ndarray) -> metrics.LpipsDistances:
            difference = float(np.abs(a.astype(float) - b).mean())
            return metrics.LpipsDistances(difference, difference / 2)

    assert compare(*walls, device="cpu").lpips_note == "not asked for"
    monkeypatch.setattr(metrics, "lpips_network", lambda weights, device: {"weights.npz": Network()}[weights])
    found = compare(*walls, scene=photographs([105, 90]), lpips="weights.npz", device="cpu")
    assert (found.lpips, found.lpips_3dgs, found.lpips_note) == (10, 5, None)
    assert (found.a.lpips, found.a.lpips_3dgs) == (7.5, 3.75) and found.b.lpips == 12.5
    written = found.to_dict()
    assert (written["lpips"], written["a"]["lpips_3dgs"]) == (10, 3.75)
    assert found.per_view_list()[1]["b_lpips"] == 20
    assert ", LPIPS 10.0000 (as 3DGS measures it 5.0000)" in found.in_words()[0]


def test_what_a_mask_leaves_out_of_a_photograph_does_not_count(walls: tuple[Path, Path]) -> None:
    """The left half of the photograph is white, and masked."""
    scene = photographs([105])
    pixels, mask = scene.test_views[0].image.copy(), np.ones((HEIGHT, WIDTH), dtype=bool)
    pixels[:, : WIDTH // 2], mask[:, : WIDTH // 2] = 255, False
    view = replace(scene.test_views[0], pixels=pixels, counted=mask)
    found = compare(*walls, scene=replace(scene, test_views=(view,)), device="cpu")
    assert (found.a.psnr, found.b.psnr) == pytest.approx((db(5), db(5)), abs=1e-6)
    assert found.psnr == pytest.approx(db(10), abs=1e-6)  # of the whole pictures
    mask[:] = False
    with pytest.raises(SceneError, match=r"0\.jpg: its mask leaves no pixel"):
        compare(*walls, scene=replace(scene, test_views=(view,)), device="cpu")


def test_the_worst_view_is_that_in_which_the_two_differ_most(
    tmp_path: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    for name, splats in (("a", random_splats(60)), ("b", random_splats(60))):
        splats.dc[:20] += name == "b"
        write_ply(splats, tmp_path / f"{name}.ply")
    found = compare(tmp_path / "a.ply", tmp_path / "b.ply", device="cpu")
    assert found.worst.psnr == min(view.psnr for view in found.per_view) < found.psnr
    assert found.worst.name in " ".join(found.in_words())


def test_a_file_is_identical_to_itself(walls: tuple[Path, Path], tmp_path: Path) -> None:
    found = compare(walls[0], walls[0], cameras=[("one", camera())], output=tmp_path / "out", device="cpu")
    assert found.identical and found.psnr == math.inf
    assert found.ssim == pytest.approx(1.0, abs=1e-4)
    assert found.in_words() == [
        "The files are the same, byte for byte.",
        "Their pictures are identical, in 1 of given cameras (32 x 24 pixels).",
    ]
    written = json.loads((tmp_path / "out" / "results.json").read_text())
    assert written["identical"] is True and written["psnr"] is None
    page = ParsedPage((tmp_path / "out" / PAGE_NAME).read_bytes())
    assert "Against each other: identical" in page.text and "inf" not in page.text
    assert [row[:2] for row in page.tables["views"][1:]] == [["one", "identical"]]
    assert {row[0] for row in page.tables["files"][1:]} == {"a.ply (A)", "a.ply (B)"}


def test_equal_pictures_among_others_count_as_a_hundred_decibels(
    walls: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = comparison.timed_render
    away = camera(0.5)

    def first_is_equal(model: object, place: Camera) -> tuple[np.ndarray, float]:
        image, seconds = rendered(model, place)  # type: ignore[arg-type]
        return (image if place is away else np.full_like(image, 7)), seconds

    monkeypatch.setattr(comparison, "timed_render", first_is_equal)
    found = compare(*walls, cameras=[("near", camera()), ("away", away)], device="cpu")
    assert found.psnr == pytest.approx((100 + db(10)) / 2, abs=1e-6)
    assert not found.identical and found.worst.name == "away"
    assert "1 of the pictures are identical and count as 100 dB" in found.in_words()[0]


@pytest.mark.parametrize("kind", ["ply", "spz", "sog", "glb", "splat"])
def test_every_format_is_compared_with_every_other(
    kind: str, tmp_path: Path, tiny_cgs: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    other = tmp_path / f"other.{kind}"
    if kind == "splat":
        record = np.zeros(50, ROW)
        record["scale"], record["color"], record["rotation"] = 0.05, 200, (255, 128, 128, 128)
        other.write_bytes(record.tobytes())
    else:
        other.write_bytes(encoded(random_splats(), kind))
    found = compare(tiny_cgs, other, device="cpu")
    assert (found.a.format, found.b.format) == ("cgs", kind)
    assert found.b.primitives == found.b.splats == (50 if kind == "splat" else 60)
    assert found.a.primitives == found.a.coupled_primitives and found.a.anchors and found.b.anchors is None
    assert sum(found.b.components.values()) == found.b.bytes == other.stat().st_size
    assert found.cameras == "cameras that tiny.cgs keeps" and len(found.per_view) == 12


def test_the_cameras_of_the_second_file_serve_where_the_first_keeps_none(
    tmp_path: Path, tiny_cgs: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    write_ply(random_splats(), tmp_path / "a.ply")
    found = compare(tmp_path / "a.ply", tiny_cgs, device="cpu")
    assert found.cameras == "cameras that tiny.cgs keeps"
    alone = compare(tmp_path / "a.ply", tmp_path / "a.ply", device="cpu")
    assert alone.cameras == "cameras around the scene" and len(alone.per_view) == 4


def test_cameras_are_taken_from_a_file(walls: tuple[Path, Path], tmp_path: Path) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([camera_entry(camera(), "the place")]))
    found = compare(*walls, cameras=file, device="cpu")
    assert [view.name for view in found.per_view] == ["the place"]
    assert found.cameras == "cameras of cameras.json" and found.a.psnr is None


def test_both_are_seen_over_one_background(
    tmp_path: Path, tiny_cgs: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    nothing = random_splats()
    write_ply(replace(nothing, means=nothing.means + 1e4), tmp_path / "away.ply")
    own = compgs.decode(tiny_cgs).background
    assert any(own)
    behind_all = np.eye(4)
    behind_all[2, 3] = -100.0
    looks_away = replace(camera(), world_to_camera=behind_all)
    for background in (None, (0.2, 0.9, 0.4)):
        for files in ((tiny_cgs, tmp_path / "away.ply"), (tmp_path / "away.ply", tiny_cgs)):
            found = compare(*files, cameras=[("away", looks_away)], background=background, device="cpu")
            assert found.identical


def test_positions_that_have_lost_their_origin_are_put_back(
    tmp_path: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    origin = (4.0e6, -2.0e5, 17.0)
    (tmp_path / "far.glb").write_bytes(encoded(replace(random_splats(), world_offset=origin), "glb"))
    (tmp_path / "local.spz").write_bytes(encoded(random_splats(), "spz"))
    for files in (("far.glb", "local.spz"), ("local.spz", "far.glb")):
        found = compare(*(tmp_path / name for name in files), device="cpu")
        assert found.psnr > 25 and found.a.psnr is None
        assert found.notes == (
            "local.spz does not say where its positions count from: taken as 4000000 -200000 17",
        )


def test_positions_near_the_origin_stay_where_they_are(
    tmp_path: Path, random_splats: Callable[..., SplatArrays]
) -> None:
    origin = (3.0, 0.0, 0.0)
    (tmp_path / "a.glb").write_bytes(encoded(replace(random_splats(), world_offset=origin), "glb"))
    write_ply(replace(random_splats(), world_offset=origin), tmp_path / "b.ply")
    found = compare(tmp_path / "a.glb", tmp_path / "b.ply", device="cpu")
    assert found.notes == () and found.psnr > 60


def test_what_is_written_says_what_was_found(walls: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    found = compare(*walls, scene=photographs([105, 90, 95]), output=out, device="cpu")
    assert json.loads((out / "results.json").read_text()) == found.to_dict()
    rows = json.loads((out / "per_view.json").read_text())
    assert rows == found.per_view_list() and [row["file"] for row in rows] == [
        f"0000{i}.png" for i in range(3)
    ]
    assert [name for name, _ in read_cameras(out / "cameras.json")] == ["0.jpg", "1.jpg", "2.jpg"]
    for folder, level in (("a", 100), ("b", 110), ("gt", 95)):
        assert (np.asarray(Image.open(out / folder / "00002.png")) == level).all()
    assert [row["difference_scale"] for row in rows] == [16] * 3
    difference = np.asarray(Image.open(out / "difference" / "00002.png"))
    assert difference.shape == (HEIGHT, WIDTH, 3) and np.ptp(difference.reshape(-1, 3), axis=0).max() == 0
    assert [path.name for path in out.parent.iterdir()] == ["out"]

    page = ParsedPage((out / PAGE_NAME).read_bytes())
    assert page.asks_nothing_of_the_network()
    row = page.row("files", "b.ply")
    assert (
        row["bytes"] == f"{found.b.bytes:,}" and row["PSNR against photographs, dB"] == f"{found.b.psnr:.2f}"
    )
    assert f"PSNR {found.psnr:.2f} dB" in page.text
    assert {alt for alt, _ in page.images} == {"a.ply", "b.ply", "photograph", "errors of b.ply"}


def test_the_page_shows_the_views_that_differ_most_first(
    tmp_path: Path,
    walls: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
    random_splats: Callable[..., SplatArrays],
) -> None:
    from compgs.evaluation.reports import comparison_page

    monkeypatch.setattr(comparison_page, "SHOWN_VIEWS", 2)
    write_ply(random_splats(), tmp_path / "c.ply")
    found = compare(tmp_path / "c.ply", walls[1], output=tmp_path / "out", device="cpu")
    page = ParsedPage((tmp_path / "out" / PAGE_NAME).read_bytes())
    ranked = [view.name for view in sorted(found.per_view, key=lambda view: view.psnr)]
    assert [row[0] for row in page.tables["views"][1:]] == ranked
    assert page.text.index(ranked[0]) < page.text.index(ranked[1])
    assert page.tags.count("figure") == 2 and "2 more views are in the table below" in page.text


def test_an_earlier_comparison_stays_until_the_new_one_is_whole(
    walls: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    compare(*walls, scene=photographs([105, 90, 95]), output=out, device="cpu")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(OutputError, match="overwrite"):
        compare(*walls, scene=photographs([5]), output=out, device="cpu")

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare(*walls, scene=photographs([5]), output=out, overwrite=True, progress=stop, device="cpu")
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert {path.name for path in tmp_path.iterdir()} == {"a.ply", "b.ply", "out"}

    compare(*walls, scene=photographs([5]), output=out, overwrite=True, device="cpu")
    assert [path.name for path in (out / "a").iterdir()] == ["00000.png"]


def test_what_cannot_be_compared_is_said(walls: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(NotACompGSFile, match=r"nowhere\.cgs: there is no such file"):
        compare(walls[0], tmp_path / "nowhere.cgs")
    with pytest.raises(SceneError, match="both given"):
        compare(*walls, scene=photographs([1]), cameras=[("one", camera())])
    with pytest.raises(UnsupportedCamera, match="no cameras"):
        compare(*walls, cameras=[])
    trained = photographs([1])
    with pytest.raises(SceneError, match="held out"):
        compare(*walls, scene=replace(trained, train_views=trained.test_views, test_views=()))


def test_progress_counts_the_views(walls: tuple[Path, Path]) -> None:
    seen: list[tuple[int, int]] = []
    compare(
        *walls,
        scene=photographs([1, 2]),
        progress=lambda done, total: seen.append((done, total)),
        device="cpu",
    )
    assert seen == [(1, 2), (2, 2)]
