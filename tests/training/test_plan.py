"""What a run decides: every rule holds somewhere and not everywhere, and cheaper bits never give a smaller model."""

import ast
import itertools
import json
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

import compgs
from compgs.config import Config, load_config
from compgs.errors import ConfigError
from compgs.losses import rate
from compgs.scene.views import Scene
from compgs.training.plan import (
    RULES,
    Plan,
    Start,
    active_rules,
    expected_bytes,
    grid_spacings,
    growth_factor,
    head_bits,
    lambda_for,
    plan,
)
from compgs.training.start import plan_for, start_of

DOCS = Path(__file__).parents[2] / "docs"
LAMBDAS = [0.0, *(10 ** (n / 8) for n in range(-64, 9))]
ROOT = Path(__file__).parents[2]
USUAL = Start(5000, 80, 60.0, 30.0, 0.002, 86_400, "cpu")
STARTS = [
    replace(
        USUAL,
        anchors=anchors,
        findable=findable,
        sightings=sightings,
        passes=passes,
        lmbda=lmbda,
        pixels=pixels,
        device=device,
    )
    for anchors, findable in ((300, 0), (5000, 0), (5000, 15_000), (500_000, 300_000))
    for sightings in (5.0, 16.0, 17.0, 150.0)
    for passes in (10.0, 44.9, 45.0)
    for lmbda in LAMBDAS[::6]
    for pixels, device in ((86_400, "cpu"), (1_000_000, "cuda"))
]


def asked(**training: object) -> Config:
    return replace(Config(), training=replace(Config().training, **training))  # type: ignore[arg-type]


def capacity(found: Plan) -> tuple[int, ...]:
    """What must not fall when bits become cheaper."""
    context = ("none", "neighbours").index(found.reference_context)
    heads = ("shallow", "paired", "separate").index(found.heads)
    return (found.coupled_primitives, found.width, found.residuals, context, heads, found.head_bits)


def test_a_long_run_of_a_large_capture_counts_the_rate_half_as_often() -> None:
    large = replace(USUAL, anchors=100_000, passes=25.0)
    assert plan(Config(), large).rate_every == 8
    shorter, smaller = replace(large, passes=24.9), replace(large, anchors=19_999)
    for other in (shorter, smaller, replace(large, sightings=11.0), replace(large, points_at_hand=True)):
        assert plan(Config(), other).rate_every == 4


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_rule_sets_a_value_of_the_plan_and_says_when_and_where_it_was_measured(rule) -> None:
    assert rule.sets in {each.name for each in fields(Plan)}
    assert rule.when and (DOCS / rule.evidence).is_file()
    held = {rule.holds(start) for start in (*STARTS, replace(USUAL, poses_in_doubt=True))}
    always = rule.when.startswith("always")
    assert held == ({True} if always else {True, False})


def test_every_rule_is_among_the_decisions_that_were_kept() -> None:
    kept = (DOCS / "results" / "decisions.md").read_text(encoding="utf-8").split("## Not kept")[0]
    assert [rule.name for rule in RULES if f"`{rule.name}`" not in kept] == []


def test_no_two_rules_have_a_name() -> None:
    assert len({rule.name for rule in RULES}) == len(RULES)


def test_a_model_never_becomes_smaller_when_bits_become_cheaper() -> None:
    for start in {replace(start, lmbda=0.0) for start in STARTS}:
        found = [plan(Config(), replace(start, lmbda=lmbda)) for lmbda in reversed(LAMBDAS)]
        for dearer, cheaper in itertools.pairwise(found):
            assert all(a <= b for a, b in zip(capacity(dearer), capacity(cheaper), strict=True)), cheaper
            assert dearer.dilation >= cheaper.dilation


@pytest.mark.parametrize("anchors", [200, 2_000, 6_000, 50_000, 1_000_000])
@pytest.mark.parametrize(("sightings", "passes"), [(9.0, 100.0), (60.0, 100.0), (60.0, 20.0)])
def test_a_larger_size_never_gives_a_smaller_model(anchors: int, sightings: float, passes: float) -> None:
    sizes = sorted({int(1000 * 1.05**n) + extra for n in range(280) for extra in (0, 1)})
    start = replace(USUAL, anchors=anchors, sightings=sightings, passes=passes)
    found = [
        plan(
            asked(target_bytes=size),
            replace(start, lmbda=lambda_for(size / anchors, dense=start.dense)),
        )
        for size in sizes
    ]
    for smaller, larger in itertools.pairwise(found):
        assert all(a <= b for a, b in zip(capacity(smaller), capacity(larger), strict=True)), larger
        assert smaller.dilation >= larger.dilation


