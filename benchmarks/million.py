"""What a run does at every step, and what it does now and then, from 10^5 to 10^6 anchors.

    python benchmarks/million.py [--anchors 100000 --anchors 1000000] [--steps 2] [--encode] [--output docs/results]

The scene is made up, nearly all anchors are in view (`made_scene`), the settings are the default ones. Times are of
the processor, all threads together: they depend little on what else the machine does. Each size is a process of its
own, so that its peak of memory is its own. "exponent" is that of the largest two sizes: 1 is linear.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import compgs  # noqa: F401  # before torch: its threads must not spin

ANCHORS = (100_000, 300_000, 1_000_000)
SIZE = 480, 360


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def measured(work: Callable[[], Any]) -> tuple[float, float]:
    """Processor and wall seconds."""
    processor, wall = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - processor, time.perf_counter() - wall


def one_size(anchors: int, steps: int, *, encode: bool) -> dict[str, Any]:
    import torch
    from made_scene import made_scene
    from training_step import trainer_in_mid_run

    from compgs.numerics.freed_memory import freed_memory_kept
    from compgs.training.plan import LOOKED_AT
    from compgs.training.run.checkpoint import Writer
    from compgs.training.run.distributed import digest
    from compgs.training.run.profile import StepProfile

    with freed_memory_kept():
        trainer_in_mid_run(*made_scene(500, 64, 48)).train_step()  # loads the kernels
        trainer = trainer_in_mid_run(*made_scene(anchors, *SIZE))
        profile = StepProfile(warm_up=1, clock=time.process_time)
        profile.watch(trainer, trainer.PROFILED, trainer.stations)
        trainer.train_step()
        step, _ = measured(lambda: [trainer.train_step() for _ in range(steps)])
        found: dict[str, Any] = {
            "anchors": anchors,
            "step": step / steps,
            "parts": {part: ms / 1e3 for part, ms in profile.milliseconds().items()},
            "peak_mb": peak_mb(),
        }
        views = len(trainer.scene.train_views)
        rare: dict[str, tuple[float, float]] = {}
        rare["bounds of culling"] = measured(
            lambda: (trainer.survey.bounds.forget(), trainer.survey.bounds.radii())
        )
        rare["estimate of the size"] = measured(trainer.estimated_bytes)
        each = measured(lambda: trainer.survey.contributions(views))
        rare["contributions, a view"] = each[0] / views, each[1] / views
        rare["hash of the parameters"] = measured(
            lambda: [digest(tensor) for tensor in trainer.model.state_dict().values()]
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "checkpoint.safetensors"
            rare["checkpoint"] = measured(lambda: trainer.save(path))
            writer = Writer()
            rare["checkpoint beside the steps"] = measured(lambda: trainer.save(path, writer))
            writer.finish()
            found["checkpoint_mb"] = path.stat().st_size / 1e6
            rare["principal axes"] = measured(
                lambda: trainer.structure.turn_references(trainer.step, trainer.rate)
            )
            found["asking"] = int((trainer.control.gradient > 0).sum())
            trainer.control.drawn += 1000.0  # all have been seen often enough to be judged
            rare["growth"] = measured(lambda: trainer.structure.grow(trainer.step, trainer.rate))
            found["grown"] = trainer.model.anchors
            if encode:
                from compgs.codec import decode
                from compgs.codec import encode as write

                with torch.no_grad():
                    trainer.model.references.normal_(0, 2)  # as much to code as a trained scene has
                file = Path(folder) / "scene.cgs"
                rare["encoding"] = measured(lambda: write(trainer.model, file))
                found["file_mb"] = file.stat().st_size / 1e6
                rare["decoding"] = measured(lambda: decode(file))
    found |= {"rare": rare, "peak_of_all_mb": peak_mb(), "looked_at": LOOKED_AT}
    return found


def child(anchors: int, options: argparse.Namespace) -> dict[str, Any]:
    command = [sys.executable, __file__, "--job", str(anchors), "--steps", str(options.steps)]
    command += ["--encode"] if options.encode else []
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{anchors}: {done.stderr or f'ended with {done.returncode}'}")
    return json.loads(done.stdout)


def report(rows: list[dict[str, Any]]) -> None:
    import math

    def line(name: str, values: list[float], unit: float = 1.0) -> None:
        exponent = ""
        if len(rows) > 1 and min(values[-2:]) > 0:
            exponent = f"{math.log(values[-1] / values[-2]) / math.log(rows[-1]['anchors'] / rows[-2]['anchors']):.2f}"
        print(f"| {name} |", *(f"{value * unit:.3g} |" for value in values), f"{exponent} |")

    print("| processor seconds |", *(f"{row['anchors']} anchors |" for row in rows), "exponent |")
    print("|---|" + "---|" * (len(rows) + 1))
    for part in rows[0]["parts"]:
        line(part, [row["parts"].get(part, 0.0) for row in rows])
    line("**a step**", [row["step"] for row in rows])
    for name in rows[0]["rare"]:
        line(name, [row["rare"][name][0] for row in rows])
    for name in ("checkpoint", "checkpoint beside the steps"):
        line(f"{name}, waiting (wall)", [row["rare"][name][1] for row in rows])
    line("checkpoint, MB", [row["checkpoint_mb"] for row in rows])
    if "file_mb" in rows[0]:
        line("file, MB", [row["file_mb"] for row in rows])
    line("peak MB, steps", [row["peak_mb"] for row in rows])
    line("peak MB, all of it", [row["peak_of_all_mb"] for row in rows])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--anchors", type=int, action="append", default=[])
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--encode", action="store_true", help="also the file: minutes at 10^6 anchors")
    parser.add_argument("--output", type=Path, help="folder for million.json")
    parser.add_argument("--job", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        print(json.dumps(one_size(options.job, options.steps, encode=options.encode)))
        return
    rows = [child(anchors, options) for anchors in options.anchors or ANCHORS]
    report(rows)
    if options.output:
        path = options.output / "million.json"
        path.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
