"""Plain 3DGS of which most splats are pruned, in .spz and .sog: which go, what settling gains, what a file weighs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compgs.config import SplatConfig, TrainingConfig
from compgs.errors import ConfigError
from compgs.methods import METHODS, settings_of, train, write
from compgs.methods.parts.significance import view_significance
from compgs.methods.pruned import PrunedConfig, PrunedSection
from compgs.methods.pruned.hooks import Pruned
from compgs.model.splats import SplatModel
from compgs.opening import open_scene
from compgs.render import Renderable, render
from compgs.scene.views import Scene
from compgs.training import SplatTrainer

NAMES = ("pruned-spz", "pruned-sog")


def settings(steps: int = 60, **section: Any) -> PrunedConfig:
    return replace(
        settings_of("pruned-spz"),  # type: ignore[arg-type]
        splats=SplatConfig(densify_every=0.1, densify_stop=0.3, gradient_threshold=1e-4),
        training=TrainingConfig(steps=steps, seed=3),
        pruned=PrunedSection(**section),
    )


@pytest.fixture(scope="module")
def plain(blob_scene: Scene) -> SplatModel:
    return train(blob_scene, settings(200), method="3dgs", device="cpu")


def test_the_splats_that_the_training_views_show_least_go(blob_scene: Scene, plain: SplatModel) -> None:
    before = SplatTrainer(blob_scene, settings(), torch.device("cpu"), plain)
    cameras = [view.camera for view in blob_scene.train_views]
    weights = view_significance(before.parameters.trained(), cameras, before.settings).numpy()
    after = SplatTrainer(blob_scene, settings(), torch.device("cpu"), plain, Pruned(0.8))
    after.begin()
    kept = np.sort(np.argsort(weights, kind="stable")[int(0.8 * len(weights)) :])
    assert np.array_equal(after.parameters.means.detach().numpy(), plain.splats.means[kept])


def test_the_splats_that_stay_settle(
    blob_scene: Scene, plain: SplatModel, quality: Callable[[Renderable, Scene], float]
) -> None:
    at_once = SplatTrainer(blob_scene, settings(), torch.device("cpu"), plain, Pruned(0.8))
    at_once.begin()
    settled = train(blob_scene, settings(settled=1.0), method="pruned-spz", splats=plain, device="cpu")
    assert len(settled.splats) == len(at_once.parameters) == len(plain.splats) - int(0.8 * len(plain.splats))
    assert quality(settled, blob_scene) > quality(at_once.model(), blob_scene) + 1


@pytest.mark.parametrize("name", NAMES)
def test_a_file_is_that_of_the_splats_that_stay(
    name: str, blob_scene: Scene, plain: SplatModel, tmp_path: Path
) -> None:
    model = train(blob_scene, settings(), method=name, splats=plain, device="cpu")
    path = tmp_path / f"a{METHODS[name].suffix}"
    size = write(model, path, method=name)
    opened = open_scene(path)
    assert size == path.stat().st_size and opened.counts == model.counts
    whole = tmp_path / f"whole{METHODS[name].suffix}"
    write(plain, whole, method=name.removeprefix("pruned-"))
    assert size < 0.5 * whole.stat().st_size
    camera = blob_scene.test_views[0].camera
    assert np.abs(render(opened, camera).image - render(model, camera).image).mean() < 0.01


@pytest.mark.parametrize("stop", [40, 70])
def test_a_run_that_was_stopped_before_or_after_the_pruning_continues_exactly(
    stop: int, blob_scene: Scene, tmp_path: Path
) -> None:
    def stopped(status: Any) -> None:
        if status.step == stop:
            raise KeyboardInterrupt

    def run(**options: Any) -> SplatModel:
        return train(blob_scene, settings(), method="pruned-sog", device="cpu", **options)

    whole = run()
    with pytest.raises(KeyboardInterrupt):
        run(output=tmp_path, progress=stopped)
    again = run(output=tmp_path, resume=True)
    assert np.array_equal(whole.splats.means, again.splats.means)
    assert np.array_equal(whole.splats.dc, again.splats.dc)


def test_a_scene_too_far_away_for_the_file_is_refused(blob_scene: Scene) -> None:
    def moved(views: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(replace(v, camera=v.camera.moved((-1e6, 0.0, 0.0))) for v in views)

    far = replace(blob_scene, train_views=moved(blob_scene.train_views))
    for name in NAMES:
        with pytest.raises(ConfigError, match=rf"a \.{name.partition('-')[2]} file cannot say where"):
            train(far, method=name)