def test_a_size_amounts_to_the_lambda_that_makes_such_files() -> None:
    """Plush at 240 pixels (6 423 anchors), 1 500 steps: docs/results/ablation_curve_plush_480.md."""
    for lmbda, size in ((1e-4, 121_157), (1e-3, 47_158), (5e-3, 13_145), (1e-2, 6_015)):
        assert 1 / 5 < lambda_for(size / 6423) / lmbda < 5
        expected = expected_bytes(replace(USUAL, anchors=6423, lmbda=lmbda))
        assert expected is not None and 1 / 3 < expected / size < 3
    for record in (
        "truck_adjusted",
        "truck_adjusted_1e-3",
        "truck_adjusted_whole",
        "truck_adjusted_shallow",
        "truck_adjusted_two_looks",
        "truck_adjusted_rate8",
        "truck_adjusted_1e-2",
        "truck_adjusted_4e-3",
        "truck_adjusted_4e-4",
        "truck_adjusted_30000",
        "bonsai_default",
        "bonsai_rate8",
        "bonsai_1e-2",
        "bonsai_4e-3",
    ):
        run = json.loads((ROOT / f"docs/results/records/{record}.json").read_text(encoding="utf-8"))
        shown = {"truck": 145_565, "bonsai": 130_000}[record.partition("_")[0]]  # points: not counted then
        expected = expected_bytes(replace(Start(**run["plan"]["start"]), findable=shown))
        assert expected is not None and 1 / 1.8 < expected / run["results"]["bytes"] < 1.8
        lmbda = lambda_for(run["results"]["bytes"] / run["plan"]["start"]["anchors"], dense=True)
        assert 1 / 4 < lmbda / run["plan"]["start"]["lmbda"] < 4
    assert expected_bytes(replace(USUAL, anchors=250_001)) is None
    assert expected_bytes(replace(USUAL, lmbda=0.0)) is None


@pytest.mark.parametrize(
    ("start", "field", "value"),
    [
        ({"sightings": 16.0, "lmbda": 1e-4}, "coupled_primitives", 10),
        ({"sightings": 17.0, "lmbda": 1e-4}, "coupled_primitives", 5),
        ({"anchors": 20_000}, "coupled_primitives", 3),
        ({"anchors": 20_000}, "voxel_spacings", 0.7),
        ({"anchors": 20_000}, "dense_points", 8.0),
        ({"anchors": 20_000, "sightings": 12.0}, "dense_points", 8.0),
        ({"anchors": 20_000, "sightings": 11.0}, "dense_points", 0.0),
        ({"anchors": 20_000, "sightings": 12.0, "lmbda": 1e-4}, "coupled_primitives", 3),
        ({"anchors": 20_000, "sightings": 12.0, "lmbda": 1e-3}, "residuals", False),
        ({"anchors": 20_000, "sightings": 12.0}, "dilation", 0.02),
        ({"findable": 15_000}, "dense_points", 8.0),
        ({"findable": 15_000}, "heads", "shallow"),
        ({"findable": 14_999}, "dense_points", 0.0),
        ({"findable": 15_000, "sightings": 11.0}, "dense_points", 0.0),
        ({"findable": 15_000, "points_at_hand": True}, "dense_points", 0.0),
        ({"findable": 15_000, "points_at_hand": True}, "head_bits", 7),
        ({"anchors": 20_000, "points_at_hand": True}, "voxel_spacings", 1.5),
        ({"anchors": 20_000, "points_at_hand": True}, "coupled_primitives", 5),
        ({"anchors": 20_000, "points_at_hand": True}, "dense_points", 0.0),
        ({"anchors": 19_999}, "coupled_primitives", 5),
        ({"sightings": 9.0, "lmbda": 1e-3}, "residuals", True),
        ({"sightings": 9.0, "lmbda": 2e-3}, "residuals", False),
        ({"lmbda": 1e-5, "passes": 45.0}, "residuals", False),
        ({"sightings": 9.0, "lmbda": 1e-5, "passes": 100.0}, "heads", "paired"),
        ({"anchors": 20_000}, "heads", "shallow"),
        ({"anchors": 20_000, "points_at_hand": True}, "heads", "paired"),
        ({"lmbda": 0.001, "anchors": 3_400}, "width", 32),
        ({"lmbda": 0.001, "anchors": 3_333}, "width", 16),
        ({"lmbda": 0.001, "anchors": 3_333, "findable": 20_000}, "width", 32),
        ({"lmbda": 0.01, "anchors": 6_000}, "width", 8),
        ({"lmbda": 0.003, "anchors": 6_000}, "reference_context", "neighbours"),
        ({"lmbda": 0.005, "anchors": 6_000}, "reference_context", "none"),
        ({"sightings": 17.0, "lmbda": 0.002}, "dilation", 0.02),
        ({"sightings": 16.0, "lmbda": 0.002}, "dilation", 0.3),
        ({"lmbda": 0.0021}, "dilation", 0.3),
        ({"lmbda": 0.0021, "anchors": 20_000}, "dilation", 0.02),
        ({"lmbda": 0.0021, "anchors": 20_000, "points_at_hand": True}, "dilation", 0.3),
        ({"sightings": 11.0}, "dropout", 0.2),
        ({"sightings": 22.0}, "dropout", 0.0),
        ({"sightings": 11.0}, "bit_discount", 0.5),
        ({"processes": 2}, "passed_over", 0.0),
        ({"pixels": 160_000}, "coarse_until", 0.4),
        ({"pixels": 159_999}, "coarse_until", 0.0),
        ({"views": 60}, "pruning_views", 48),
        ({"views": 300}, "pruning_views", 150),
        ({"views": 3000}, "pruning_views", 256),
    ],
)
def test_the_default_decides(start: dict[str, float], field: str, value: object) -> None:
    """Once a rule has gone, its lines go."""
    found = getattr(plan(Config(), replace(USUAL, **start)), field)  # type: ignore[arg-type]
    assert found == (pytest.approx(value) if isinstance(value, float) else value)


