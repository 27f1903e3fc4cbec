"""Evaluation measures what a file decodes to, and writes down exactly that."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from compgs import metrics
from compgs.cameras import Camera
from compgs.errors import OutputError, SceneError
from compgs.evaluation import evaluate as package_evaluate
from compgs.evaluation.camera_path import read_cameras
from compgs.evaluation.measure import evaluate
from compgs.scene.views import Points, Scene, View


@dataclass(frozen=True)
class StandIn:
    """Renders a fixed image whatever the camera."""

    level: float  # 0 to 1
    viewpoints: tuple[Camera, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        return {"anchors": 50, "coupled_primitives": 400}


def make_scene(levels: list[int], *, size: tuple[int, int] = (24, 32)) -> Scene:
    """Flat photographs, all of them held out."""
    height, width = size
    views = tuple(
        View(
            f"folder/{i}.jpg",
            Camera(np.eye(4), 30.0, 30.0, width / 2, height / 2, width, height),
            np.full((height, width, 3), level, np.uint8),
        )
        for i, level in enumerate(levels)
    )
    points = Points(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))
    return Scene("flat", views[:1], views, points, (0.0, 0.0, 0.0), 1.0, Path("flat"))


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that decodes to flat images of level 100."""
    path = tmp_path / "flat.cgs"
    path.write_bytes(b"x" * 1000)
    module = "compgs.evaluation.measure"

    def render(model: StandIn, camera: Camera) -> SimpleNamespace:
        return SimpleNamespace(image=np.full((camera.height, camera.width, 3), model.level, np.float32))

    monkeypatch.setattr(f"{module}.open_scene", lambda path, device, background: StandIn(100 / 255))
    monkeypatch.setattr(f"{module}.component_bytes", lambda path: {"positions": 300, "weights": 700})
    monkeypatch.setattr(f"{module}.render", render)
    return path


def test_psnr_is_the_mean_over_views_of_a_closed_form(file: Path) -> None:
    results = evaluate(file, make_scene([101, 110, 104, 155]), device="cpu")
    psnrs = [20 * math.log10(255 / error) for error in (1, 10, 4, 55)]
    assert [view.psnr for view in results.per_view] == pytest.approx(psnrs, abs=1e-6)
    assert results.psnr == pytest.approx(sum(psnrs) / 4, abs=1e-6)


def test_seconds_are_the_median_and_lpips_is_of_all_views_or_of_none(file: Path) -> None:
    results = evaluate(file, make_scene([101, 110, 50]), device="cpu")
    views = [
        replace(view, render_seconds=seconds, lpips=distance)
        for view, seconds, distance in zip(results.per_view, (1.0, 9.0, 2.0), (0.1, 0.5, 0.3), strict=True)
    ]
    assert replace(results, per_view=tuple(views)).render_seconds == 2.0
    assert replace(results, per_view=tuple(views)).lpips == pytest.approx(0.3)
    views[1] = replace(views[1], lpips=None)
    assert replace(results, per_view=tuple(views)).lpips is None


