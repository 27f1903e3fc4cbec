"""What a run decides for itself, before its first step: the one place where lambda, bytes, views or passes choose
between two ways of training. What a way then counts in its own units stays with it: the schedule of growth in
`structure/control.py`, the price of a bit in `structure/pruning.py`, how fast a size is followed in `rate`.

    settings ─┐
              ├─► RULES, one after the other ─► Plan ─► model, step, events, file
    Start   ──┘

A `Start` is what is known of a run before it begins. A rule replaces one value of the settings where its condition
holds; to remove a rule, delete its entry. The settings `training.rules = "none"` apply none of them, and "all but NAME"
leaves some out. The plan is printed, and stored with the run. All tiles of a capture have one plan.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from compgs.config import MAX_VIEWPOINTS, MOST_COUPLED, Config, Heads, ModelConfig
from compgs.errors import ConfigError
from compgs.former_settings import FORMER_RULES
from compgs.render.settings import LEAST_DILATION

# lambda for which the settings of growth are given, and the range in which it follows lambda: below 1e-6 more anchors
# took half as many bytes again and brought nothing (docs/results/decisions.md)
USUAL_LAMBDA, LAMBDA_RANGE = 0.002, (1e-6, 0.1)
# A file of b bytes for each anchor at the given points comes of a lambda of about 0.04 / b^1.5: fitted to the default
# preset's curves of docs/results (plush and brighton, 1 500 and 5 000 steps, lambda 0.0001 to 0.1). Sizes are met
# within a factor of 2 (one standard deviation), at worst 3.5. Where points are looked for in the photographs, it is
# about 0.1 / b^1.5: Truck, Bonsai, plush and the demo (lambda 0.001 to 0.01) are met within 1.7. Where structure from
# motion finds few points in large photographs, that is too small a lambda, and no rule minds. By all anchors of the
# beginning it would be too large where files are small: 0.07 for 15 kB of plush, which 0.014 gives, and half the units.
ONE_BYTE_LAMBDA, DENSE_ONE_BYTE_LAMBDA, SIZE_EXPONENT = 0.04, 0.1, 1.5
# The size that people are told goes there by all anchors of the beginning. With lambda 0.002 each comes to 5 bytes on
# average over seven captures, Truck to a mug on a table: 1.8 to 13, so within a factor of 2 mostly, at worst 2.8.
DENSE_BYTES = 5.0
SIZED_ANCHORS = 1_000, 250_000  # of the beginning, between which that is taken to hold
# Anchors of the beginning from which on a capture is large: five bits more of each weight of the networks are less than
# two bits of an anchor there, which has a hundred and more. More hidden units do not pay even there. What photographs
# show counts, not only what structure from motion found: few points of large photographs left a few blurs
# (docs/results/hasty_captures.md#few-points-in-large-photographs).
MANY_ANCHORS = 20_000
# Views that are rendered at most, spread evenly over all, to estimate the size, and to prune: the rest of the run makes
# up for an error.
LOOKED_AT, PRUNED_BY = 48, 256
# Large captures: pixels of the photographs between two points that are found in them before the run, voxels of 0.7
# spacings where others have 1.5, and coupled primitives of an anchor. What stands where it belongs from the first step
# on need not grow there, and few primitives around each of many anchors show more than many around few
# (docs/results/truck.md).
POINTS_APART, FINER, FEW_COUPLED = 8.0, 0.7 / 1.5, 3
# Training views that show a point, where they are few. It was found as 15 views of plush and of fox, three of four of
# which show a point. What a run can overfit is what few views see, however many photographs there are of other places.
FEW_SIGHTINGS = 11
# What the rules decide by, where it is no yes or no.
# Where training views are few: share of the primitives that a step does without, and by which pruning counts a bit as
# cheaper, as what adds little may be all that one view has.
FEW_VIEWS_DROPOUT, FEW_VIEWS_DISCOUNT = 0.2, 0.5
# The shortcuts (`training/shortcuts`). Photographs of so many pixels, and of more, are halved until a share of the run.
COARSE_PIXELS, COARSE_UNTIL = 160_000, 0.4
# Steps from one with the rate to the next: latents change little meanwhile, and a step without takes a sixth less time.
# Runs that pass so often over a large capture need half as many. With 13 passes Truck lost 0.07 dB.
RATE_EVERY, RATE_EVERY_OF_MANY, MANY_PASSES = 4, 8, 25
# Of the mean gradient of a view's primitives: anchors whose primitives have less are passed over.
PASSED_OVER = 0.03


@dataclass(frozen=True)
class Start:
    """What is known of a run before its first step."""

    # before points are looked for in the photographs; where a capture is trained in tiles, of one of them on average
    anchors: int
    views: int  # training views; where a capture is trained in tiles, of all of them
    sightings: float  # training views that show a point, the median over the points
    passes: float  # over the training views, in the whole run
    lmbda: float  # the setting, or what a size that is asked for amounts to (`lambda_for`)
    pixels: int  # of the largest training photograph
    device: str  # "cpu" or "cuda"
    processes: int = 1  # of a torchrun
    poses_in_doubt: bool = False  # that they are right to a pixel
    # no points are looked for in the photographs: they show more than a tile, or are pictures of splats
    points_at_hand: bool = False
    findable: int = 0  # points that a search in the photographs would add, about

    @property
    def fewness(self) -> float:
        """1 where a point is in few training views, up to 11, and 0 where it is in many, from twice that on."""
        return min(1.0, max(0.0, 2.0 - self.sightings / FEW_SIGHTINGS))

    @property
    def few(self) -> bool:
        """Whether the training views that show a point are rather few than many: up to 16, where no points are looked
        for in the photographs.
        """
        return self.fewness >= 0.5 and not self.dense

    @property
    def dense(self) -> bool:
        """Whether points are looked for in the photographs: where some show each place, and anchors become many."""
        many = self.anchors + self.findable >= MANY_ANCHORS
        return many and self.fewness < 1.0 and not self.points_at_hand

    @property
    def beginning(self) -> int:
        """Anchors with which training begins, about."""
        return self.anchors + self.findable if self.dense else self.anchors

    @property
    def large(self) -> bool:
        """Whether anchors are so many that the networks they share hardly count in the file."""
        return self.beginning >= MANY_ANCHORS

    def often(self, passes: float) -> bool:
        """Whether the run passes over its training views so often."""
        return self.passes >= passes

    def costs(self, price: float) -> bool:
        """Whether a bit of the networks, which all anchors share, has this price of lambda / anchors or more."""
        return self.lmbda >= price * self.beginning

    def in_words(self) -> str:
        """One line for people."""
        return (
            f"{self.anchors:,} anchors at the given points, {self.findable:,} more that photographs may show, "
            f"{self.views} training views, a point is in "
            f"{self.sightings:g} of them, {self.passes:.1f} passes, lambda {self.lmbda:.3g}, photographs of up to "
            f"{self.pixels:,} pixels, on {self.device}"
            + (f" ({self.processes} processes)" if self.processes > 1 else "")
        )


@dataclass(frozen=True)
class Rule:
    """A value that a run chooses in place of the settings' one."""

    name: str  # by which `training.rules` leaves it out
    sets: str  # field of `Plan`
    to: Callable[[Config, Start, Any], Any]  # the new value, from the value that there was
    when: str  # the condition, for people
    holds: Callable[[Start], bool]
    evidence: str  # what was measured: a page of docs/