def test_photographs_of_other_places_do_not_make_few_views_many() -> None:
    few = plan(Config(), replace(USUAL, views=15, sightings=5.0))
    more = plan(Config(), replace(USUAL, views=300, sightings=5.0))
    assert few.dropout == more.dropout > 0 and few.dilation == more.dilation


def test_the_paper_preset_applies_no_rule() -> None:
    paper = load_config("paper")
    assert active_rules(paper) == ()
    for start in STARTS:
        found = plan(paper, start)
        assert (found.coupled_primitives, found.width, found.heads) == (10, 32, "separate")
        assert found.residuals and found.reference_context == "hyperprior" and found.head_bits == 8
        assert (found.dilation, found.voxel_spacings, found.dropout, found.rate_every) == (0.3, 1.0, 0, 1)
        assert not (found.passed_over or found.coarse_until or found.reasons)
    assert growth_factor(paper, 0.1) == 1.0 and grid_spacings(paper) == 1.0


def test_the_plan_of_a_run_with_former_decisions_is_read() -> None:
    found = plan(Config(), USUAL)
    older = found.to_dict() | {"sampled_gradients": 0.1}
    assert Plan.from_dict(older) == found


def test_a_rule_that_is_left_out_by_name_decides_nothing() -> None:
    config = asked(rules="all but width_16, width_8")
    assert {rule.name for rule in RULES} - {rule.name for rule in active_rules(config)} == {
        "width_16",
        "width_8",
    }
    dear = replace(USUAL, lmbda=0.1)
    assert plan(config, dear).width == 32 and plan(Config(), dear).width == 8


@pytest.mark.parametrize("rules", ["some", "all but", "all but width_17", "none but width_16"])
def test_rules_that_do_not_exist_are_refused_by_name(rules: str) -> None:
    with pytest.raises(ConfigError, match="width_16"):
        plan(asked(rules=rules), USUAL)


def test_smaller_networks_that_were_asked_for_stay() -> None:
    config = replace(Config(), model=replace(Config().model, width=8))
    assert {plan(config, start).width for start in STARTS} == {8}


def test_a_hundred_times_the_anchors_at_a_hundred_times_the_lambda_have_the_same_networks() -> None:
    for lmbda in (1e-6, 1e-4, 1e-3, 5e-3, 1e-2, 3e-2, 0.1):
        small = plan(Config(), replace(USUAL, anchors=777, lmbda=lmbda))
        large = plan(Config(), replace(USUAL, anchors=77_700, lmbda=100 * lmbda))
        assert large.width == small.width


def test_the_networks_of_many_anchors_have_weights_of_more_bits() -> None:
    few, many = (plan(Config(), replace(USUAL, anchors=n, lmbda=1e-3)) for n in (19_999, 20_000))
    assert (few.head_bits, many.head_bits) == (7, 12)


