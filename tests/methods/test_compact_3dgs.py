"""Compact-3DGS: masks, color from a hash grid, residual codebooks."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compgs.methods import settings_of, train, write
from compgs.methods.compact_3dgs.hooks import Compact
from compgs.methods.compact_3dgs.tensors import color_coefficients, features, features_reference
from compgs.methods.compact_3dgs.tensors import contracted as contracted_tensors
from compgs.methods.parts.vector_quantization import residual_labels
from compgs.model.spherical_harmonics import COLOR_OFFSET
from compgs.model.spherical_harmonics_kernels import Y0
from compgs.opening import component_bytes, open_scene
from compgs.published.compact_3dgs.color_network import ColorNetwork, contracted, network_shapes
from compgs.published.compact_3dgs.hash_grid import GridLayout, grid_features
from compgs.render import Renderable, render
from compgs.scene.views import Scene
from compgs.training import SplatTrainer

from .quick import quick

SMALL = {"grid_levels": 4, "grid_bits": 6, "grid_growth": 2.0, "grid_base": 2, "mask_lr": 0.1}
LAYOUT = GridLayout(levels=4, features=2, base=2, growth=2.0, table_bits=6)
RNG = np.random.default_rng(0)


def small(**changed: Any) -> Any:
    sections = {name: values for name, values in changed.items() if isinstance(values, dict)}
    others = {name: value for name, value in changed.items() if name not in sections}
    return quick("compact-3dgs", compact={**SMALL, **others}, **sections)


@pytest.fixture(scope="module")
def trained(blob_scene: Scene) -> Any:
    return train(blob_scene, small(codes=16), method="compact-3dgs", device="cpu")


@pytest.fixture(scope="module")
def file(trained: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("compact") / "a.packed"
    assert write(trained, path, method="compact-3dgs") == path.stat().st_size
    return path


def trainer(scene: Scene, **changed: Any) -> tuple[SplatTrainer, Compact]:
    config = small(**changed)
    hooks = Compact(config, scene.extent, np.zeros(3))
    made = SplatTrainer(scene, config, torch.device("cpu"), hooks=hooks, method="compact-3dgs")
    made.begin()
    return made, hooks


# the file ----------------------------------------------------------------------------------------------------------


def test_a_splat_takes_17_bytes_with_six_stages_of_64_codes(blob_scene: Scene, tmp_path: Path) -> None:
    model, path = train(blob_scene, small(), method="compact-3dgs", device="cpu"), tmp_path / "a.packed"
    write(model, path, method="compact-3dgs")
    parts, count = component_bytes(path), len(model.packed.arrays["means"])
    splats = ("means", "opacities", "scales", "rotations")
    assert sum(parts[name] for name in splats) == 6 * count + 2 * count + 2 * -(-36 * count // 8)
    assert (parts["scale_codes"], parts["rotation_codes"]) == (6 * 64 * 3 * 4, 6 * 64 * 4 * 4)
    assert parts["grid"] == 2 * 2 * LAYOUT.total
    assert sum(parts.values()) == path.stat().st_size


def test_the_published_grid_takes_25_megabytes_and_its_network_16_kilobytes() -> None:
    published = GridLayout(levels=16, features=2, base=16, growth=1.447, table_bits=19)
    assert 2 * 2 * published.total == pytest.approx(25.2e6, rel=2e-3)
    assert published.width == 32
    stored = 2 * sum(rows * columns for rows, columns in network_shapes(32))
    assert stored == 2 * (48 * 64 + 64 * 64 + 64 * 3) <= 16_384


def test_what_is_opened_renders_what_was_trained(trained: Any, file: Path, blob_scene: Scene) -> None:
    again = open_scene(file, background=trained.background)
    assert isinstance(again, Renderable)
    camera = blob_scene.test_views[0].camera
    np.testing.assert_array_equal(render(again, camera).image, render(trained, camera).image)
    assert again.counts == {"splats": len(trained.packed.arrays["means"])}
    assert np.all(
        render(again.over((1.0, 0.0, 0.0)), camera).image[0, 0] >= render(again, camera).image[0, 0]
    )


def test_the_file_shows_what_the_training_drew(blob_scene: Scene) -> None:
    model: list[Any] = []

    def last(trainer: Any) -> None:
        if trainer.step == 40:
            with torch.no_grad():
                model.append((trainer.scene.train_views[0].camera, trainer.draw(0).rendered.image.numpy()))

    done = train(blob_scene, small(mask_every=1.0), method="compact-3dgs", device="cpu", watch=last)
    camera, image = model[-1]
    difference = np.abs(render(done, camera).image - image)
    assert difference.mean() < 2e-3, (
        "half precision of positions, opacities and the network is all that differs"
    )


@pytest.mark.slow
def test_a_run_that_was_stopped_continues_exactly(check_continues: Any) -> None:
    check_continues("compact-3dgs", small(codes=8, codes_start=0.4), (10, 30))


def test_sums_of_codes_below_zero_are_the_smallest_scale(file: Path, changed: Callable[..., Path]) -> None:
    codes = np.full((6, 16, 3), -1.0, np.float32)
    scales = open_scene(changed(file, {}, {"scale_codes": codes})).shapes.splats.log_scales
    np.testing.assert_allclose(np.exp(scales), 1e-6 * 4.4, rtol=1e-4)


def test_what_holds_no_lasting_splats_is_neither_exported_nor_compressed(
    file: Path, check_not_converted: Callable[[Path], None]
) -> None:
    check_not_converted(file)


@pytest.mark.parametrize(
    ("facts", "arrays", "message"),
    [
        ({"grid_levels": 33}, {}, "grid_levels: expected 1 to 32, found 33"),
        ({"grid_levels": 3}, {}, r"weights\.0: expected float16 of shape \(22, 64\)"),
        ({"grid_bits": 7}, {}, "grid: expected float16 of shape"),
        ({"grid_growth": 4.1}, {}, "grid_growth: expected"),
        ({"grid_levels": 32, "grid_growth": 4.0}, {}, "grid_growth: expected at most 16384 cells"),
        ({"unit": 0}, {}, "unit: expected above 0, found 0"),
        ({"middle": [0, "x", 1]}, {}, "middle: expected three numbers"),
        ({}, {"means": np.zeros((0, 3), np.float16)}, "holds no splats"),
        ({}, {"means": np.full((1, 3), np.inf, np.float16)}, "scales: expected uint8 of shape"),
        (
            {},
            {"grid": np.full((LAYOUT.total, 2), np.nan, np.float16)},
            "grid: hold what is not a finite number",
        ),
        ({}, {"scale_codes": np.zeros((17, 16, 3), np.float32)}, "scale_codes: found 17 stages of 16 codes"),
        (
            {},
            {"rotation_codes": np.zeros((6, 16, 4), np.float32)},
            "without a rotation .their quaternion is zero",
        ),
        ({}, {"scale_codes": np.zeros((6, 9, 3), np.float32)}, "scales: expected indices of 9 entries"),
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


# the color network -------------------------------------------------------------------------------------------------


def test_levels_share_entries_only_where_a_table_is_too_small() -> None:
    assert LAYOUT.cells.tolist() == [2, 4, 8, 16]
    assert LAYOUT.entries.tolist() == [27, 64, 64, 64] and LAYOUT.total == 219
    assert LAYOUT.offsets.tolist() == [0, 27, 91, 155]


def test_a_coarse_level_is_trilinear_interpolation_of_its_nodes() -> None:
    layout = GridLayout(levels=1, features=1, base=2, growth=1.0, table_bits=5)
    nodes = RNG.normal(size=(3, 3, 3)).astype(np.float32)  # z, y, x
    place = np.array([[0.75, 0.125, 0.5], [1.0, 1.0, 1.0]], np.float32)
    found = grid_features(place, nodes.reshape(-1, 1), layout)
    row = nodes[1]  # z = 0.5 is the middle node
    expected = 0.5 * (0.75 * row[0, 1] + 0.25 * row[1, 1]) + 0.5 * (0.75 * row[0, 2] + 0.25 * row[1, 2])
    np.testing.assert_allclose(found[:, 0], [expected, nodes[2, 2, 2]], rtol=1e-5)


def test_kernels_and_plain_torch_agree_on_features_and_gradients() -> None:
    places = torch.from_numpy(RNG.uniform(0, 1, (50, 3)).astype(np.float32))
    weight = torch.from_numpy(RNG.normal(size=(50, 8)).astype(np.float32))
    found = []
    for compute in (features, features_reference):
        grid = torch.from_numpy(np.random.default_rng(1).normal(size=(219, 2)).astype(np.float32))
        grid.requires_grad_()
        values = compute(places, grid, LAYOUT)
        (values * weight).sum().backward()
        found.append((values.detach(), grid.grad))
    torch.testing.assert_close(*(values for values, _ in found))
    torch.testing.assert_close(*(gradient for _, gradient in found))
    assert found[0][1].abs().sum() > 0


def test_plain_torch_copies_nothing_to_the_device_after_its_first_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    places, grid = torch.rand(5, 3), torch.rand(219, 2)
    features_reference(places, grid, LAYOUT)
    monkeypatch.setattr(torch, "tensor", None)
    assert features_reference(places, grid, LAYOUT).shape == (5, 8)


def test_the_opened_network_gives_the_colors_of_the_trained_one() -> None:
    grid = RNG.normal(size=(219, 2)).astype(np.float32)
    weights = [RNG.normal(size=shape).astype(np.float32) / 5 for shape in network_shapes(8)]
    means, center = RNG.normal(0, 3, (40, 3)).astype(np.float32), np.array([1.0, 2.0, 9.0])
    middle = np.array([0.5, 0.0, -0.5], np.float32)
    colors = ColorNetwork(LAYOUT, grid, tuple(weights), middle, 2.0).colors(means, center)
    tensors = (torch.from_numpy(a) for a in (means, center.astype(np.float32), grid))
    dc = color_coefficients(
        *tensors, [torch.from_numpy(w) for w in weights], LAYOUT, torch.from_numpy(middle), 2.0
    )
    np.testing.assert_allclose(colors, (COLOR_OFFSET + Y0 * dc).clamp_min(0), rtol=1e-4, atol=1e-4)
    other = ColorNetwork(LAYOUT, grid, tuple(weights), middle, 2.0).colors(means, -center)
    assert np.abs(other - colors).max() > 0.01, "color depends on the direction of view"


def test_the_unit_ball_is_half_of_the_cube_and_infinity_is_its_side() -> None:
    points = np.array([[0, 0, 0], [0.5, 0, 0], [0, -1, 0], [0, 0, 2], [1e9, 0, 0]], np.float32)
    expected = [[0.5] * 3, [0.625, 0.5, 0.5], [0.5, 0.25, 0.5], [0.5, 0.5, 0.875], [1.0, 0.5, 0.5]]
    np.testing.assert_allclose(contracted(points), expected, atol=1e-6)
    np.testing.assert_allclose(contracted_tensors(torch.from_numpy(points)), expected, atol=1e-6)


# training ----------------------------------------------------------------------------------------------------------


def test_a_mask_hides_its_splat_and_has_the_gradient_of_scale_and_opacity(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene)
    with torch.no_grad():
        hooks.masks[:2] = torch.tensor([-4.59, -4.6])  # sigmoid: just above, just below 0.01
    drawn = hooks.masked(made.parameters.splats())
    opacities = drawn.opacity_logits.sigmoid()
    raw = made.parameters.splats()
    torch.testing.assert_close(opacities[0], raw.opacity_logits[0].sigmoid())
    assert opacities[1] < 1 / 255
    torch.testing.assert_close(drawn.log_scales, raw.log_scales)
    # By the product rule: mask x opacity and mask x scale, at a mask of 1.
    (opacities[0] + 2 * drawn.log_scales[0].exp().sum()).backward()
    smooth = hooks.masks[0].detach().sigmoid()
    by_mask = raw.opacity_logits[0].sigmoid() + 2 * raw.log_scales[0].exp().sum()
    torch.testing.assert_close(hooks.masks.grad[0], smooth * (1 - smooth) * by_mask.detach())


def test_the_number_of_splats_falls_with_the_weight_of_the_masks(blob_scene: Scene) -> None:
    counts = []
    for weight in (0.0, 0.02, 1.0):
        config = small(mask_weight=weight, mask_lr=0.3, mask_every=0.1)
        counts.append(
            len(train(blob_scene, config, method="compact-3dgs", device="cpu").packed.arrays["means"])
        )
    assert counts[0] > counts[1] > counts[2], counts


def test_hidden_splats_are_removed_with_all_that_is_theirs(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene)
    with torch.no_grad():
        hooks.masks[::3] = -6.0
    kept = made.parameters.means.detach()[hooks.masks > 0]
    hooks.remove_hidden(made)
    assert len(made.parameters) == len(hooks.masks) == len(kept) == 100
    assert torch.equal(made.parameters.means.detach(), kept)
    with torch.no_grad():
        hooks.masks.fill_(-6.0)
    hooks.remove_hidden(made)
    assert len(made.parameters) == 100, "a scene of nothing is nobody's wish"


def test_hidden_splats_go_when_density_is_controlled_and_now_and_then_after_it(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene, mask_every=0.1, splats={"densify_stop": 0.5})

    def hide() -> int:
        with torch.no_grad():
            hooks.masks[:5] = -6.0
        return int((hooks.masks > -4.5).sum())

    shown = hide()
    hooks.densified(made)
    assert len(made.parameters) == shown
    left = []
    for step in (16, 17, 20, 21, 24):  # growth ends with step 20; then each fourth
        made.step, shown = step, hide()
        hooks.after_step(made)
        left.append(len(made.parameters) == shown)
    assert left == [False, False, True, False, True]


def test_codes_learn_from_what_they_miss(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene, codes=4, code_stages=1)
    hooks.begin_codes(made)
    drawn = made.draw(0)
    assert hooks.error is not None
    added = hooks.loss(drawn, made)
    assert added.item() == pytest.approx(5e-4 * hooks.masks.sigmoid().mean().item() + hooks.error.item())
    added.backward()
    vectors = made.parameters.log_scales.detach().exp()
    labels = residual_labels(vectors, hooks.scale_codes.detach())[:, 0]
    by_hand = torch.zeros(4, 3).index_add_(0, labels, hooks.scale_codes.detach()[0][labels] - vectors)
    torch.testing.assert_close(hooks.scale_codes.grad[0], 2 * by_hand / vectors.numel())
    assert made.parameters.log_scales.grad is None, "what they stand for does not come to meet them"


def test_settings_are_those_of_the_release() -> None:
    config = settings_of("compact-3dgs")
    c = config.compact
    assert (c.mask_weight, c.mask_lr, c.mask_threshold, round(30_000 * c.mask_every)) == (
        5e-4,
        0.01,
        0.01,
        1_000,
    )
    assert [round(30_000 * at) for at in (*c.color_lr_falls, c.codes_start)] == [
        5_000,
        15_000,
        25_000,
        29_000,
    ]
    assert (c.grid_bits, c.code_stages, c.codes, config.splats.harmonics) == (19, 6, 64, 0)
    assert settings_of("compact-3dgs", "scaled").compact.grid_bits == 11


def test_colors_learn_by_thirds(blob_scene: Scene) -> None:
    made, hooks = trainer(blob_scene)
    seen = []
    for step in (0, 7, 20, 34):
        made.step = step
        hooks.view(blob_scene.train_views[0].camera, made.views.photograph(0), made)
        rates = {group["name"]: group["rates"][0] for group in made.optimizer.param_groups}
        assert rates["hooks/grid"] == rates["hooks/weights_0"]
        seen.append(rates["hooks/grid"])
    assert seen == pytest.approx([0.01, 0.0033, 0.001089, 0.00035937])
    four, hooks = trainer(blob_scene, training={"views_per_step": 4})
    hooks.view(blob_scene.train_views[0].camera, four.views.photograph(0), four)
    rates = {group["name"]: group["rates"][0] for group in four.optimizer.param_groups}
    assert rates["hooks/grid"] == pytest.approx(0.02), "as those of all other parameters"


def test_codebooks_begin_late_and_what_they_miss_shrinks(blob_scene: Scene) -> None:
    made, hooks = trainer(
        blob_scene, codes=4, code_stages=2, codes_start=0.25, codes_lr=0.01, splats={"densify_stop": 0.0}
    )
    errors = []
    while made.step < 40:
        made.train_step()
        assert hooks.coded == (made.step >= 10)
        if hooks.error is not None:
            errors.append(float(hooks.error.detach()))
    drawn = made.as_drawn()
    assert len(drawn.quaternions.unique(dim=0)) <= 16 and len(drawn.log_scales.unique(dim=0)) <= 16
    assert min(errors[1:]) < errors[0]
