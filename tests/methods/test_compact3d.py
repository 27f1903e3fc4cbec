"""Compact3D: codes that are learned with the splats, a penalty on opacities, and files of exactly so many bytes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from compgs.config import SplatConfig, TrainingConfig
from compgs.errors import SplatFileError
from compgs.formats.packed import Packed, read, write_packed
from compgs.methods import settings_of
from compgs.methods.compact3d.hooks import CODED, LearnedCodebooks
from compgs.methods.compact3d.settings import Compact3DConfig, Compact3DSection
from compgs.methods.parts.vector_quantization import first_codes, k_means
from compgs.model.splats import SplatModel
from compgs.opening import component_bytes, open_scene
from compgs.published.compact3d import splats_of
from compgs.render import Renderable, render
from compgs.scene.views import Scene
from compgs.training import Hooks, Phase, Run, SplatTrainer, train_phases

STEPS = 120


def settings(**section: Any) -> Compact3DConfig:
    return replace(
        settings_of("compact3d"),  # type: ignore[arg-type]
        splats=SplatConfig(densify_every=0.1, gradient_threshold=1e-5, harmonics=1),
        training=TrainingConfig(steps=STEPS, seed=3),
        compact3d=Compact3DSection(**{"codebook": 16, "harmonics_codebook": 8, **section}),
    )


def trained(scene: Scene, config: Compact3DConfig, **options: Any) -> SplatTrainer:
    def hooks() -> Hooks:
        return LearnedCodebooks(config.compact3d, config.training)

    return train_phases(scene, (Phase(config, hooks),), Run("compact3d", device="cpu", **options))


def written(trainer: SplatTrainer, path: Path) -> Path:
    assert isinstance(trainer.hooks, LearnedCodebooks)
    write_packed(path, trainer.hooks.content(trainer), ("raw",))
    return path


@pytest.fixture(scope="module")
def trainer(blob_scene: Scene) -> SplatTrainer:
    return trained(blob_scene, settings())


def test_a_file_is_as_large_as_the_law_says(trainer: SplatTrainer, tmp_path: Path) -> None:
    path = written(trainer, tmp_path / "a.packed")
    count, sizes = len(trainer.parameters), component_bytes(path)
    sixteenths = -(-count * 4 // 8)  # of codebooks of 16
    assert sizes == {
        "header": sizes["header"],
        "means": 12 * count,
        "opacity_logits": 4 * count,
        "dc_labels": sixteenths,
        "log_scales_labels": sixteenths,
        "rest_labels": -(-count * 3 // 8),
        "quaternions_counts": 4 * 16,
        "dc_codes": 4 * 3 * 16,
        "log_scales_codes": 4 * 3 * 16,
        "quaternions_codes": 4 * 4 * 16,
        "rest_codes": 4 * 9 * 8,
    }
    assert isinstance(trainer.hooks, LearnedCodebooks)
    assert abs(trainer.hooks.estimated_bytes(trainer) - (path.stat().st_size - sizes["header"])) <= 3


@pytest.mark.parametrize("bit_quantized", [False, True])
def test_what_is_opened_is_what_was_trained(
    bit_quantized: bool, trainer: SplatTrainer, blob_scene: Scene, tmp_path: Path
) -> None:
    hooks = trainer.hooks
    assert isinstance(hooks, LearnedCodebooks)
    hooks.section = replace(hooks.section, bit_quantized=bit_quantized)
    path = written(trainer, tmp_path / "a.packed")
    hooks.section = replace(hooks.section, bit_quantized=False)
    drawn = SplatModel(trainer.as_drawn().arrays(), blob_scene.background)
    opened = open_scene(path, background=blob_scene.background)
    camera = blob_scene.test_views[0].camera
    difference = np.abs(render(opened, camera).image - render(drawn, camera).image)
    assert difference.max() < (0.1 if bit_quantized else 1e-5)
    assert difference.mean() < (3e-3 if bit_quantized else 1e-6)
    if bit_quantized:
        sizes = component_bytes(path)
        per_splat = sum(sizes[name] for name in ("x", "y", "z", "opacity_logits"))
        assert per_splat == 7 * len(trainer.parameters)


def test_splats_have_no_values_of_their_own(trainer: SplatTrainer) -> None:
    drawn = trainer.as_drawn()
    for name in CODED:
        assert len(torch.unique(getattr(drawn, name), dim=0)) <= (8 if name == "rest" else 16)
        own = getattr(trainer.parameters, name).detach()
        assert len(torch.unique(own, dim=0)) > 16, "the values behind the codes go on moving"


def test_codes_that_are_learned_lose_less_than_k_means_afterwards(
    blob_scene: Scene, tmp_path: Path, quality: Callable[[Renderable, Scene], float]
) -> None:
    config = replace(
        settings(opacity_weight=0.0, codebook=4, harmonics_codebook=4),
        training=TrainingConfig(steps=200, seed=3),
    )
    splats = train_phases(blob_scene, (Phase(config),), Run("compact3d", device="cpu")).parameters.trained()
    coded = {}
    for name in CODED:
        values = getattr(splats, name).flatten(1)
        codes, labels = k_means(values, first_codes(values, 4, torch.Generator()), 30)
        coded[name] = codes[labels].view_as(getattr(splats, name))
    without, after = (
        quality(SplatModel(some.arrays(), blob_scene.background), blob_scene)
        for some in (splats, replace(splats, **coded))
    )
    learned = quality(open_scene(written(trained(blob_scene, config), tmp_path / "a.packed")), blob_scene)
    assert without > learned > after + 0.4, (without, learned, after)


def test_a_heavier_penalty_leaves_fewer_splats(blob_scene: Scene) -> None:
    left = []
    for weight in (0.0, 0.33, 10.0):
        config = settings(opacity_weight=weight)
        config = replace(config, splats=replace(config.splats, opacity_lr=0.5))  # short runs have little time
        trainer = trained(blob_scene, config)
        left.append(len(trainer.parameters))
        assert all(len(getattr(trainer.hooks, name)) == left[-1] for name in LearnedCodebooks.per_splat)
    assert left[0] > left[1] > 1.5 * left[2] > 0, left


@pytest.mark.slow
def test_a_run_that_was_stopped_continues_exactly(check_continues: Callable[..., None]) -> None:
    config = replace(settings(opacity_weight=10.0), training=TrainingConfig(steps=80, seed=3))
    check_continues("compact3d", config, (30, 50, 70))


def test_codebooks_of_a_small_scene_are_smaller(trainer: SplatTrainer) -> None:
    hooks = LearnedCodebooks(settings_of("compact3d").compact3d, TrainingConfig())  # type: ignore[attr-defined]
    assert hooks.counts(3_000_000, 3) == {"dc": 4096, "log_scales": 4096, "quaternions": 4096, "rest": 512}
    assert hooks.counts(300, 3) == {"dc": 300, "log_scales": 300, "quaternions": 300, "rest": 300}
    assert hooks.counts(300, 0) == {"dc": 300, "log_scales": 300, "quaternions": 300}
    section = settings_of("compact3d", "scaled").compact3d  # type: ignore[attr-defined]
    hooks = LearnedCodebooks(section, TrainingConfig())
    assert hooks.counts(20_000, 3) == {"dc": 512, "log_scales": 512, "quaternions": 512, "rest": 64}
    assert hooks.counts(3_000_000, 3)["dc"] == 4096


def test_the_schedule_is_the_published_one(monkeypatch: pytest.MonkeyPatch) -> None:
    done: dict[str, list[int]] = {"assign": [], "prune": []}
    for name, steps in done.items():
        monkeypatch.setattr(LearnedCodebooks, name, lambda self, trainer, s=steps: s.append(trainer.step))
    for steps, scale in ((30_000, 1), (3_000, 10), (600, 50)):
        for each in done.values():
            each.clear()
        hooks = LearnedCodebooks(Compact3DSection(), TrainingConfig(steps=steps))
        hooks.penalized = torch.zeros((), dtype=torch.int64)
        trainer = SimpleNamespace(step=0, parameters=range(7))
        while trainer.step < steps:
            trainer.step += 1
            hooks.after_step(trainer)  # type: ignore[arg-type]
        every = max(100 // scale, 20)
        assert done["assign"] == list(range(15_000 // scale, 25_000 // scale, every))
        assert done["prune"] == list(range(16_000 // scale, 20_000 // scale + 1, 1_000 // scale))
        assert int(hooks.penalized) == 7


def test_very_short_runs_end_with_codes(blob_scene: Scene, tmp_path: Path) -> None:
    config = replace(settings(), training=TrainingConfig(steps=1), splats=SplatConfig(harmonics=0))
    opened = open_scene(written(trained(blob_scene, config), tmp_path / "a.packed"))
    assert isinstance(opened, SplatModel) and len(np.unique(opened.splats.dc, axis=0)) == 16
    assert opened.splats.degree == 0


def test_damaged_content_is_refused(trainer: SplatTrainer, tmp_path: Path) -> None:
    whole = read(written(trainer, tmp_path / "a.packed"))

    def damaged(facts: dict[str, Any] | None = None, **arrays: np.ndarray) -> Packed:
        return Packed("compact3d", {**whole.facts, **(facts or {})}, {**whole.arrays, **arrays})

    for facts, message in (
        ({"degree": 4}, "degree: expected 0 to 3"),
        ({"degree": 2}, r"rest_codes: expected float32 of shape \(any, 24\)"),
        ({"bit_quantized": 2}, "bit_quantized: expected 0 to 1"),
        ({"bit_quantized": 1}, "there are no x"),
        ({"offset": [0, 0]}, "offset: expected three numbers"),
    ):
        with pytest.raises(SplatFileError, match=message):
            splats_of(damaged(facts))
    for name, array, message in (
        ("dc_codes", whole.arrays["dc_codes"][:15], "dc_labels: expected indices of 15 entries, found 15"),
        ("dc_codes", whole.arrays["dc_codes"][:0], "dc_labels: expected"),
        ("dc_labels", whole.arrays["dc_labels"][1:], "dc_labels: expected uint8"),
        ("quaternions_counts", whole.arrays["quaternions_counts"] + np.uint32(1), "expected"),
        ("opacity_logits", whole.arrays["opacity_logits"][1:], "opacity_logits: expected float32"),
    ):
        with pytest.raises(SplatFileError, match=message):
            splats_of(damaged(**{name: array}))
    path = tmp_path / "b.packed"
    write_packed(path, damaged(quaternions_codes=np.zeros_like(whole.arrays["quaternions_codes"])))
    # How many there are depends on the processor's last bits.
    with pytest.raises(
        SplatFileError, match=r": ([\d,]+) of \1 splats cannot be drawn: \1 without a rotation"
    ):
        open_scene(path)


def test_a_training_on_the_way_tells_its_size(blob_scene: Scene) -> None:
    seen: list[int] = []
    trained(blob_scene, settings(), on_progress=lambda status: seen.append(status.estimated_bytes))
    assert min(seen) > 0 and max(seen) < 60 * 20 * len(blob_scene.points)
