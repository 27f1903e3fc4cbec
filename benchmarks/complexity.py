"""The paper's table of complexity, in kind: training, encoding, decoding and rendering, by time and by memory.

    python benchmarks/complexity.py ../shared/scenes/plush_480 -r 2 --steps 4000

Presets `paper` and `default`, and plain 3DGS. Every phase runs in a process of its own (`complexity_phases.py` says
what each covers), first all of them once with few steps, so that no kernel is compiled while something is measured.
Run it on a machine that does nothing else. A method that is finished is not measured again by the same commit with the
same settings: runs and figures stay in --runs. Writes complexity_SCENE.md and .json to --output.
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ablation import ROOT, common_arguments, git_commit, machine

from compgs.outputs import write_bytes, write_json

PHASES_PROGRAM = Path(__file__).with_name("complexity_phases.py")
# Enough for everything that a training does to have been done.
WARM_UP_STEPS = 60


@dataclass(frozen=True)
class Method:
    """One row of the table."""

    name: str
    arguments: tuple[str, ...]  # of `compgs train`


METHODS = (
    Method("paper", ("--preset", "paper")),
    Method("default", ("--preset", "default")),
    Method("3dgs", ("--method", "3dgs")),
)
PHASES = ("train", "encode", "decode", "evaluate", "render")
# Those whose memory is shown; `evaluate` only says what the file is worth.
MEASURED = {"train": "training", "encode": "encoding", "decode": "decoding", "render": "rendering"}

NOTES = """\
- Training: from a scene in memory to a trained model, checkpoints included. Encoding: from the model to the file on
  disk; of plain 3DGS that is a .ply. Decoding: from the file to a model that can be rendered. Encoding and decoding are
  medians of five calls after a first one.
- A view: until the 8-bit image of a held-out camera is in main memory; the median of five calls, then the mean over
  the cameras.
- Each phase ran in a process of its own, after a short run of all phases: nothing was compiled while it was measured.
  A training loads the kernels that were compiled before; that is part of its time.
