"""What a training step costs: by part on a real scene, and how it grows with anchors and with pixels.

    python benchmarks/training_step.py [--scene ../shared/scenes/plush_480 --downscale 2 --downscale 1]
        [--coupled 10 --coupled 5] [--run runs/plush] [--growth] [--output docs/results]

Each line is a process of its own, so that peak memory is its own. Steps are those of the middle of a run: the rate
is in the loss and the statistics of adaptive control are gathered. `--run` adds the anchors of a trained run on the
first scene; else they are those of the scene's points, as at the start. `--coupled` sets how many
coupled primitives an anchor has. Processor time is that of all threads: it depends little on what else the machine
does.
`--growth` measures a made-up scene all of whose anchors are in view, the worst case: 10^4 to 10^6 anchors at 480x360,
and up to 1920x1440 pixels at 20 000 anchors.
`--output` writes training_step.json and training_step.png there.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import compgs  # noqa: F401  # before torch: its threads must not spin

ANCHORS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
SIZES = ((240, 180), (480, 360), (960, 720), (1920, 1440))
FIXED_ANCHORS, FIXED_SIZE = 20_000, (480, 360)
STEPS = 20  # measured, after those that are not counted
SECONDS = 12.0  # after which a size has been measured enough
FEWEST_STEPS = 2
PROGRESS = 0.3  # of the run: the rate is in the loss, control still observes


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def trainer_in_mid_run(scene: Any, config: Any, model: Any = None) -> Any:
    """A Trainer at a step at which control observes but does not act, now or soon."""
    import torch

    from compgs.training.trainer import Trainer

    trainer = Trainer(scene, config, torch.device("cpu"), model)
    schedule = trainer.schedule
    due = schedule.start + schedule.every * int(
        (PROGRESS * config.training.steps - schedule.start) / schedule.every
    )
    trainer.step = due + 1
    return trainer


def visible_share(trainer: Any) -> float:
    views = trainer.scene.train_views[:8]
    return (
        sum(len(trainer.survey.visible_anchors(v.camera)) for v in views) / len(views) / trainer.model.anchors
    )


def timed_step(trainer: Any) -> float:
    start = time.perf_counter()
    trainer.train_step()
    return time.perf_counter() - start


def breakdown(options: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds by part on a real scene."""
    from compgs.config import Config
    from compgs.scene import load_scene
    from compgs.training.run.checkpoint import CHECKPOINT_NAME
    from compgs.training.run.model_checkpoint import load_checkpoint
    from compgs.training.run.profile import StepProfile

    scene = load_scene(options.scene[0], downscale=options.downscale[0])
    model, config = None, Config()
    if options.coupled:
        config = replace(config, model=replace(config.model, coupled_primitives=options.coupled[0]))
    if options.run:
        model = load_checkpoint(options.run / CHECKPOINT_NAME).model
        # The schedule is the default one; the model keeps its own dimensions.
        config = replace(config, model=model.config.model, entropy=model.config.entropy)
        model.mask[:] = True
    trainer = trainer_in_mid_run(scene, config, model)
    profile = StepProfile()
    profile.watch(trainer, trainer.PROFILED, trainer.stations)
    for _ in range(profile.warm_up):
        trainer.train_step()
    before = time.process_time()
    seconds = sorted(timed_step(trainer) for _ in range(options.steps))
    camera = scene.train_views[0].camera
    return {
        "scene": scene.name,
        "width": camera.width,
        "height": camera.height,
        "run": bool(options.run),
        "anchors": trainer.model.anchors,
        "visible": visible_share(trainer),
        "coupled": config.model.coupled_primitives,
        "median_ms": 1e3 * seconds[len(seconds) // 2],
        "fastest_ms": 1e3 * seconds[0],
        "steps_per_second": len(seconds) / sum(seconds),
        "cpu_ms": 1e3 * (time.process_time() - before) / options.steps,
        "parts_ms": profile.milliseconds(),
        "peak_mb": peak_mb(),
    }


def growth(options: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds and peak memory of a step on a made-up scene."""
    from made_scene import made_scene

    anchors, width, height = options.made
    trainer_in_mid_run(*made_scene(500, 64, 48)).train_step()  # loads the kernels
    scene, config = made_scene(anchors, width, height)
    trainer = trainer_in_mid_run(scene, config)
    before = peak_mb()
    trainer.train_step()
    seconds: list[float] = []
    processor = time.process_time()
    while len(seconds) < FEWEST_STEPS or (len(seconds) < options.steps and sum(seconds) < SECONDS):
        seconds.append(timed_step(trainer))
    processor = time.process_time() - processor
    model = sum(p.numel() for p in trainer.model.parameters()) * 4 / 1e6
    return {
        "anchors": trainer.model.anchors,
        "width": width,
        "height": height,
        "visible": visible_share(trainer),
        "steps": len(seconds),
        "ms": 1e3 * sorted(seconds)[len(seconds) // 2],
        "cpu_ms": 1e3 * processor / len(seconds),
        "parameters_mb": model,
        "peak_before_mb": before,
        "peak_mb": peak_mb(),
    }


def child(*arguments: str) -> dict[str, Any]:
    command = [sys.executable, __file__, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise SystemExit(f"{' '.join(arguments)}: {result.stderr or f'ended with {result.returncode}'}")
    return json.loads(result.stdout)


def slopes(rows: list[dict[str, Any]], by: str) -> dict[str, float]:
    """Exponents of power laws fitted to time and to peak memory above that of an empty process."""
    import numpy as np

    x = [row["anchors"] if by == "anchors" else row["width"] * row["height"] for row in rows]

    def exponent(xs: list[float], ys: list[float]) -> float:
        return float(np.polyfit(np.log(xs), np.log(ys), 1)[0])

    base = min(row["peak_before_mb"] for row in rows)
    return {
        "time": exponent(x, [row["ms"] for row in rows]),
        "processor time": exponent(x, [row["cpu_ms"] for row in rows]),
        "processor time of the largest two": exponent(x[-2:], [row["cpu_ms"] for row in rows[-2:]]),
        "memory": exponent(x, [row["peak_mb"] - base for row in rows]),
        "memory of the largest two": exponent(x[-2:], [row["peak_mb"] - base for row in rows[-2:]]),
    }


def report(results: dict[str, Any]) -> None:
    for r in results["breakdown"]:
        start = "a trained run's anchors" if r["run"] else "the points' anchors"
        print(f"\n{r['scene']} at {r['width']}x{r['height']}, {r['anchors']} anchors ({start}), ", end="")
        print(f"{r['visible']:.0%} of them in view, {r['coupled']} coupled primitives each: ", end="")
        print(f"{r['median_ms']:.1f} ms a step (fastest {r['fastest_ms']:.1f}), ", end="")
        print(f"{r['cpu_ms']:.1f} ms of processor time")
    if results["breakdown"]:
        parts = list(dict.fromkeys(part for r in results["breakdown"] for part in r["parts_ms"]))
        print(
            "\n| ms |",
            *(
                f"{r['scene']} {r['width']} px, {r['anchors']} anchors, K = {r['coupled']} |"
                for r in results["breakdown"]
            ),
        )
        print("|---|" + "---|" * len(results["breakdown"]))
        for part in parts:
            print(f"| {part} |", *(f"{r['parts_ms'].get(part, 0):.1f} |" for r in results["breakdown"]))
        print("| all |", *(f"{sum(r['parts_ms'].values()):.1f} |" for r in results["breakdown"]))
        print("| processor time |", *(f"{r['cpu_ms']:.1f} |" for r in results["breakdown"]))
        print("| steps a second |", *(f"{r['steps_per_second']:.1f} |" for r in results["breakdown"]))
        print("| peak MB |", *(f"{r['peak_mb']:.0f} |" for r in results["breakdown"]))
    for by in ("anchors", "pixels"):
        rows = results.get(by)
        if not rows:
            continue
        print(
            "\n| anchors | in view | pixels | ms a step | processor ms | parameters MB | peak MB | of it before |",
            "steps |",
        )
        print("|---|---|---|---|---|---|---|---|---|")
        for r in rows:
            print(
                f"| {r['anchors']} | {r['visible']:.0%} | {r['width']}x{r['height']} | {r['ms']:.0f} | "
                f"{r['cpu_ms']:.0f} | {r['parameters_mb']:.0f} | {r['peak_mb']:.0f} | {r['peak_before_mb']:.0f} | "
                f"{r['steps']} |"
            )
        fitted = ", ".join(f"{name} {value:.2f}" for name, value in results["slopes"][by].items())
        print(f"\nexponent by {by}: {fitted}")


def plot(results: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for axis, by in zip(axes, ("anchors", "pixels"), strict=True):
        rows, fitted = results[by], results["slopes"][by]
        x = [row["anchors"] if by == "anchors" else row["width"] * row["height"] for row in rows]
        axis.loglog(x, [row["ms"] for row in rows], "o-", label=f"ms a step (slope {fitted['time']:.2f})")
        axis.loglog(
            x, [row["cpu_ms"] for row in rows], "^-", label="processor ms a step, all threads together"
        )
        axis.loglog(x, [row["peak_mb"] for row in rows], "s--", label="peak memory, MB, all of the process")
        axis.loglog(x, [rows[0]["ms"] * v / x[0] for v in x], ":", color="gray", label="linear")
        fixed = (
            f"{rows[0]['width']}x{rows[0]['height']}" if by == "anchors" else f"{rows[0]['anchors']} anchors"
        )
        axis.set_xlabel(f"{by} ({fixed})")
        axis.grid(True, which="both", alpha=0.25)
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", type=Path, action="append", default=[], help="folder of a capture")
    parser.add_argument(
        "--downscale", type=int, action="append", default=[], help="of the first scene's images"
    )
    parser.add_argument("--coupled", type=int, action="append", default=[], help="coupled primitives")
    parser.add_argument("--run", type=Path, help="folder of a run on the first scene")
    parser.add_argument("--growth", action="store_true")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--output", type=Path, help="folder for the JSON and the plot")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--made", type=int, nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        from compgs.numerics.freed_memory import freed_memory_kept

        with freed_memory_kept():  # as in a run
            print(json.dumps({"breakdown": breakdown, "growth": growth}[options.job](options)))
        return

    from compgs.config import Config

    steps = ("--steps", str(options.steps))
    results: dict[str, Any] = {"breakdown": [], "slopes": {}}
    for i, scene in enumerate(options.scene):
        scales = (options.downscale or [1]) if i == 0 else [1]
        for scale in scales:
            place = ("--job", "breakdown", "--scene", str(scene), "--downscale", str(scale), *steps)
            for coupled in options.coupled or [Config().model.coupled_primitives]:
                results["breakdown"].append(child(*place, "--coupled", str(coupled)))
            if options.run and i == 0:
                results["breakdown"].append(child(*place, "--run", str(options.run)))
    if options.growth:
        sizes = {
            "anchors": [(n, *FIXED_SIZE) for n in ANCHORS],
            "pixels": [(FIXED_ANCHORS, *size) for size in SIZES],
        }
        for by, cases in sizes.items():
            results[by] = [child("--job", "growth", "--made", *map(str, case), *steps) for case in cases]
            results["slopes"][by] = slopes(results[by], by)
    results["machine"] = {"cores": os.cpu_count(), "python": platform.python_version()}
    report(results)
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        text = json.dumps(results, indent=2) + "\n"
        (options.output / "training_step.json").write_text(text, encoding="utf-8")
        if options.growth:
            plot(results, options.output / "training_step.png")


if __name__ == "__main__":
    main()
