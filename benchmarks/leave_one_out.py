"""The default without each of its rules, one at a time: what a rule brings on a scene, in bytes at equal quality.

    python benchmarks/leave_one_out.py ../shared/scenes/truck -r 2 --steps 2000 --lmbda 1e-4

Only rules that act on the scene are left out: without the others the plan is the same. The default itself is trained
with three lambdas, half and twice the one asked for beside it. The line through these three, PSNR or SSIM over the
logarithm of the bytes, says what bytes buy; a variant's column "bytes" tells how many more (+) or fewer (-) it takes
than the default of its quality. A rule earns its place where that is 1 % and more.

Every variant is a `compgs train` in a process of its own, judged by its decoded file on the held-out views. What is
finished is not run again, and what was stopped continues (`ablation.run_variant`). Table and JSON go to --output, as
leave_one_out_SCENE_LAMBDA.*.
"""

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from ablation import (
    ROOT,
    Variant,
    add_training_options,
    common_arguments,
    run_compgs,
    run_variant,
    train_command,
)
from ablation_tables import Record, Row, rows_of

from compgs.cli.main import parse as parse_compgs
from compgs.cli.plan import plan_in, planned
from compgs.cli.scenes import read_scene
from compgs.cli.train import Train
from compgs.outputs import write_bytes, write_json
from compgs.training.plan import RULES, Plan

WHOLE = "default"
BESIDE = (0.5, 2.0)  # times lambda: the other two points of the default's line
SMALLEST_SLOPE = 1e-6  # quality a factor e of bytes: with less no line can be told


def variants(lmbda: float) -> list[Variant]:
    """The default at three lambdas, then one variant a rule."""
    here = ("--lmbda", f"{lmbda:g}")
    return [
        Variant(WHOLE, "the default", here, curve=WHOLE),
        *(
            Variant(
                f"{WHOLE}_{factor:g}", f"lambda x {factor:g}", ("--lmbda", f"{factor * lmbda:g}"), curve=WHOLE
            )
            for factor in BESIDE
        ),
        *(
            Variant(
                f"without_{rule.name}",
                f"without {rule.name}",
                (*here, "--set", f"training.rules=all but {rule.name}"),
            )
            for rule in RULES
        ),
    ]


def acting(chosen: Sequence[Variant], plans: Sequence[Plan]) -> list[Variant]:
    """The default's points, and the variants whose plan differs from that of the default, the first one."""
    decided = [plan.to_dict() | {"reasons": None, "start": None} for plan in plans]
    return [
        variant
        for variant, its in zip(chosen, decided, strict=True)
        if variant.curve == WHOLE or its != decided[0]
    ]


def bytes_beside(line: Sequence[Row], row: Row, measure: str) -> float | None:
    """How many more bytes a row takes than the default of its quality, as a share; None where more bytes did not make
    the default better.
    """
    points = [(math.log(each.bytes), getattr(each, measure)) for each in line if each.bytes]
    mean_size = sum(size for size, _ in points) / len(points)
    mean_quality = sum(quality for _, quality in points) / len(points)
    spread = sum((size - mean_size) ** 2 for size, _ in points)
    together = sum((size - mean_size) * (quality - mean_quality) for size, quality in points)
    slope = together / spread if spread > 0 else 0.0
    if slope < SMALLEST_SLOPE or not row.bytes:
        return None
    expected = mean_size + (getattr(row, measure) - mean_quality) / slope
    return math.exp(math.log(row.bytes) - expected) - 1.0


def table(rows: Sequence[Row]) -> str:
    """Markdown."""
    line = [row for row in rows if row.curve == WHOLE]
    lpips = all(row.lpips is not None for row in rows)
    head = ["run", "PSNR, dB", "SSIM", *(["LPIPS"] if lpips else []), "bytes", "anchors", "s"]
    head += ["bytes at equal PSNR", "at equal SSIM"]
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    for row in rows:
        cells = [row.label, f"{row.psnr:.2f}", f"{row.ssim:.4f}", *([f"{row.lpips:.4f}"] if lpips else [])]
        cells += [f"{row.bytes:,.0f}", f"{row.anchors or 0:,.0f}", f"{row.seconds:.0f}"]
        for measure in ("psnr", "ssim"):
            more = None if row.curve == WHOLE else bytes_beside(line, row, measure)
            cells.append("" if more is None else f"{100 * more:+.0f} %")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def report(scene: str, records: Sequence[Record], command: str) -> str:
    """The Markdown file."""
    first = records[0]
    m, r = first["machine"], first["results"]
    commits = ", ".join(dict.fromkeys(record["commit"] for record in records))
    seeds = ", ".join(str(seed) for seed in dict.fromkeys(record["seed"] for record in records))
    parts = [
        f"# The default without each rule: {scene}",
        f"`{command}`",
        f"Decoded files on {r['views']} held-out views, {r['width']} x {r['height']} pixels; "
        f"{first['training'].get('steps', '?')} steps; seeds {seeds}; commit {commits}; {m['processor']}, "
        f"{m['cores']} cores, {m['threads']} threads. Seconds are of the whole command, on a machine that may have had "
        "other work. The last two columns compare with the line through the default's three points.",
        table(rows_of(records)),
    ]
    return "\n\n".join(parts) + "\n"


def plans_of(commands: Sequence[Sequence[str]]) -> list[Plan]:
    """The plans of trainings of one scene, by their commands."""
    found, scene = [], None
    for command in commands:
        train = parse_compgs(list(command))
        assert isinstance(train, Train) and train.output, f"no training: {command}"
        settings = train.settings(train.output)
        scene = scene or read_scene(settings.scene, at_once=False)
        plan = plan_in(planned(settings, scene, None))
        assert plan is not None
        found.append(plan)
    return found


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lmbda", type=float, required=True)
    parser.add_argument("--only", nargs="+", metavar="RULE", help="leave out some of the rules alone")
    add_training_options(parser, ROOT / "runs" / "leave_one_out")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None, run: Callable[[list[str]], None] = run_compgs) -> None:
    options = parse(arguments)
    scene, common = options.scene.resolve(), common_arguments(options)
    chosen = variants(options.lmbda)
    known = [rule.name for rule in RULES]
    if options.only:
        unknown = set(options.only) - set(known)
        if unknown:
            raise SystemExit(f"--only {' '.join(sorted(unknown))}: the rules are {', '.join(known)}")
        chosen = [v for v in chosen if v.curve == WHOLE or v.name.removeprefix("without_") in options.only]
    name = f"{scene.name}_{options.lmbda:g}"

    def folder(variant: Variant, seed: int) -> Path:
        return options.runs / name / f"{variant.name}_seed{seed}"

    def command(variant: Variant, seed: int) -> list[str]:
        return train_command(variant, scene, folder(variant, seed), common, seed)

    chosen = acting(chosen, plans_of([command(variant, options.seeds[0]) for variant in chosen]))
    records = []
    for seed in options.seeds:
        for variant in chosen:
            print(f"== {variant.label}, seed {seed}", flush=True)
            records.append(run_variant(variant, command(variant, seed), folder(variant, seed), seed, run))
    given = sys.argv[1:] if arguments is None else arguments
    text = report(scene.name, records, f"python benchmarks/leave_one_out.py {' '.join(map(str, given))}")
    stem = options.output / f"leave_one_out_{name}"
    write_bytes(stem.with_name(stem.name + ".md"), text.encode())
    rows = [asdict(row) for row in rows_of(records)]
    write_json(stem.with_name(stem.name + ".json"), {"rows": rows, "records": records})
    print(text)


if __name__ == "__main__":
    main()