- Primitives are what is rendered: coupled primitives, or splats.
- MB are 10^6 bytes. Before a phase begins the process holds the program, its libraries, and what the phase works on:
  photographs, trained model, or decoded file."""

Figures = dict[str, dict[str, Any]]  # by phase
RunPhase = Callable[[str, Path, Sequence[str]], dict[str, Any]]


# measuring ----------------------------------------------------------------------------------------------------------


def run_phase(phase: str, folder: Path, command: Sequence[str]) -> dict[str, Any]:
    """In a process of its own. Raises SystemExit with what it said if it fails."""
    words = [sys.executable, str(PHASES_PROGRAM), phase, str(folder), *command]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{phase} of {folder.name}: exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def train_command(method: Method, scene: Path, folder: Path, options: argparse.Namespace) -> list[str]:
    """The run as `compgs train` would be asked for it."""
    shared = common_arguments(
        argparse.Namespace(**vars(options), preset=None, set=[], lpips=False, flip=False)
    )
    device = ["--device", options.device] if options.device else []
    seed = ["--seed", str(options.seed)]
    return ["train", str(scene), "-o", str(folder), *shared, *method.arguments, *seed, *device]


def measure(method: Method, scene: Path, options: argparse.Namespace, run: RunPhase) -> Figures:
    """All phases of a method, unless that has been done; those of a short run before them."""
    folder = options.runs / f"{scene.name}_{method.name}"
    command = train_command(method, scene, folder, options)
    short = folder.with_name(f"{folder.name}_warm_up")
    few_steps = argparse.Namespace(**{**vars(options), "steps": WARM_UP_STEPS})
    begins = {"command": command, "commit": git_commit(), "machine": machine()}
    written = folder.with_name(f"{folder.name}.json")
    known = json.loads(written.read_text(encoding="utf-8")) if written.is_file() else {}
    # With changes to the commit, nobody knows whether they are the same ones.
    if {key: known.get(key) for key in begins} == begins and "+" not in begins["commit"]:
        return known["phases"]
    print(f"== {method.name}: a short run of everything, for the kernels", flush=True)
    for phase in PHASES:
        run(phase, short, train_command(method, scene, short, few_steps))
    phases = {}
    for phase in PHASES:
        print(f"== {method.name}: {phase}", flush=True)
        phases[phase] = run(phase, folder, command)
    write_json(written, {**begins, "phases": phases})
    return phases


# writing ------------------------------------------------------------------------------------------------------------


def time_table(rows: dict[str, Figures]) -> str:
    """Markdown: what the paper's table has, and what was got for it."""
    head = ["", "training, min", "a step, ms", "encoding, ms", "decoding, ms", "a view, ms", "frames/s"]
    head += ["bytes", "anchors", "primitives", "PSNR, dB"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, phases in rows.items():
        results, training = phases["evaluate"], phases["train"]
        primitives = results["splats"] or results["coupled_primitives"]
        cells = [
            name,
            f"{training['seconds'] / 60:.2f}",
            f"{1e3 * training['seconds_per_step']:.1f}",
            *(f"{1e3 * phases[phase]['seconds']:.1f}" for phase in ("encode", "decode", "render")),
            f"{phases['render']['frames_per_second']:.0f}",
            f"{results['bytes']:,}",
            "none" if results["anchors"] is None else f"{results['anchors']:,}",
            f"{primitives:,}",
            f"{results['psnr']:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def memory_table(rows: dict[str, Figures]) -> str:
    """Markdown: peak of each phase, and how much of it was there before; on a GPU its peak, too."""
    gpu = any("gpu_peak_mb" in phases["train"] for phases in rows.values())
    head = [
        "peak memory, MB (of it before)",
        *MEASURED.values(),
        *(f"{m}, GPU" for m in MEASURED.values() if gpu),
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, phases in rows.items():
        cells = [f"{phases[p]['peak_mb']:,.0f} ({phases[p]['before_mb']:,.0f})" for p in MEASURED]
        cells += [f"{phases[p]['gpu_peak_mb']:,.0f}" for p in MEASURED if gpu]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines)


def report(scene: str, rows: dict[str, Figures], command: str) -> str:
    """The Markdown file."""
    first = next(iter(rows.values()))
    results, m = first["evaluate"], machine()
    steps = ", ".join(dict.fromkeys(str(phases["train"]["steps"]) for phases in rows.values()))
    return "\n\n".join(
        [
            f"# Complexity: {scene}",
            f"`{command}`",
            f"{steps} steps; {results['views']} held-out views, {results['width']} x "
            f"{results['height']} pixels; commit {git_commit()}; {m['processor']}, {m['cores']} cores, "
            f"{results['threads']} threads, computed on {results['device']}.",
            time_table(rows),
            memory_table(rows),
            NOTES,
            "",
        ]
    )


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "complexity", help="folder for the runs")
    parser.add_argument("--only", nargs="+", choices=[method.name for method in METHODS])
    parser.add_argument("-r", "--downscale", type=int, default=1)
    parser.add_argument("--steps", type=int, help="default: each preset's own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--device", help="cpu or cuda; default: a GPU where there is one")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None, run: RunPhase = run_phase) -> None:
    options = parse(arguments)
    scene = options.scene.resolve()
    chosen = [method for method in METHODS if not options.only or method.name in options.only]
    rows = {method.name: measure(method, scene, options, run) for method in chosen}
    given = sys.argv[1:] if arguments is None else arguments
    text = report(scene.name, rows, f"python benchmarks/complexity.py {shlex.join(given)}")
    stem = options.output / f"complexity_{scene.name}"
    facts = {"scene": scene.name, "commit": git_commit(), "machine": machine()}
    write_bytes(stem.with_name(f"{stem.name}.md"), text.encode())
    write_json(stem.with_name(f"{stem.name}.json"), {**facts, "rows": rows})
    print(text)


if __name__ == "__main__":
    main()
