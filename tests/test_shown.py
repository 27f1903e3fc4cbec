"""What a notebook and a prompt show: a line or a small table, never thousands of numbers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs.config import PRESETS, Config, load_config
from compgs.evaluation.results import Results
from compgs.methods import METHODS
from compgs.model.splats import SplatArrays, SplatModel
from compgs.scene.generated import generate_scene

GOLDEN = Path(__file__).parent / "golden" / "trained.cgs"
LONGEST = 200  # characters of a repr


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> compgs.scene.Scene:
    folder = tmp_path_factory.mktemp("data") / "garden"
    generate_scene(folder, views=9, width=32, height=24)
    return compgs.load_scene(folder)


@pytest.fixture(scope="module")
def results(scene: compgs.scene.Scene) -> Results:
    return compgs.evaluate(GOLDEN, scene, progress=False)


def splats(count: int) -> SplatModel:
    rng = np.random.default_rng(0)
    parts = [
        rng.normal(size=(count, *shape)).astype(np.float32) for shape in ((3,), (3,), (4,), (), (3,), (15, 3))
    ]
    return SplatModel(SplatArrays(*parts), (0.0, 0.0, 0.0))


def test_a_model_is_its_counts() -> None:
    model = compgs.decode(GOLDEN)
    assert repr(model) == f"HybridModel({model.anchors:,} anchors, {model.coupled:,} coupled primitives)"
    assert f"<td>{model.anchors}</td>" in model._repr_html_()
    assert repr(splats(1234)) == "SplatModel(1,234 splats)"
    assert repr(splats(1234).splats) == "SplatArrays(1,234 splats of degree 3)"
    assert "<td>1234</td>" in splats(1234)._repr_html_()


def test_a_scene_is_its_counts_and_some_photographs(scene: compgs.scene.Scene) -> None:
    assert repr(scene).startswith("Scene('garden', 7 training views, 2 held out, ")
    page = scene._repr_html_()
    assert 3 <= page.count("<img") <= 6 and "32 x 24" in page
    view = scene.test_views[0]
    assert repr(view) == f"View({view.name!r}, 32 x 24 pixels)"
    assert view._repr_png_().startswith(b"\x89PNG")


def test_results_are_quality_and_bytes(results: Results) -> None:
    size = GOLDEN.stat().st_size
    assert f"PSNR {results.psnr:.2f} dB" in repr(results) and f"{size:,} bytes" in repr(results)
    assert f"{size:,}" in results._repr_html_() and f"{results.psnr:.2f} dB" in results._repr_html_()


def test_every_line_is_short(scene: compgs.scene.Scene, results: Results) -> None:
    model, camera = compgs.decode(GOLDEN), scene.test_views[0].camera
    drawn = compgs.render(model, camera)
    assert drawn._repr_png_().startswith(b"\x89PNG")
    for shown in (model, scene, scene.points, results, camera, drawn, model.gaussians(camera), splats(9)):
        assert len(repr(shown)) < LONGEST and "\n" not in repr(shown), type(shown)


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_are_their_preset_and_what_differs(preset: str) -> None:
    config = load_config(preset)
    assert repr(config) == f"Config({preset!r})"
    changed = replace(config, training=replace(config.training, lmbda=0.005))
    assert repr(changed) == f"Config({preset!r}, training.lmbda=0.005)"


def test_of_many_settings_that_differ_some_are_shown() -> None:
    config = Config()
    several = replace(config.training, seed=1, lmbda=0.5, head_lr=0.2, ssim_weight=0.1, viewpoints=3)
    assert repr(replace(config, training=several)).endswith(", and 2 more)")
    assert len(repr(replace(config, training=several))) < LONGEST


@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
def test_settings_of_every_method_are_as_short(method: object) -> None:
    kind = method.settings  # type: ignore[attr-defined]
    assert repr(load_config("quick", kind)) == f"{kind.__name__}('quick')"