def test_the_file_is_shown_on_the_background_of_the_scene(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = replace(make_scene([101]), background=(1.0, 0.5, 0.25))
    asked = []
    monkeypatch.setattr(
        "compgs.evaluation.measure.open_scene",
        lambda path, device, background: asked.append(background) or StandIn(0.5),
    )
    evaluate(file, scene, device="cpu")
    assert set(asked) == {(1.0, 0.5, 0.25)}


def test_ssim_is_the_mean_over_views(file: Path) -> None:
    scene = make_scene([101, 110, 50, 20])
    results = evaluate(file, scene, device="cpu")
    flat = np.full_like(scene.test_views[0].image, 100)
    each = [metrics.ssim(flat, view.image) for view in scene.test_views]
    assert [view.ssim for view in results.per_view] == pytest.approx(each)
    assert results.ssim == pytest.approx(sum(each) / 4, abs=1e-9)
    assert max(each) - results.ssim > 0.05 < abs(results.ssim - np.median(each))


def test_rates_are_of_the_whole_file(file: Path) -> None:
    results = evaluate(file, make_scene([101]), device="cpu")
    assert results.bytes == 1000
    assert results.components == {"positions": 300, "weights": 700}
    assert results.bits_per_anchor == 8 * 1000 / 50
    assert results.bits_per_coupled_primitive == 8 * 1000 / 400


def test_files_say_what_the_results_say(file: Path, tmp_path: Path) -> None:
    scene = make_scene([101, 110, 90])
    output = tmp_path / "report"
    results = evaluate(file, scene, output=output, device="cpu")
    # The colors of flat pictures are fitted exactly.
    expected = {**results.to_dict(), "psnr_colors_fitted": None}
    assert json.loads((output / "results.json").read_text()) == expected
    rows = json.loads((output / "per_view.json").read_text())
    assert [row["name"] for row in rows] == [view.name for view in scene.test_views]
    for row, view in zip(rows, scene.test_views, strict=True):
        photograph = np.asarray(Image.open(output / "test" / "gt" / row["file"]))
        rendering = np.asarray(Image.open(output / "test" / "renders" / row["file"]))
        np.testing.assert_array_equal(photograph, view.image)
        assert (rendering == 100).all()
    assert [name for name, _ in read_cameras(output / "cameras.json")] == [
        view.name for view in scene.test_views
    ]
    assert (output / "contact_sheet.png").is_file()
    assert not list(output.rglob("*.partial"))


def test_results_say_how_far_held_out_views_are_from_training_views(file: Path) -> None:
    """Cameras in one place that look 10, 30 and 50 degrees aside of the only one that was trained on."""
    flat = make_scene([101, 110, 90, 80])

    def aside(view: View, degrees: float) -> View:
        turn, (c, s) = np.eye(4), (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
        turn[0, 0] = turn[2, 2] = c
        turn[0, 2], turn[2, 0] = s, -s
        return replace(view, camera=replace(view.camera, world_to_camera=turn))

    views = [aside(view, degrees) for view, degrees in zip(flat.test_views, (0, 10, 30, -50), strict=True)]
    scene = replace(flat, train_views=tuple(views[:1]), test_views=tuple(views[1:]), split="by hand")
    results = evaluate(file, scene, device="cpu")
    assert [view.degrees_to_training for view in results.per_view] == pytest.approx([10, 30, 50])
    assert results.to_dict()["degrees_to_training"] == pytest.approx(30)
    assert results.to_dict()["split"] == "by hand"
    alone = evaluate(file, replace(scene, train_views=()), device="cpu")
    assert alone.degrees_to_training is None and alone.per_view[0].degrees_to_training is None


def test_held_out_views_that_cannot_be_measured_are_named_before_anything_is_rendered(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene([101, 110, 90])
    mask = np.zeros((24, 32), dtype=bool)
    masked = replace(scene.test_views[2], counted=mask)
    scene = replace(scene, test_views=(*scene.test_views[:2], masked))
    monkeypatch.setattr("compgs.evaluation.measure.timed_render", lambda *_: pytest.fail("rendered"))
    with pytest.raises(SceneError, match=r"folder/2\.jpg: its mask leaves no pixel"):
        evaluate(file, scene, device="cpu")


def test_an_existing_report_is_kept_unless_asked(file: Path, tmp_path: Path) -> None:
    output = tmp_path / "report"
    evaluate(file, make_scene([101, 110, 90]), output=output, device="cpu")
    before = (output / "results.json").read_bytes()
    with pytest.raises(OutputError, match="overwrite"):
        evaluate(file, make_scene([50]), output=output, device="cpu")
    assert (output / "results.json").read_bytes() == before
    evaluate(file, make_scene([50]), output=output, overwrite=True, device="cpu")
    assert [path.name for path in (output / "test" / "renders").iterdir()] == ["00000.png"]


def test_a_scene_without_held_out_views_is_refused(file: Path) -> None:
    scene = make_scene([101])
    everything_trained = Scene(
        scene.name, scene.test_views, (), scene.points, scene.background, scene.extent, scene.source
    )
    with pytest.raises(SceneError, match="held out"):
        evaluate(file, everything_trained)


def test_flip_is_measured_where_it_is_asked_for_and_of_all_views(file: Path) -> None:
    pytest.importorskip("flip_evaluator")
    scene = make_scene([101, 110, 155])
    assert evaluate(file, scene, device="cpu").flip is None
    results = evaluate(file, scene, flip=True, device="cpu")
    each = [view.flip for view in results.per_view]
    assert None not in each and each == sorted(each) and each[0] > 0
    assert results.to_dict()["flip"] == results.flip == pytest.approx(sum(each) / 3)


def test_missing_lpips_is_reported_with_its_reason(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from compgs import metrics

    def unavailable(*_: object, **__: object) -> metrics.LpipsNetwork:
        raise metrics.Unavailable("no weights here")

    monkeypatch.setattr(metrics, "lpips_network", unavailable)
    results = evaluate(file, make_scene([101]), lpips=True, device="cpu")
    assert results.lpips is None
    assert results.to_dict()["lpips_note"] == "unavailable: no weights here"


def test_lpips_is_measured_in_both_conventions_where_it_is_asked_for(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from compgs import metrics

    class Network:
        def distances(self, a: np.ndarray, b: np.ndarray) -> metrics.LpipsDistances:
            difference = float(np.abs(a.astype(float) - b).mean()) / 255
            return metrics.LpipsDistances(difference, difference / 2)

    monkeypatch.setattr(metrics, "lpips_network", lambda weights, device: {None: Network()}[weights])
    results = evaluate(file, make_scene([101, 110]), lpips=True, device="cpu")
    found = results.to_dict()
    assert (
        found["lpips"] == pytest.approx(sum(v.lpips or 0 for v in results.per_view) / 2)
        and found["lpips"] > 0
    )
    assert found["lpips_3dgs"] == pytest.approx(found["lpips"] / 2) and found["lpips_note"] is None
    assert results.per_view_list()[1]["lpips_3dgs"] == results.per_view[1].lpips_3dgs


def test_errors_are_accounted_for_where_that_is_asked_for(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene([101, 110])
    assert evaluate(file, scene, device="cpu").errors is None
    monkeypatch.setattr(
        "compgs.evaluation.measure.depth", lambda _, camera: np.ones((camera.height, camera.width))
    )
    results = evaluate(file, scene, errors=True, output=tmp_path / "report", device="cpu")
    written = json.loads((tmp_path / "report" / "errors.json").read_text())
    assert results.errors is not None and written == json.loads(json.dumps(results.errors.to_dict()))
    assert written["views"][0]["name"] == min(results.per_view, key=lambda view: view.psnr).name
    assert written["views"][0]["psnr"] == pytest.approx(min(view.psnr for view in results.per_view))
    with Image.open(tmp_path / "report" / "errors.png") as picture:
        assert picture.width > 1000


def test_a_perfect_rendering_is_written_as_valid_json(file: Path, tmp_path: Path) -> None:
    results = evaluate(file, make_scene([100]), output=tmp_path / "report", device="cpu")
    assert results.psnr == math.inf

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    written = json.loads((tmp_path / "report" / "results.json").read_text(), parse_constant=refuse)
    assert written["psnr"] is None
    assert written["ssim"] == pytest.approx(1.0, abs=1e-4)


def test_progress_counts_the_views(file: Path) -> None:
    seen: list[tuple[int, int]] = []
    package_evaluate(
        file, make_scene([1, 2]), device="cpu", progress=lambda done, total: seen.append((done, total))
    )
    assert seen == [(1, 2), (2, 2)]


def masked(scene: Scene, masks: dict[int, np.ndarray]) -> Scene:
    views = tuple(
        replace(view, counted=masks.get(i), pixels=spoiled(view.image, masks.get(i)))
        for i, view in enumerate(scene.test_views)
    )
    return replace(scene, test_views=views)


def spoiled(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """White where the mask leaves pixels out."""
    return image if mask is None else np.where(mask[:, :, None], image, np.uint8(255))


def test_masked_pixels_do_not_count_and_the_report_shows_them(file: Path, tmp_path: Path) -> None:
    """Whatever stands there, the view is as good as one without it."""
    mask = np.ones((24, 32), dtype=bool)
    mask[5:15, 8:20] = False
    output = tmp_path / "report"
    results = evaluate(file, masked(make_scene([110, 110]), {1: mask}), output=output, device="cpu")
    whole, half = results.per_view
    assert half.psnr == whole.psnr == pytest.approx(20 * math.log10(255 / 10), abs=1e-6)
    assert half.ssim == pytest.approx(whole.ssim, abs=0.02)
    assert [path.name for path in (output / "test" / "masks").iterdir()] == ["00001.png"]
    written = np.asarray(Image.open(output / "test" / "masks" / "00001.png"))
    np.testing.assert_array_equal(written, mask * np.uint8(255))
    evaluate(file, make_scene([110, 110]), output=output, overwrite=True, device="cpu")
    assert not list((output / "test" / "masks").iterdir())


def test_a_mask_that_leaves_nothing_is_named(file: Path) -> None:
    with pytest.raises(SceneError, match=r"folder/1\.jpg: its mask leaves no pixel"):
        evaluate(file, masked(make_scene([1, 2]), {1: np.zeros((24, 32), dtype=bool)}), device="cpu")


def test_quality_is_told_with_and_without_colors_fitted(file: Path) -> None:
    """The file renders 100 everywhere: another exposure of it is fitted, what a photograph shows beside it is not."""
    darker = evaluate(file, make_scene([60]), device="cpu")
    assert darker.psnr == pytest.approx(20 * math.log10(255 / 40), abs=1e-6)
    assert darker.psnr_colors_fitted > 45
    scene = make_scene([100])
    image = scene.test_views[0].image.copy()
    image[:, 16:] = 140
    halves = evaluate(
        file, replace(scene, test_views=(replace(scene.test_views[0], pixels=image),)), device="cpu"
    )
    assert halves.psnr_colors_fitted == pytest.approx(20 * math.log10(255 / 20), abs=0.1), "nearest is 120"
    assert halves.to_dict()["psnr_colors_fitted"] == halves.psnr_colors_fitted
    assert halves.per_view_list()[0]["ssim_colors_fitted"] == halves.ssim_colors_fitted
