"""c3dgs: what is sensitive keeps its own entry, the rest is shared; trained as 8 bits show it; files by the law."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compgs.config import SplatConfig, TrainingConfig
from compgs.errors import SplatFileError
from compgs.formats.packed import Packed, read, write_packed
from compgs.formats.sog import morton_order
from compgs.methods import METHODS, settings_of
from compgs.methods.c3dgs.hooks import SharedEntries, shared
from compgs.methods.c3dgs.sensitivity import sensitivities
from compgs.methods.c3dgs.settings import C3DGSConfig, C3DGSSection
from compgs.methods.c3dgs.shapes import (
    covariances,
    quaternions_of,
    rotation_matrices,
    scales_and_rotations,
)
from compgs.model.splats import SplatModel
from compgs.opening import component_bytes, open_scene
from compgs.published.c3dgs import splats_of
from compgs.render import RasterSettings, Renderable, render
from compgs.scene.views import Scene
from compgs.tensors.rasterize import rasterize
from compgs.tensors.splats import Splats, splat_gaussians
from compgs.training import Phase, Run, SplatTrainer, fine_tuning, train_phases

CODECS = ("raw", "deflate")
CUTOFF = 1e-5  # of alphas: where a splat ends, the image hardly jumps


def settings(steps: int = 60, **section: Any) -> C3DGSConfig:
    return replace(
        settings_of("c3dgs"),  # type: ignore[arg-type]
        splats=SplatConfig(densify_stop=0.0, harmonics=1),
        training=TrainingConfig(steps=steps, seed=3),
        c3dgs=C3DGSSection(**{"codebook": 16, "tuned": 0.5, "threshold": 0.1, **section}),
    )


@pytest.fixture(scope="module")
def plain(blob_scene: Scene) -> SplatModel:
    """Splats with harmonics and shapes to be shared."""
    config = settings(200)
    config = replace(config, splats=replace(config.splats, harmonics_lr=0.01))
    return train_phases(blob_scene, (Phase(config),), Run("c3dgs", device="cpu")).model()


def tuned(scene: Scene, plain: SplatModel, config: C3DGSConfig) -> SplatTrainer:
    steps = max(1, round(config.c3dgs.tuned * config.training.steps))
    phase = Phase(fine_tuning(config, steps), lambda: SharedEntries(config))
    return train_phases(scene, (Phase(config), phase), Run("c3dgs", device="cpu"), plain)


def written(trainer: SplatTrainer, path: Path) -> Path:
    assert isinstance(trainer.hooks, SharedEntries)
    write_packed(path, trainer.hooks.content(trainer), CODECS)
    return path


@pytest.fixture(scope="module")
def trainer(blob_scene: Scene, plain: SplatModel) -> SplatTrainer:
    return tuned(blob_scene, plain, settings())


# shapes ------------------------------------------------------------------------------------------------------------


def chance(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_shapes_become_scales_and_rotations_again() -> None:
    quaternions = torch.randn(200, 4, generator=chance(0))
    scales = torch.nn.functional.normalize(torch.rand(200, 3, generator=chance(1)), dim=1)
    scales[:10], scales[10:20, 0] = 3**-0.5, 0.0  # balls; disks
    scales = torch.nn.functional.normalize(scales, dim=1)
    found = covariances(scales, quaternions)
    for row in (0, 15, 150):  # the slow way
        axes = rotation_matrices(quaternions)[row].double().numpy()
        expected = axes @ np.diag(scales[row].double().numpy() ** 2) @ axes.T
        np.testing.assert_allclose(found[row], expected[np.triu_indices(3)], atol=1e-6)
    again = scales_and_rotations(found)
    torch.testing.assert_close(covariances(*again), found, atol=1e-6, rtol=0)
    torch.testing.assert_close(again[0], scales.sort(1).values, atol=1e-3, rtol=0)


def test_rotations_become_quaternions_again_whichever_number_is_largest() -> None:
    quaternions = torch.cat([torch.eye(4), torch.randn(100, 4, generator=chance(2))])
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    matrices = rotation_matrices(unit)
    torch.testing.assert_close(
        matrices @ matrices.transpose(1, 2), torch.eye(3).expand(104, 3, 3), atol=1e-6, rtol=0
    )
    turn = rotation_matrices(torch.tensor([[1.0, 0.0, 0.0, 1.0]]))[0]  # a quarter about z
    torch.testing.assert_close(turn @ torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0]), atol=1e-6, rtol=0)
    found = quaternions_of(matrices)
    torch.testing.assert_close(
        (found * unit).sum(1).abs(), torch.ones(104), atol=1e-6, rtol=0, msg="the same, up to sign"
    )


# sensitivity -------------------------------------------------------------------------------------------------------


def image_sum(splats: Splats, scene: Scene, view: int) -> float:
    camera = scene.train_views[view].camera
    image = rasterize(splat_gaussians(splats, camera), camera, RasterSettings(alpha_cutoff=CUTOFF)).image
    return float(image.double().sum())


def test_sensitivity_is_how_the_sum_of_images_changes(blob_scene: Scene, plain: SplatModel) -> None:
    splats = Splats.of(plain.splats)
    splats = replace(splats, dc=splats.dc + 6)  # no color is near 0, where it would be clamped
    cameras = [view.camera for view in blob_scene.train_views[:2]]
    white = RasterSettings(background=(1.0, 1.0, 1.0), alpha_cutoff=CUTOFF)
    of_colors, of_shapes = sensitivities(splats, cameras, white)
    pixels = 2 * 48 * 36
    assert of_colors.max() > 1e-4 and of_shapes.max() > 1e-3
    for row in torch.sort(of_colors, descending=True).indices[[0, 3, 10]].tolist():
        by_color = torch.zeros(4)
        by_shape = torch.zeros(3)
        for view in (0, 1):
            changes: list[float] = []
            for coefficient in range(4):
                both = []
                for sign in (-0.05, 0.05):
                    dc, rest = splats.dc.clone(), splats.rest.clone()
                    (dc[row] if coefficient == 0 else rest[row, coefficient - 1])[0] += sign
                    both.append(image_sum(replace(splats, dc=dc, rest=rest), blob_scene, view))
                changes.append(abs(both[1] - both[0]) / 0.1)
            by_color += torch.tensor(changes)
            changes = []
            for axis in range(3):
                both = []
                for sign in (-0.01, 0.01):
                    scales = splats.log_scales.clone()
                    scales[row, axis] += sign
                    both.append(image_sum(replace(splats, log_scales=scales), blob_scene, view))
                changes.append(abs(both[1] - both[0]) / 0.02)
            by_shape += torch.tensor(changes)
        assert float(of_colors[row]) == pytest.approx(float(by_color.max()) / pixels, rel=0.03)
        assert float(of_shapes[row]) == pytest.approx(float(by_shape.max()) / pixels, rel=0.1)


def test_what_no_view_sees_goes(blob_scene: Scene, plain: SplatModel) -> None:
    arrays = plain.splats
    doubled = arrays.each(lambda array: np.concatenate([array, array]))
    far = np.where(np.arange(2 * len(arrays))[:, None] < len(arrays), 0, 1e3).astype(np.float32)
    both = replace(plain, splats=replace(doubled, means=doubled.means + far))
    left = tuned(blob_scene, both, settings(2))
    assert len(left.parameters) <= len(arrays) and left.parameters.means.abs().max() < 100


def test_what_is_sensitive_has_an_entry_of_its_own() -> None:
    vectors = torch.randn(50, 2, generator=chance(0))
    sensitivity = torch.arange(50.0)
    entries, labels = shared(vectors, sensitivity, 39.0, 4, 20, 1000, 0.8, chance(1))
    assert entries.shape == (14, 2)
    assert torch.equal(entries[labels[40:]], vectors[40:]) and len(torch.unique(labels[40:])) == 10
    assert labels[:40].max() < 4
    few, same = shared(vectors, sensitivity, 45.0, 100, 20, 1000, 0.8, chance(1))
    assert torch.equal(few[same], vectors), "where there is an entry for each, each has one"
    own, rows = shared(vectors, sensitivity, -1.0, 4, 20, 1000, 0.8, chance(1))
    assert torch.equal(own[rows], vectors) and len(own) == 50


# files -------------------------------------------------------------------------------------------------------------


def test_before_deflate_a_file_is_as_large_as_the_law_says(trainer: SplatTrainer, tmp_path: Path) -> None:
    path = written(trainer, tmp_path / "a.packed")
    packed, hooks = read(path), trainer.hooks
    assert isinstance(hooks, SharedEntries)
    count, colors, shapes = len(trainer.parameters), len(hooks.dc), len(hooks.scales)
    assert {name: array.nbytes for name, array in packed.arrays.items()} == {
        "means": 6 * count,
        "opacities": count,
        "log_factors": count,
        "colors": 4 * count,
        "shapes": 4 * count,
        "dc": 3 * colors,
        "rest": 9 * colors,
        "scales": 3 * shapes,
        "quaternions": 4 * shapes,
    }
    law = 16 * count + 12 * colors + 7 * shapes
    assert hooks.estimated_bytes(trainer) == law
    sizes = component_bytes(path)
    assert all(sizes[name] <= array.nbytes for name, array in packed.arrays.items())
    assert path.stat().st_size - sizes["header"] < 0.9 * law
    means = packed.arrays["means"].astype(np.float32)
    assert np.array_equal(morton_order(means), np.arange(count))


def test_what_is_opened_is_what_was_trained(trainer: SplatTrainer, blob_scene: Scene, tmp_path: Path) -> None:
    drawn = SplatModel(trainer.as_drawn().arrays(), blob_scene.background)
    opened = open_scene(written(trainer, tmp_path / "a.packed"), background=blob_scene.background)
    assert isinstance(opened, SplatModel)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "dc", "rest"):
        theirs, ours = (np.sort(getattr(m.splats, name), axis=0) for m in (opened, drawn))
        np.testing.assert_allclose(theirs, ours, atol=2e-5, err_msg=name)
    for view in (*blob_scene.test_views, *blob_scene.train_views[:2]):
        difference = render(opened, view.camera).image - render(drawn, view.camera).image
        assert np.abs(difference).max() < 1e-4


def test_fine_tuning_gains_over_what_codebooks_lose(
    trainer: SplatTrainer,
    plain: SplatModel,
    blob_scene: Scene,
    tmp_path: Path,
    quality: Callable[[Renderable, Scene], float],
) -> None:
    config = settings(threshold=1e6)
    clustered = tuned(blob_scene, plain, replace(config, c3dgs=replace(config.c3dgs, tuned=1e-6)))
    after = tuned(blob_scene, plain, config)
    lost, gained = (
        quality(open_scene(written(t, tmp_path / name)), blob_scene)
        for t, name in ((clustered, "a.packed"), (after, "b.packed"))
    )
    without = quality(plain, blob_scene)
    assert lost < without - 1 and gained > lost + 0.5, (without, lost, gained)
    assert len(clustered.hooks.dc) == 16, "nothing is as sensitive as that"  # type: ignore[arg-type]
    assert 20 < len(trainer.hooks.dc) < 140, "some are"  # type: ignore[arg-type]


def test_positions_count_from_the_middle_and_rates_are_those_of_the_run(
    blob_scene: Scene, plain: SplatModel
) -> None:
    config = settings()
    begun = SplatTrainer(blob_scene, config, torch.device("cpu"), plain, SharedEntries(config))
    begun.begin()
    median = begun.parameters.means.detach().median(0).values
    assert torch.equal(begun.hooks.center, median)  # type: ignore[arg-type]
    drawn = begun.as_drawn().means
    assert torch.equal(drawn, median + (begun.parameters.means.detach() - median).half().float())
    rates = {group["name"]: group["rates"] for group in begun.optimizer.param_groups}
    for entry, own in (
        ("dc", "dc"),
        ("rest", "rest"),
        ("scales", "log_scales"),
        ("log_factors", "log_scales"),
        ("quaternions", "quaternions"),
    ):
        assert rates[f"hooks/{entry}"] == rates[own]


@pytest.mark.slow
def test_a_run_that_was_stopped_continues_exactly(
    check_continues: Callable[..., None], plain: SplatModel
) -> None:
    check_continues("c3dgs", settings(40), (20, 50))


def test_splats_that_were_trained_elsewhere_are_coded(
    blob_scene: Scene, plain: SplatModel, tmp_path: Path
) -> None:
    from compgs import methods

    content = methods.train(blob_scene, settings(2), method="c3dgs", splats=plain, device="cpu")
    path = tmp_path / "a.packed"
    assert METHODS["c3dgs"].write(content, path, settings()) == path.stat().st_size
    camera = blob_scene.test_views[0].camera
    opened = open_scene(path, background=blob_scene.background)
    assert np.array_equal(render(opened, camera).image, render(content, camera).image)


def test_codebooks_of_a_small_scene_are_smaller(blob_scene: Scene, plain: SplatModel) -> None:
    scaled = settings(2, codebook=4096, codebook_share=0.1, threshold=1e6)
    assert len(tuned(blob_scene, plain, scaled).hooks.scales) == 8  # type: ignore[arg-type]
    assert settings_of("c3dgs", "scaled").c3dgs.codebook_share == 0.1  # type: ignore[attr-defined]


def test_damaged_content_is_refused(trainer: SplatTrainer, tmp_path: Path) -> None:
    whole = read(written(trainer, tmp_path / "a.packed"))

    def damaged(facts: dict[str, Any] | None = None, **arrays: np.ndarray) -> Packed:
        return Packed("c3dgs", {**whole.facts, **(facts or {})}, {**whole.arrays, **arrays})

    for facts, message in (
        ({"degree": 4}, "degree: expected 0 to 3"),
        ({"degree": 2}, "rest: expected uint8 of shape"),
        ({"center": [0, 0]}, "center: expected three numbers"),
        ({"dc.low": "x"}, "dc.low: expected a number"),
    ):
        with pytest.raises(SplatFileError, match=message):
            splats_of(damaged(facts))
    for name, change, message in (
        ("dc", lambda a: a[:1], "rest: expected uint8"),
        ("scales", lambda a: a[:1], "quaternions: expected uint8"),
        ("colors", lambda a: a + np.int32(1000), "colors: expected indices of"),
        ("shapes", lambda a: a - np.int32(1), "shapes: expected indices of .* found -1"),
        ("opacities", lambda a: a[1:], "opacities: expected uint8"),
        ("log_factors", lambda a: a.astype(np.float32), "log_factors: expected uint8"),
        ("means", lambda a: a[1:], "expected"),
    ):
        with pytest.raises(SplatFileError, match=message):
            splats_of(damaged(**{name: change(whole.arrays[name])}))
    path = tmp_path / "b.packed"
    for facts in ({"log_factors.low": 1e300}, {"dc.step": 1e300}, {"log_factors.low": 90}):
        write_packed(path, damaged(facts))
        with pytest.raises(SplatFileError, match="splats cannot be drawn"):
            open_scene(path)