def growth_factor(config: Config, lmbda: float) -> float:
    """Factor on the gradient that asks for a new anchor: anchors cost bits. It follows lambda in a run."""
    if not in_force("growth", config):
        return 1.0
    least, most = LAMBDA_RANGE
    return (min(max(lmbda, least), most) / USUAL_LAMBDA) ** (1 / 3)


def _voxels(config: Config, start: Start, spacings: float) -> float:
    """Anchors cost bits: voxels grow with lambda."""
    dearer = min(start.lmbda, LAMBDA_RANGE[1]) / USUAL_LAMBDA
    return spacings * max(1.0, dearer) ** (1 / 6)


# `Start.large`, `Start.dense`, `Start.few` and `Start.fewness` for people
LARGE = f"{MANY_ANCHORS:,} anchors and more"
DENSE = f"{LARGE} with those that photographs show, a point in {FEW_SIGHTINGS + 1} training views and more, no tile"
RATHER_FEW = 3 * FEW_SIGHTINGS // 2  # training views that show a point: half of `fewness`
FEW = f"a point in {RATHER_FEW} training views and fewer, no points looked for"
FEWER = f"a point in fewer than {2 * FEW_SIGHTINGS} training views"
# Where two rules set the same value, the later one is asked with what the earlier one chose.
RULES: tuple[Rule, ...] = (
    Rule(
        "coarser_grid", "voxel_spacings", _voxels,
        f"lambda above {USUAL_LAMBDA:g}: voxels grow with its sixth root",
        lambda s: s.lmbda > USUAL_LAMBDA,
        "results/decisions.md",
    ),
    Rule(
        "dense_points", "dense_points", lambda c, s, pixels: POINTS_APART,
        f"{DENSE}: points every {POINTS_APART:g} pixels, where there are none",
        lambda s: s.dense,
        "results/truck.md",
    ),
    Rule(
        "finer_grid", "voxel_spacings", lambda c, s, spacings: FINER * spacings,
        f"{DENSE}: 0.7 where others have 1.5",
        lambda s: s.dense,
        "results/truck.md",
    ),
    Rule(
        "fewer_coupled", "coupled_primitives", lambda c, s, k: min(k, FEW_COUPLED),
        f"{DENSE}: {FEW_COUPLED} at most, as anchors are close to each other",
        lambda s: s.dense,
        "results/truck.md",
    ),
    Rule(
        "twice_coupled", "coupled_primitives", lambda c, s, k: min(2 * k, MOST_COUPLED),
        f"{FEW}, lambda up to 1e-4",
        lambda s: s.few and s.lmbda <= 1e-4,
        "results/decisions.md",
    ),
    Rule(
        "own_residuals_few", "residuals", lambda c, s, own: True,
        f"{FEW}, lambda up to 0.001",
        lambda s: s.few and s.lmbda <= 1e-3,
        "results/decisions.md",
    ),
    # Left to large captures: of the small ones some gain more by it, and the demo's computed scene loses
    # (docs/results/tried.md).
    Rule(
        "shallow_heads", "heads", lambda c, s, heads: "shallow" if heads == "paired" else heads,
        f"{DENSE}: without residual blocks",
        lambda s: s.dense,
        "results/truck.md",
    ),
    # A price is lambda / anchors: what a bit costs that all anchors share. Plush is better with 32 units at 1.6e-7,
    # level at 3.1e-7, and better with 16 at 6.2e-7. The other prices were set where plush and fox gained: files at
    # lambda 0.01, 0.03 and 0.1 became 16, 16 to 25 and 28 to 47 % smaller (docs/results/decisions.md).
    Rule(
        "width_16", "width", lambda c, s, width: min(width, 16),
        "lambda / anchors of 3e-7 and more",
        lambda s: s.costs(3e-7),
        "results/decisions.md",
    ),
    Rule(
        "width_8", "width", lambda c, s, width: min(width, 8),
        "lambda / anchors of 1.5e-6 and more",
        lambda s: s.costs(1.5e-6),
        "results/decisions.md",
    ),
    # In so small a file a context hardly saves what its network costs.
    Rule(
        "no_context", "reference_context", lambda c, s, context: "none",
        "lambda / anchors of 6e-7 and more",
        lambda s: s.costs(6e-7),
        "results/decisions.md",
    ),
    # On Truck weights of 7 bits lose 0.08 dB at -r 2, by which the curve there rises with a fifth more bytes.
    Rule(
        "exact_heads", "head_bits", lambda c, s, bits: max(bits, 12),
        LARGE,
        lambda s: s.large,
        "results/truck.md",
    ),
    # Of the networks' weights. Asked anew after every step, with lambda and anchors as they are then (`head_bits`).
    Rule(
        "one_bit_less", "head_bits", lambda c, s, bits: c.entropy.head_bits - 1,
        "lambda / anchors of 3e-6 and more",
        lambda s: s.costs(3e-6),
        "results/decisions.md",
    ),
    Rule(
        "sharp", "dilation", lambda c, s, pixels: min(pixels, LEAST_DILATION),
        f"a point in {RATHER_FEW + 1} training views and more, and lambda up to {USUAL_LAMBDA:g}; or {DENSE}",
        lambda s: not s.few and (s.dense or s.lmbda <= USUAL_LAMBDA),
        "results/decisions.md",
    ),
    # Followed in a run, as lambda changes (`growth_factor`).
    Rule(
        "growth", "growth_threshold", lambda c, s, threshold: threshold * growth_factor(c, s.lmbda),
        f"always: it goes with the cube root of lambda / {USUAL_LAMBDA:g}",
        lambda s: True,
        "results/decisions.md",
    ),
    Rule(
        "dropout", "dropout", lambda c, s, share: FEW_VIEWS_DROPOUT * s.fewness,
        f"{FEWER}: {FEW_VIEWS_DROPOUT:g} where {FEW_SIGHTINGS} or fewer",
        lambda s: s.fewness > 0,
        "results/decisions.md",
    ),
    Rule(
        "bit_discount", "bit_discount", lambda c, s, share: FEW_VIEWS_DISCOUNT * s.fewness,
        f"{FEWER}: {FEW_VIEWS_DISCOUNT:g} where {FEW_SIGHTINGS} or fewer",
        lambda s: s.fewness > 0,
        "results/decisions.md",
    ),
    Rule(
        "coarse_photographs", "coarse_until", lambda c, s, share: COARSE_UNTIL,
        f"photographs of {COARSE_PIXELS:,} pixels and more: until {COARSE_UNTIL:g} of the run",
        lambda s: s.pixels >= COARSE_PIXELS,
        "results/decisions.md",
    ),
    Rule(
        "rate_every", "rate_every",
        lambda c, s, steps: RATE_EVERY_OF_MANY if s.dense and s.often(MANY_PASSES) else RATE_EVERY,
        f"always: {RATE_EVERY}; {RATE_EVERY_OF_MANY} where {DENSE}, in {MANY_PASSES} passes and more",
        lambda s: True,
        "results/decisions.md",
    ),
    # Several processes must look at the same anchors, and each would know of its own views alone.
    Rule(
        "hidden_anchors", "passed_over", lambda c, s, share: PASSED_OVER,
        "on the CPU in one process",
        lambda s: s.device == "cpu" and s.processes == 1,
        "results/decisions.md",
    ),
    Rule(
        "poses", "poses", lambda c, s, learned: c.training.learns_poses(in_doubt=True),
        "a reconstruction whose mean error is above a pixel, or frames of a video",
        lambda s: s.poses_in_doubt,
        "results/hasty_captures.md",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """What a run has decided. Fields without a rule are the settings'."""

    # the model
    coupled_primitives: int  # K
    width: int  # hidden units of the prediction networks
    heads: Heads
    residuals: bool  # each anchor has its own K residual embeddings
    reference_context: Literal["neighbours", "hyperprior", "none"]
    row_context: bool  # of the file: symbols say something about later ones of their row
    head_bits: int  # of a weight of the prediction networks, as the run begins
    voxel_spacings: float  # median distances of the points to a voxel
    dilation: float  # pixels^2 of the training photographs
    viewpoints: int  # cameras that the file keeps at most; a small file keeps fewer
    # training
    growth_threshold: float  # mean norm of the 2D gradient, as the run begins
    pruning_views: int  # that are rendered to prune
    bit_discount: float  # share by which a bit is cheaper to pruning than to the objective
    dropout: float  # share of the primitives that a step does without
    # shortcuts, which save time
    coarse_until: float  # share of the run in which large photographs are halved; 0: none
    rate_every: int  # steps between two with the rate in the loss
    passed_over: float  # of the mean gradient: anchors that showed less are passed over; 0: none are
    start: Start
    reasons: Mapping[str, str] = field(default_factory=dict)  # by field, of those that a rule has set
    # of the photographs, between two points that are found in them before the run (`compgs.stereo`); 0: none are
    dense_points: float = 0.0
    poses: bool = False  # of the training views are learned beside the scene

    def model(self, settings: ModelConfig) -> ModelConfig:
        """The settings of the model, with what the plan has decided in their place."""
        return replace(
            settings,
            coupled_primitives=self.coupled_primitives,
            width=self.width,
            heads=self.heads,
            residuals=self.residuals,
            reference_context=self.reference_context,
            row_context=self.row_context,
            voxel_spacings=self.voxel_spacings,
            dilation=self.dilation,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> "Plan":
        """Inverse of `to_dict`. Raises ValueError for what is no plan."""
        try:
            fields = {name: value for name, value in dict(values).items() if name not in FORMER_RULES}
            start, reasons = Start(**fields["start"]), {str(k): str(v) for k, v in fields["reasons"].items()}
            plan = cls(**{**fields, "start": start, "reasons": reasons})
        except (TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"not the plan of a run ({error})") from error
        numbers = (
            start.anchors, start.findable, start.views, start.sightings, start.passes, start.lmbda, start.pixels
        )  # fmt: skip
        if not all(isinstance(n, int | float) and math.isfinite(n) and n >= 0 for n in numbers):
            raise ValueError(f"plan: a start that cannot be: {start!r:.200}")
        for name, (sound, expected) in _expected(plan).items():
            if not sound:
                raise ValueError(f"plan: {name}: expected {expected}, found {getattr(plan, name)!r:.60}")
        return plan

    def in_words(self) -> list[str]:
        """Lines for people: what the run starts from, then each value with its reason, or when it would be another."""
        lines = [self.start.in_words()]
        for each in dataclasses.fields(self):
            if each.name in ("start", "reasons"):
                continue
            value = getattr(self, each.name)
            shown = f"{value:.3g}" if isinstance(value, float) else str(value)
            others = [r.when for r in RULES if r.sets == each.name and not r.when.startswith("always")]
            otherwise = f"(another with {'; or with '.join(others)})" if others else ""
            reason = self.reasons.get(each.name, otherwise)
            lines.append(f"  {each.name:<20}{shown:<12}{reason}".rstrip())
        return lines


def plan(config: Config, start: Start) -> Plan:
    """The plan of a run. Raises ConfigError for `training.rules` that name no rule."""
    # The grid comes before the anchors, and goes by the setting, whatever size is asked for.
    of_grid = replace(start, lmbda=config.training.lmbda)
    found = {
        name: decided(name, config, of_grid if name == "voxel_spacings" else start)
        for name in _by_settings(config, start)
    }
    values = {name: value for name, (value, _) in found.items()}
    return Plan(**values, start=start, reasons={name: why for name, (_, why) in found.items() if why})


def decided(name: str, config: Config, start: Start) -> tuple[Any, str]:
    """One value of the plan, and which rule has set it and when, in words; empty where it is the settings' own."""
    value, reason = _by_settings(config, start)[name], ""
    for rule in active_rules(config):
        if rule.sets != name or not rule.holds(start):
            continue
        chosen = rule.to(config, start, value)
        if chosen != value:
            value, reason = chosen, f"{rule.name}: {rule.when}"
    return value, reason


def grid_spacings(config: Config) -> float:
    """Median distances of the points to a voxel, as far as they are known before there are anchors."""
    start = Start(0, 1, 1.0, 1.0, config.training.lmbda, 0, "cpu")
    return float(decided("voxel_spacings", config, start)[0])


def head_bits(config: Config, start: Start, lmbda: float, anchors: int) -> int:
    """Bits of a weight of the prediction networks, sign included, with lambda and the anchors as they are now."""
    now = replace(start, lmbda=lmbda, anchors=anchors, findable=0)
    return int(decided("head_bits", config, now)[0])


def lambda_for(bytes_per_anchor: float, *, dense: bool = False) -> float:
    """lambda that a file of so many bytes for each anchor at the given points comes of, about; `dense`: points are
    looked for in the photographs. It falls as bytes rise: whoever asks for a larger file never gets a smaller model.
    """
    one_byte = DENSE_ONE_BYTE_LAMBDA if dense else ONE_BYTE_LAMBDA
    return float(one_byte * bytes_per_anchor**-SIZE_EXPONENT)


def expected_bytes(start: Start) -> float | None:
    """Bytes of the file, about; None where that is not known."""
    fewest, most = SIZED_ANCHORS
    if start.lmbda <= 0 or not fewest <= start.beginning <= most:
        return None
    one_byte = USUAL_LAMBDA * DENSE_BYTES**SIZE_EXPONENT if start.dense else ONE_BYTE_LAMBDA
    return float(start.beginning * (one_byte / start.lmbda) ** (1 / SIZE_EXPONENT))


def active_rules(config: Config) -> tuple[Rule, ...]:
    """The rules that `training.rules` leaves in force. Raises ConfigError for a name that no rule has."""
    asked = config.training.rules
    if asked == "all":
        return RULES
    if asked == "none":
        return ()
    known = [rule.name for rule in RULES]
    said, _, names = asked.partition("all but ")
    without = [name.strip() for name in names.split(",")]
    if said or not names or not set(without) <= set(known):
        raise ConfigError(
            f"training.rules = {asked!r}: expected all, none, or all but some of {', '.join(known)}"
        )
    return tuple(rule for rule in RULES if rule.name not in without)


def in_force(name: str, config: Config) -> bool:
    """Whether `training.rules` leaves a rule in force."""
    return any(rule.name == name for rule in active_rules(config))


def pruning_views(views: int) -> int:
    """Training views that a pruning renders: half of them, in half of the time that all take; it chooses about the same
    anchors.
    """
    return min(PRUNED_BY, max(LOOKED_AT, math.ceil(views / 2)))


def _by_settings(config: Config, start: Start) -> dict[str, Any]:
    """The plan without any rule."""
    m, t = config.model, config.training
    return {
        "coupled_primitives": m.coupled_primitives,
        "width": m.width,
        "heads": m.heads,
        "residuals": m.residuals,
        "reference_context": m.reference_context,
        "row_context": m.row_context,
        "head_bits": config.entropy.head_bits,
        "voxel_spacings": m.voxel_spacings,
        "dilation": m.dilation,
        "viewpoints": t.viewpoints,
        "growth_threshold": config.control.gradient_threshold,
        "pruning_views": pruning_views(start.views),
        "bit_discount": 0.0,
        "dropout": 0.0,
        "coarse_until": 0.0,
        "rate_every": 1,
        "passed_over": 0.0,
        "dense_points": 0.0,
        "poses": config.training.poses == "on",
    }


def _expected(plan: Plan) -> dict[str, tuple[bool, str]]:
    """Say by field whether a value from outside is sound, and what was expected."""

    def whole(name: str, least: int, most: int) -> tuple[bool, str]:
        value = getattr(plan, name)
        sound = isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
        return sound, f"{least} to {most}"

    def number(name: str, most: float) -> tuple[bool, str]:
        value = getattr(plan, name)
        sound = isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value <= most
        return sound, f"0 to {most:g}"

    def one_of(name: str, *options: object) -> tuple[bool, str]:
        value = getattr(plan, name)
        return any(value is o or (value == o and isinstance(o, str)) for o in options), " or ".join(
            map(str, options)
        )

    return {
        "coupled_primitives": whole("coupled_primitives", 1, MOST_COUPLED),
        "width": whole("width", 1, 256),
        "heads": one_of("heads", *get_args(Heads)),
        "residuals": one_of("residuals", True, False),
        "reference_context": one_of("reference_context", "neighbours", "hyperprior", "none"),
        "row_context": one_of("row_context", True, False),
        "head_bits": whole("head_bits", 1, 16),
        "viewpoints": whole("viewpoints", 0, MAX_VIEWPOINTS),
        "pruning_views": whole("pruning_views", 1, 256),
        "rate_every": whole("rate_every", 1, 1000),
        "voxel_spacings": number("voxel_spacings", 1e9),
        "dilation": number("dilation", 10.0),
        "growth_threshold": number("growth_threshold", 1e12),
        "bit_discount": number("bit_discount", 1.0),
        "dropout": number("dropout", 0.5),
        "coarse_until": number("coarse_until", 1.0),
        "passed_over": number("passed_over", 1.0),
        "dense_points": number("dense_points", 1e4),
        "poses": one_of("poses", True, False),
    }
