"""LightGaussian: pruning by significance, distillation of harmonics, a codebook of colors; files by the law."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compgs import metrics
from compgs.config import SplatConfig, TrainingConfig
from compgs.errors import SplatFileError
from compgs.formats.packed import Packed, read, write_packed
from compgs.losses import Target
from compgs.methods import METHODS, settings_of, train
from compgs.methods.lightgaussian.hooks import Distilled, Pruned, content, entries, significance
from compgs.methods.lightgaussian.settings import LightGaussianConfig, LightGaussianSection
from compgs.methods.parts.significance import view_significance
from compgs.model.splats import SplatModel
from compgs.opening import component_bytes, open_scene
from compgs.published.lightgaussian import splat_bytes, splats_of
from compgs.render import Renderable, render
from compgs.scene.views import Scene
from compgs.training import Phase, Run, SplatTrainer, fine_tuning, train_phases

CODECS = ("raw", "deflate")


def settings(steps: int = 60, **section: Any) -> LightGaussianConfig:
    return replace(
        settings_of("lightgaussian"),  # type: ignore[arg-type]
        splats=SplatConfig(densify_every=0.1, densify_stop=0.3, gradient_threshold=1e-4, harmonics=3),
        training=TrainingConfig(steps=steps, seed=3),
        lightgaussian=LightGaussianSection(**{"codebook": 16, "settled": 0.5, "distilled": 0.5, **section}),
    )


@pytest.fixture(scope="module")
def plain(blob_scene: Scene) -> SplatModel:
    config = settings(200)
    config = replace(config, splats=replace(config.splats, harmonics_lr=0.01))
    return train_phases(blob_scene, (Phase(config),), Run("lightgaussian", device="cpu")).model()


def phases(config: LightGaussianConfig, *, distilled: bool = True) -> tuple[Phase, ...]:
    section, steps = config.lightgaussian, config.training.steps
    return (
        Phase(config),
        Phase(fine_tuning(config, max(1, round(section.settled * steps))), lambda: Pruned(section)),
        Phase(fine_tuning(config, max(1, round(section.distilled * steps))), lambda: Distilled(section, 3)),
    )[: 3 if distilled else 2]


def trained(scene: Scene, plain: SplatModel, config: LightGaussianConfig, **options: Any) -> SplatTrainer:
    return train_phases(scene, phases(config, **options), Run("lightgaussian", device="cpu"), plain)


def written(trainer: SplatTrainer, config: LightGaussianConfig, path: Path) -> Path:
    write_packed(path, content(trainer, config), CODECS)
    return path


@pytest.fixture(scope="module")
def trainer(blob_scene: Scene, plain: SplatModel) -> SplatTrainer:
    return trained(blob_scene, plain, settings())


def test_before_deflate_a_file_is_as_large_as_the_law_says(trainer: SplatTrainer, tmp_path: Path) -> None:
    path = written(trainer, settings(), tmp_path / "a.packed")
    packed, count = read(path), len(trainer.parameters)
    coded = int(0.6 * count)
    assert {name: array.nbytes for name, array in packed.arrays.items()} == {
        "means": 12 * count,
        "log_scales": 6 * count,
        "quaternions": 8 * count,
        "opacity_logits": 2 * count,
        "coded": -(-count // 8),
        "labels": -(-coded * 4 // 8),
        "colors": 54 * (count - coded),
        "codes": 54 * 16,
    }
    law = sum(array.nbytes for array in packed.arrays.values())
    assert abs(trainer.hooks.estimated_bytes(trainer) - law) <= 30  # type: ignore[operator]
    sizes = component_bytes(path)
    assert all(sizes[name] <= array.nbytes for name, array in packed.arrays.items())
    # As published, 50.7 bytes a splat: with 34 of 100 splats 14.4 times less than 248 bytes each.
    assert splat_bytes(0.6, 8192, 2) == pytest.approx(50.7, abs=0.01)
    assert 248 / (0.34 * splat_bytes(0.6, 8192, 2)) == pytest.approx(14.4, abs=0.02)


def test_what_is_opened_is_what_was_trained(trainer: SplatTrainer, blob_scene: Scene, tmp_path: Path) -> None:
    """But for half precision, and the colors that are shared."""
    drawn = trainer.as_drawn().arrays().of_degree(2)
    opened = open_scene(written(trainer, settings(coded=0.0), tmp_path / "a.packed"))
    assert isinstance(opened, SplatModel) and opened.splats.degree == 2
    camera = blob_scene.test_views[0].camera
    expected = render(SplatModel(drawn, blob_scene.background), camera).image
    assert np.abs(render(opened, camera).image - expected).max() < 0.01
    assert np.array_equal(opened.splats.means, drawn.means)
    opened = open_scene(written(trainer, settings(), tmp_path / "b.packed"))
    assert isinstance(opened, SplatModel)
    own = np.abs(opened.splats.dc - drawn.dc).max(1) < 2e-3
    important = significance(trainer, 0.1).numpy()
    assert own.sum() >= len(drawn) - int(0.6 * len(drawn))
    assert own[np.argsort(important)[int(0.6 * len(drawn)) :]].all(), "who matters keeps its own color"
    assert len(np.unique(opened.splats.dc[~own], axis=0)) <= 16


def test_the_splats_that_matter_least_go(blob_scene: Scene, plain: SplatModel) -> None:
    config = settings()
    before = SplatTrainer(blob_scene, config, torch.device("cpu"), plain)
    cameras = [view.camera for view in blob_scene.train_views]
    weights = view_significance(before.parameters.trained(), cameras, before.settings).numpy()
    volumes = np.exp(plain.splats.log_scales.astype(np.float64)).prod(1)
    unit = np.sort(volumes)[::-1][int(0.9 * len(volumes))]
    expected = weights * (volumes / unit) ** 0.1
    np.testing.assert_allclose(significance(before, 0.1).numpy(), expected, rtol=1e-6)
    begun = SplatTrainer(blob_scene, config, torch.device("cpu"), plain, Pruned(config.lightgaussian))
    begun.begin()
    kept = np.sort(np.argsort(expected, kind="stable")[int(0.66 * len(expected)) :])
    assert np.array_equal(begun.parameters.means.detach().numpy(), plain.splats.means[kept])


def test_splats_settle_after_pruning(
    blob_scene: Scene, plain: SplatModel, quality: Callable[[Renderable, Scene], float]
) -> None:
    config = settings()
    pruned = SplatTrainer(blob_scene, config, torch.device("cpu"), plain, Pruned(config.lightgaussian))
    pruned.begin()
    settled = trained(blob_scene, plain, config, distilled=False)
    assert len(settled.parameters) == len(pruned.parameters)
    worse, better, whole = (quality(m, blob_scene) for m in (pruned.model(), settled.model(), plain))
    assert worse < whole - 1 and better > worse + 1, (whole, worse, better)


def test_distillation_gains_over_leaving_harmonics_out(blob_scene: Scene, plain: SplatModel) -> None:
    settled = trained(blob_scene, plain, settings(), distilled=False).model()
    cut = replace(settled, splats=settled.splats.of_degree(1))
    distilled = trained(blob_scene, plain, settings(degree=1, distilled=3.0))
    assert torch.equal(
        distilled.parameters.opacity_logits.detach(), torch.from_numpy(settled.splats.opacity_logits)
    ), "opacities stay"
    model = replace(distilled.model(), splats=distilled.model().splats.of_degree(1))

    def likeness(some: SplatModel) -> float:
        cameras = [view.camera for view in blob_scene.train_views]
        pairs = [[metrics.to_8bit(render(m, c).image) for m in (some, settled)] for c in cameras]
        return float(np.mean([metrics.psnr(a, b) for a, b in pairs]))

    assert likeness(model) > likeness(cut) + 1, (likeness(model), likeness(cut))


def test_two_of_three_views_are_looked_at_from_aside(trainer: SplatTrainer, blob_scene: Scene) -> None:
    hooks, camera = trainer.hooks, blob_scene.train_views[0].camera
    assert isinstance(hooks, Distilled)
    away = np.stack([hooks.aside(camera, step, 4.4).center - camera.center for step in range(900)])
    assert not away[::3].any() and away[1::3].any(1).all() and away[2::3].any(1).all()
    assert np.std(away[1::3]) == pytest.approx(0.044, rel=0.1)
    assert np.array_equal(away[1], hooks.aside(camera, 1, 4.4).center - camera.center)
    here, target = hooks.view(camera, Target(torch.zeros(1)), trainer)
    expected = metrics.to_8bit(render(SplatModel(hooks.teacher().arrays(), (0.0, 0.0, 0.0)), here).image)
    assert np.abs(target.image.numpy().astype(int) - expected).max() <= 1


def test_learning_rates_fall(blob_scene: Scene, plain: SplatModel) -> None:
    section = LightGaussianSection()
    assert section.settled_slowing == pytest.approx(0.527, abs=1e-3)
    assert section.distilled_slowing == pytest.approx(0.349, abs=1e-3)
    hooks = Pruned(section)
    begun = SplatTrainer(blob_scene, settings(10), torch.device("cpu"), plain, hooks)
    while begun.step < 10:
        begun.train_step()
    rates = {group["name"]: group["lr"] for group in begun.optimizer.param_groups}
    assert rates["dc"] == pytest.approx(2.5e-3 * section.settled_slowing**0.9, rel=1e-6)


@pytest.mark.slow
def test_a_run_that_was_stopped_continues_exactly(
    check_continues: Callable[..., None], plain: SplatModel
) -> None:
    check_continues("lightgaussian", settings(40), (20, 50, 70))


def test_splats_that_were_trained_elsewhere_are_coded(
    blob_scene: Scene, plain: SplatModel, tmp_path: Path
) -> None:
    model = train(blob_scene, settings(2), method="lightgaussian", splats=plain, device="cpu")
    path = tmp_path / "a.packed"
    assert METHODS["lightgaussian"].write(model, path, settings()) == path.stat().st_size
    camera = blob_scene.test_views[0].camera
    opened = open_scene(path, background=blob_scene.background)
    assert np.array_equal(render(opened, camera).image, render(model, camera).image)
    left = len(plain.splats) - int(0.66 * len(plain.splats))
    assert isinstance(opened, SplatModel) and len(opened.splats) == left


def test_codebooks_of_a_small_scene_are_smaller() -> None:
    section = settings_of("lightgaussian", "scaled").lightgaussian  # type: ignore[attr-defined]
    assert entries(section, 1_000_000, 2) == 8192 and entries(section, 7_000, 2) == 512
    assert entries(LightGaussianSection(), 7_000, 2) == 8192


@pytest.mark.parametrize("coded", [0.0, 1.0])
def test_all_colors_or_none_may_be_shared(coded: float, trainer: SplatTrainer, tmp_path: Path) -> None:
    opened = open_scene(written(trainer, settings(coded=coded), tmp_path / "a.packed"))
    assert isinstance(opened, SplatModel)
    different = len(np.unique(opened.splats.dc, axis=0))
    assert different <= 16 if coded else different > 100


def test_damaged_content_is_refused(trainer: SplatTrainer, tmp_path: Path) -> None:
    whole = read(written(trainer, settings(), tmp_path / "a.packed"))

    def damaged(facts: dict[str, Any] | None = None, **arrays: np.ndarray) -> Packed:
        return Packed("lightgaussian", {**whole.facts, **(facts or {})}, {**whole.arrays, **arrays})

    for facts, message in (
        ({"degree": 4}, "degree: expected 0 to 3"),
        ({"degree": 3}, "codes: expected float16 of shape"),
        ({"offset": None}, "offset: expected three numbers"),
    ):
        with pytest.raises(SplatFileError, match=message):
            splats_of(damaged(facts))
    for name, change, message in (
        ("coded", lambda a: a ^ 128, "labels: expected|colors: expected"),
        ("codes", lambda a: a[:3], "labels: expected indices of 3 entries|labels: expected uint8"),
        ("labels", lambda a: a[1:], "labels: expected uint8"),
        ("colors", lambda a: a[1:], "colors: expected float16"),
        ("means", lambda a: a[1:], "expected"),
        ("quaternions", lambda a: a[:, :3], "quaternions: expected"),
    ):
        with pytest.raises(SplatFileError, match=message):
            splats_of(damaged(**{name: change(whole.arrays[name])}))
    path = tmp_path / "b.packed"
    write_packed(path, damaged(codes=np.full_like(whole.arrays["codes"], np.nan)))
    with pytest.raises(SplatFileError, match="splats cannot be drawn"):
        open_scene(path)
