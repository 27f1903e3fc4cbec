"""EAGLES: integers with linear decoders, coarse images first, pruning by influence."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compgs.formats.packed import Packed
from compgs.methods import settings_of, train, write
from compgs.methods.eagles.hooks import Latents, image_scale
from compgs.methods.parts.significance import view_significance
from compgs.opening import component_bytes, open_scene
from compgs.published.eagles import cosines, decoded
from compgs.published.parts.histogram import packed_symbols, unpacked_symbols
from compgs.render import render
from compgs.scene.views import Scene
from compgs.training import SplatTrainer

from .quick import quick


@pytest.fixture(scope="module")
def trained(blob_scene: Scene) -> Any:
    return train(blob_scene, quick("eagles"), method="eagles", device="cpu")


@pytest.fixture(scope="module")
def file(trained: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("eagles") / "a.packed"
    assert write(trained, path, method="eagles") == path.stat().st_size
    return path


def trainer(scene: Scene, **sections: Any) -> tuple[SplatTrainer, Latents]:
    config = quick("eagles", **sections)
    hooks = Latents(config)
    made = SplatTrainer(scene, config, torch.device("cpu"), hooks=hooks, method="eagles")
    made.begin()
    return made, hooks


def entropy_bytes(symbols: np.ndarray) -> float:
    counts = np.unique(symbols, return_counts=True)[1]
    return float((counts * np.log2(counts.sum() / counts)).sum() / 8)


def test_the_file_is_36_bytes_a_splat_and_the_entropy_of_the_latents(trained: Any, file: Path) -> None:
    parts, count = component_bytes(file), len(trained.packed.arrays["means"])
    assert parts["means"] + parts["dc"] + parts["log_scales"] == 36 * count
    assert sum(parts.values()) == file.stat().st_size
    lengths = {"harmonics": 16, "rotation": 8, "opacity": 1}
    for name, length in lengths.items():
        latents = unpacked_symbols(trained.packed, name, count * length)
        ideal = entropy_bytes(latents)
        assert ideal <= parts[f"{name}.symbols"] + 1 <= 1.02 * ideal + 16, name
        assert parts[f"{name}.levels"] == min(np.ptp(latents) + 1, 1024) + 1
    decoders = {name: parts[f"{name}.decoder"] for name in lengths}
    assert decoders == {"harmonics": 4 * 45, "rotation": 4 * 8 * 4, "opacity": 4}


def test_what_is_opened_renders_what_was_trained(trained: Any, file: Path, blob_scene: Scene) -> None:
    again = open_scene(file, background=trained.background)
    camera = blob_scene.test_views[0].camera
    np.testing.assert_array_equal(render(again, camera).image, render(trained, camera).image)
    assert again.counts == {"splats": len(trained.packed.arrays["means"])}


def test_the_file_holds_what_was_drawn(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene)
    with torch.no_grad():
        hooks.harmonics_latents.normal_(0, 3)
    for _ in range(20):
        made.train_step()
    drawn = made.as_drawn()
    raw = (t.numpy() for t in (drawn.means, drawn.log_scales, drawn.dc))
    arrays = decoded(*raw, codes=hooks.codes(), world_offset=(0.0, 0.0, 0.0))
    for name, value in vars(drawn).items():
        np.testing.assert_allclose(getattr(arrays, name), value.numpy(), atol=1e-5, err_msg=name)
        np.testing.assert_array_equal(value, getattr(made.parameters, name).detach(), err_msg=name)
    assert drawn.rest.abs().max() > 1e-3


@pytest.mark.slow
def test_a_run_that_was_stopped_continues_exactly(check_continues: Any) -> None:
    check_continues("eagles", quick("eagles"), (10, 20))


def test_splats_without_harmonics_have_no_latents_of_them(blob_scene: Scene, tmp_path: Path) -> None:
    config = quick("eagles", steps=4, splats={"harmonics": 0})
    model, path = train(blob_scene, config, method="eagles", device="cpu"), tmp_path / "a.packed"
    write(model, path, method="eagles", config=config)
    assert "harmonics.decoder" not in model.packed.arrays and open_scene(path).splats.degree == 0


def test_the_cosine_transform_is_orthonormal_and_ends_where_the_numbers_do() -> None:
    np.testing.assert_allclose(cosines(16, 45) @ cosines(16, 45).T, np.eye(16), atol=1e-6)
    square = cosines(12, 9)
    np.testing.assert_allclose(square @ square.T, np.diag([1.0] * 9 + [0.0] * 3), atol=1e-6)
    by_hand = [math.sqrt(2 / 3) * math.cos(math.pi * (2 * j + 1) / 6) for j in range(3)]
    np.testing.assert_allclose(cosines(2, 3)[1], by_hand, atol=1e-6)


def test_latents_are_drawn_rounded_with_the_gradient_of_real_numbers(blob_scene: Scene) -> None:
    _, hooks = trainer(blob_scene)
    weight = hooks.opacity_decoder.detach().item()
    with torch.no_grad():
        hooks.opacity_latents.fill_(1.4)
    logits = hooks.decode()["opacity_logits"]
    assert logits.detach().unique().tolist() == [weight]
    logits.sum().backward()
    assert hooks.opacity_latents.grad.unique().tolist() == [weight]
    assert hooks.opacity_decoder.grad.item() == len(logits)


def test_latents_begin_as_what_the_points_give(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene)
    drawn, raw = made.as_drawn(), made.parameters.trained()
    assert torch.equal(drawn.rest, raw.rest) and not drawn.rest.any()
    turned = torch.nn.functional.normalize(drawn.quaternions, dim=1)
    assert (turned[:, 0] > 0.99).all()
    half = 0.5 * float(hooks.opacity_decoder.detach())
    assert (drawn.opacity_logits - raw.opacity_logits).abs().max() <= half + 1e-6


def test_latents_learn_slower_the_larger_their_decoder_but_for_opacities(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene)
    hooks.view(blob_scene.train_views[0].camera, made.views.photograph(0), made)
    groups = {group["name"]: group["rates"][0] for group in made.optimizer.param_groups}
    with torch.no_grad():
        for name in ("harmonics", "rotation", "opacity"):
            getattr(hooks, f"{name}_decoder").mul_(4)
    hooks.view(blob_scene.train_views[0].camera, made.views.photograph(0), made)
    later = {group["name"]: group["rates"][0] for group in made.optimizer.param_groups}
    for name, divided in (("harmonics", 4), ("rotation", 4), ("opacity", 1)):
        assert groups[f"hooks/{name}_latents"] == pytest.approx(divided * later[f"hooks/{name}_latents"])
    assert later["hooks/opacity_latents"] == pytest.approx(0.1 * 0.05)
    size = float(torch.linalg.norm(hooks.rotation_decoder.detach()))
    assert later["hooks/rotation_latents"] == pytest.approx(0.1 * 1e-3 / size)
    # Steps of four views are twice as long, as those of all other parameters.
    four, hooks = trainer(blob_scene, training={"views_per_step": 4})
    hooks.view(blob_scene.train_views[0].camera, four.views.photograph(0), four)
    rates = {group["name"]: group["rates"][0] for group in four.optimizer.param_groups}
    assert rates["hooks/opacity_latents"] == pytest.approx(2 * 0.1 * 0.05)


def test_images_grow_from_coarse_to_fine(blob_scene: Scene) -> None:
    assert image_scale(0.0, 0.3, 0.7) == pytest.approx(0.3)
    assert image_scale(0.35, 0.3, 0.7) == pytest.approx(0.65)
    assert image_scale(0.7, 0.3, 0.7) == image_scale(1.0, 0.3, 0.7) == image_scale(0.0, 0.3, 0.0) == 1.0
    made, _ = trainer(blob_scene)
    view = blob_scene.train_views[0]
    drawn = made.draw(0)
    assert (drawn.camera.width, drawn.camera.height) == (14, 11)
    assert drawn.camera.fx == pytest.approx(view.camera.fx * 14 / 48)
    assert drawn.photograph.image.shape == (11, 14, 3) == drawn.rendered.image.shape
    made.step = 28
    assert made.draw(0).camera.width == 48


def test_what_the_views_see_least_of_is_pruned(blob_scene: Scene) -> None:
    share = {"prune_share": 0.4, "prune_every": 0.5, "prune_until": 0.6}
    made, hooks = trainer(blob_scene, eagles=share, splats={"densify_stop": 0.0})
    assert hooks.prune_at == {20}
    while made.step < 19:
        made.train_step()
    cameras = [view.camera for view in blob_scene.train_views]
    before = view_significance(made.as_drawn(), cameras, made.settings)
    assert len(before) == 150
    kept = hooks.influential(made)
    assert int(kept.sum()) == 90 and before[kept].min() >= before[~kept].max()
    made.train_step()
    assert len(made.parameters) == len(hooks.rotation_latents) == 90


def test_opacities_that_are_reset_are_those_of_the_latents(
    blob_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, hooks = trainer(blob_scene)
    made.train_step()
    moment = "exp_avg"
    assert made.optimizer.state[hooks.opacity_latents][moment].any()
    made.parameters.opacity_logits.data.fill_(-4.6)
    hooks.after_step(made)
    assert (made.as_drawn().opacity_logits > -4).all(), "only what the schedule resets is taken over"
    made.parameters.opacity_logits.data.fill_(-4.6)
    monkeypatch.setattr(type(made.schedule), "reset_due", lambda schedule, step: step == made.step)
    hooks.after_step(made)
    assert made.as_drawn().opacity_logits.sub(-4.6).abs().max() <= 0.5 * hooks.opacity_decoder.abs().item()
    assert not made.optimizer.state[hooks.opacity_latents][moment].any(), "and they begin anew"


def test_latents_of_zero_are_no_rotation(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene)
    with torch.no_grad():
        hooks.rotation_latents[3:5] = 0.4
    drawn = made.as_drawn()
    assert drawn.quaternions[3].tolist() == [1.0, 0.0, 0.0, 0.0]
    raw = (t.numpy() for t in (drawn.means, drawn.log_scales, drawn.dc))
    arrays = decoded(*raw, codes=hooks.codes(), world_offset=(0.0, 0.0, 0.0))
    assert arrays.quaternions[4].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_settings_are_those_of_the_release() -> None:
    config = settings_of("eagles")
    s, e = config.splats, config.eagles
    steps = [round(30_000 * x) for x in (s.densify_every, s.densify_stop, s.reset_every)]
    assert steps == [125, 18_000, 2_500]
    published = quick("eagles", steps=30_000)
    assert Latents(published).prune_at == {5_100, 10_200, 15_300, 20_400, 25_500}
    assert (e.harmonics_latents, e.rotation_latents, e.prune_share, e.latent_lr) == (16, 8, 0.15, 0.1)


def test_more_pruning_leaves_fewer_splats_and_a_smaller_file(
    blob_scene: Scene, trained: Any, file: Path, tmp_path: Path
) -> None:
    config = quick("eagles", eagles={"prune_share": 0.5})
    pruned = train(blob_scene, config, method="eagles", device="cpu")
    fewer, more = (len(model.packed.arrays["means"]) for model in (pruned, trained))
    assert fewer < 0.7 * more
    assert write(pruned, tmp_path / "b", method="eagles", config=config) < 0.8 * file.stat().st_size


def test_the_size_is_known_while_training(blob_scene: Scene, tmp_path: Path) -> None:
    seen: list[Any] = []
    config = quick("eagles")
    model = train(blob_scene, config, method="eagles", device="cpu", progress=seen.append)
    written = write(model, tmp_path / "a", method="eagles", config=config)
    made, _ = trainer(blob_scene)
    assert made.estimated_bytes() >= 36 * 150
    assert seen and written == pytest.approx(model.packed.arrays["means"].size * 12, rel=1.0)


@pytest.mark.parametrize("count", [1, 5, 4000])
def test_symbols_of_one_histogram_come_back(count: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    symbols = np.rint(rng.normal(3, 40, count)).astype(np.int32)
    symbols[-1] = 90_000  # far outside of any table
    packed = Packed("eagles", {}, packed_symbols("x", symbols), tmp_path / "a")
    np.testing.assert_array_equal(unpacked_symbols(packed, "x", count), symbols)


@pytest.mark.parametrize(
    ("facts", "arrays", "message"),
    [
        ({"degree": 4}, {}, "degree: expected 0 to 3, found 4"),
        ({"degree": 2}, {}, r"harmonics\.decoder: expected float32 of shape \(24\)"),
        ({"rotation_latents": 0}, {}, "rotation_latents: expected 1 to 64, found 0"),
        ({"rotation_latents": 7}, {}, r"rotation\.decoder: expected float32 of shape \(7, 4\)"),
        ({"offset": [0, 1]}, {}, "offset: expected three numbers"),
        ({}, {"opacity.levels": np.zeros(1, np.uint8)}, "opacity: expected a histogram"),
        ({}, {"opacity.levels": np.full(4, 128, np.uint8)}, "opacity: expected a histogram"),
        ({}, {"opacity.lowest": np.array([1 << 20], np.int32)}, "opacity: expected a histogram"),
        ({}, {"opacity.symbols": np.arange(40, dtype=np.uint8)}, "opacity"),
        ({}, {"rotation.symbols": np.zeros(0, np.uint8)}, "rotation"),
        ({}, {"dc": np.zeros((2, 3), np.float32)}, "dc: expected float32 of shape"),
        (
            {},
            {"rotation.decoder": np.full((8, 4), np.nan, np.float32)},
            "without a rotation .not a finite number",
        ),
    ],
)
def test_damaged_files_are_refused(
    facts: dict[str, Any],
    arrays: dict[str, np.ndarray],
    message: str,
    file: Path,
    check_refused: Callable[..., None],
) -> None:
    check_refused(file, facts, arrays, message)