def test_bits_of_weights_follow_the_price_as_it_is_now() -> None:
    found = [head_bits(Config(), USUAL, 1000 * price, 1000) for price in (1e-9, 2.9e-6, 3.1e-6, 1e-4)]
    assert found == [7, 7, 6, 6]
    pruned = replace(USUAL, findable=30_000)
    assert [head_bits(Config(), pruned, 1e-3, anchors) for anchors in (19_999, 20_000)] == [7, 12]


def test_the_price_is_what_a_bit_of_the_networks_adds_to_the_objective() -> None:
    """B bits shared by N anchors add as much as B / N more bits of each anchor would: it goes with lambda / N."""
    anchors, bits = 500, 1000.0
    stream = {"all": torch.full((anchors,), 20.0)}
    more = {"all": stream["all"] + bits / anchors}
    rates = [float(rate(b, {"all": 1}, "bits")) for b in (stream, more)]
    twice = {"all": torch.full((2 * anchors,), 20.0)}
    more_of_twice = {"all": twice["all"] + bits / (2 * anchors)}
    others = [float(rate(b, {"all": 1}, "bits")) for b in (twice, more_of_twice)]
    assert rates[1] - rates[0] == pytest.approx(2 * (others[1] - others[0]), rel=1e-3)


def test_a_plan_survives_json_and_says_itself() -> None:
    for start in STARTS[::7]:
        found = plan(Config(), start)
        assert Plan.from_dict(json.loads(json.dumps(found.to_dict()))) == found
        text = "\n".join(found.in_words())
        assert all(name in text and reason in text for name, reason in found.reasons.items())


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0},
        {"heads": "other"},
        {"residuals": 1},
        {"dropout": float("nan")},
        {"start": {}},
        {"start": None},
        {"reasons": 3},
        {"coupled_primitives": 65},
        {"more": 1},
    ],
)
def test_what_is_no_plan_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        Plan.from_dict({**plan(Config(), USUAL).to_dict(), **change})
    with pytest.raises(ValueError):
        Plan.from_dict([])


def test_a_start_counts_the_views_that_a_point_is_in(blob_scene: Scene, tiny_config: Config) -> None:
    """All eight cameras look at all blobs; two more that look away see none."""
    start = start_of(blob_scene, tiny_config, torch.device("cpu"), 100)
    assert (start.views, start.sightings, start.pixels) == (8, 8.0, 48 * 36)
    assert start.passes == 40 / 8
    away = [
        replace(view, camera=replace(view.camera, cx=view.camera.cx + 10_000))
        for view in blob_scene.train_views[:2]
    ]
    more = replace(blob_scene, train_views=(*blob_scene.train_views, *away))
    assert start_of(more, tiny_config, torch.device("cpu"), 100).sightings == 8.0


def test_a_size_is_a_lambda_to_the_rules(blob_scene: Scene, tiny_config: Config) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, target_bytes=50_000, lmbda=1.0))
    found = plan_for(blob_scene, config, torch.device("cpu"))
    assert found.start.lmbda == lambda_for(50_000 / found.start.anchors) < 0.1


def test_tiles_of_a_capture_have_one_plan_of_as_many_anchors_as_a_tile_has(
    blob_scene: Scene, tiny_config: Config
) -> None:
    whole, quarter = (plan_for(blob_scene, tiny_config, torch.device("cpu"), tiles) for tiles in (1, 4))
    assert quarter.start.anchors == round(whole.start.anchors / 4)
    assert (quarter.start.views, quarter.start.sightings) == (whole.start.views, whole.start.sightings)


def test_nothing_else_in_training_compares_lambda_bytes_views_or_passes_with_a_number() -> None:
    """But with 0 and 1: whether there is any, or more than one."""
    words, found = ("lmbda", "lambda", "bytes", "views", "passes", "fewness"), []
    for file in sorted((Path(compgs.__file__).parent / "training").rglob("*.py")):
        if file.name == "plan.py":
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Compare):
                continue
            sides = [node.left, *node.comparators]
            numbers = [s for s in sides if isinstance(s, ast.Constant) and s.value not in (0, 1, None)]
            text = ast.unparse(node).lower()
            if any(isinstance(s.value, int | float) for s in numbers) and any(w in text for w in words):
                found.append(f"{file.name}: {ast.unparse(node)}")
    assert not found
