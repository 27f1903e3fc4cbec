"""The paper's ablations and more, on any scene: one command trains, encodes, decodes, evaluates and writes it down.

    python benchmarks/ablation.py components ../shared/scenes/plush_480 -r 2 --steps 4000 --seeds 0 1 2

| name | variants |
|---|---|
| components | Table 4: plain 3DGS; hybrid primitives without the rate term; the whole method |
| residuals | Table 5: coupled primitives without residual embeddings of their own, and with |
| coupled | K = 5, 10, 15 coupled primitives per anchor |
| bitstream | bytes and bits by component at lambda = 0.001, 0.005, 0.01 |
| curve | rate-distortion curves of the presets `paper` and `default`, lambda = 1e-6 to 1e-1, and their BD-rate |
| quantization | latents trained and stored rounded; the same seeds never rounded; and those rounded afterwards |

Every variant is a `compgs train` in a process of its own, and every number is that of its decoded file on the held-out
views; only the row "never rounded" is a model that no file holds, evaluated as it was trained. A variant that is
finished is not run again, nor is one that another study has run; one that was stopped continues: the runs, and a JSON
of each with command, settings, commit, machine and seconds, stay in --runs. Table (Markdown), figure and all JSON
together go to --output, as ablation_NAME_SCENE.*.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from ablation_figures import check_matplotlib, figure
from ablation_tables import Record, report, rows_of

from compgs.cli.main import parse as parse_compgs
from compgs.cli.run_folder import run_settings
from compgs.cli.train import Train
from compgs.outputs import write_bytes, write_json

ROOT = Path(__file__).resolve().parents[1]
LAMBDAS = (1e-6, 1e-5, 1e-4, 1e-3, 5e-3, 1e-2, 3e-2, 1e-1)


@dataclass(frozen=True)
class Variant:
    """One row of a table: what to add to `compgs train`."""

    name: str  # of its folder
    label: str  # in table and figure
    arguments: tuple[str, ...] = ()
    curve: str = ""  # variants of one curve share it
    unrounded: bool = False  # evaluate the trained model too, beside its file


def _set(*settings: str) -> tuple[str, ...]:
    return tuple(part for setting in settings for part in ("--set", setting))


STUDIES: dict[str, tuple[Variant, ...]] = {
    "components": (
        Variant("3dgs", "3DGS", ("--method", "3dgs")),
        Variant("hybrid", "hybrid primitives, no rate term", ("--lmbda", "0")),
        Variant("full", "hybrid primitives, rate term"),
    ),
    "residuals": (
        Variant("without", "without residual embeddings", _set("model.residuals=false")),
        Variant("with", "with residual embeddings", _set("model.residuals=true")),
    ),
    "coupled": tuple(
        Variant(f"k{k}", f"K = {k}", _set(f"model.coupled_primitives={k}")) for k in (5, 10, 15)
    ),
    "bitstream": tuple(
        Variant(f"lambda_{lmbda:g}", f"lambda = {lmbda:g}", ("--lmbda", f"{lmbda:g}"))
        for lmbda in (0.001, 0.005, 0.01)
    ),
    "curve": tuple(
        Variant(
            f"{preset}_{lmbda:g}",
            f"{preset}, lambda = {lmbda:g}",
            ("--preset", preset, "--lmbda", f"{lmbda:g}"),
            curve=preset,
        )
        for preset in ("paper", "default")
        for lmbda in LAMBDAS
    ),
    "quantization": (
        Variant("rounded", "trained and stored rounded"),
        Variant(
            "never_rounded",
            "trained unrounded, rounded for the file",
            _set("entropy.quantized=false", "training.phases=0.05,0.1,0.8,1,0.9"),
            unrounded=True,
        ),
    ),
}


# running ------------------------------------------------------------------------------------------------------------


def train_command(variant: Variant, scene: Path, folder: Path, common: Sequence[str], seed: int) -> list[str]:
    """Settings that all variants share come first: a variant's own override them."""
    shared = list(common)
    if "--preset" in variant.arguments and "--preset" in shared:
        at = shared.index("--preset")
        del shared[at : at + 2]
    return ["train", str(scene), "-o", str(folder), *shared, *variant.arguments, "--seed", str(seed)]


def settings_of(command: Sequence[str]) -> dict[str, Any]:
    """What a run trains, by what its config.json will say: method, scene and settings, in whatever words asked for."""
    train = parse_compgs(list(command))
    assert isinstance(train, Train) and train.output, f"no training: {command}"
    asked = train.settings(train.output)
    content = {"method": asked.method, "scene": asdict(asked.scene), "settings": asked.config.to_dict()}
    return json.loads(json.dumps(content))


def finished(variant: Variant, command: Sequence[str], folder: Path) -> Record | None:
    """What is known of a training with the same settings, this variant's or another's of any study in the same runs.

    A setting that an older record lacks counts as its default, which is what the program did before there was it.
    """
    wanted = run_settings({"preset": "", **settings_of(command)}, variant.name)
    own = folder.with_name(folder.name + ".json")
    others = sorted(path for path in folder.parent.parent.glob("*/*.json") if path != own)
    for path in [own, *others]:
        known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        if variant.unrounded and "unrounded" not in known:
            continue
        if not known.get("settings"):
            continue
        if replace(run_settings(known["settings"], str(path)), preset="") == wanted:
            shown = {"variant": variant.name, "label": variant.label, "curve": variant.curve}
            return {**known, **shown}
    return None


def run_variant(
    variant: Variant, command: list[str], folder: Path, seed: int, run: Callable[[list[str]], None]
) -> Record:
    """Train, unless that has been done; `run` runs `compgs` with arguments. Raises what it raises."""
    record = folder.with_name(folder.name + ".json")
    known = finished(variant, command, folder)
    if known is not None:
        return known
    start = time.time()
    commit = git_commit()
    # A run that another version of the program began, or one with other settings, does not become this one.
    begins = {"command": command, "commit": commit, **settings_of(command)}
    before = folder / "begun.json"
    resumable = _json(before) == begins and (folder / "checkpoint.safetensors").is_file()
    if resumable:
        run(["train", "-o", str(folder), "--resume"])
    else:
        # The folder may hold what a run with other settings left.
        write_json(before, begins)
        run([*command, "--overwrite"])
    result: Record = {
        "variant": variant.name,
        "label": variant.label,
        "curve": variant.curve,
        "seed": seed,
        "command": command,
        "commit": commit,
        "machine": machine(),
        "resumed": resumable,
        "seconds": time.time() - start,
        "settings": _json(folder / "config.json"),
        "training": {k: v for k, v in (_json(folder / "training.json") or {}).items() if k != "curve"},
        "results": json.loads((folder / "results.json").read_text(encoding="utf-8")),
    }
    if variant.unrounded:
        result["unrounded"] = evaluate_unrounded(folder)
    write_json(record, result)
    return result


def evaluate_unrounded(folder: Path) -> dict[str, float]:
    """PSNR and SSIM of a run's model as it was trained, on the held-out views: no file, no rounding of anything."""
    from compgs import metrics
    from compgs.cli.run_folder import load_settings
    from compgs.render import render
    from compgs.scene import load_scene
    from compgs.training import load_run

    source = load_settings(folder).scene
    scene = load_scene(
        Path(source.path),
        downscale=source.downscale,
        images=source.images,
        test_every=source.test_every,
        split=source.split,
        background=source.background,
    )
    model = load_run(folder).as_hybrid_model(stored_weights=False)
    images = [metrics.to_8bit(render(model, view.camera).image) for view in scene.test_views]
    pairs = list(zip(images, (view.image for view in scene.test_views), strict=True))
    return {
        "psnr": fmean(metrics.psnr(a, b) for a, b in pairs),
        "ssim": fmean(metrics.ssim(a, b) for a, b in pairs),
    }


def run_compgs(arguments: list[str]) -> None:
    """Raises SystemExit with the program's message above it."""
    done = subprocess.run([sys.executable, "-m", "compgs", *arguments], check=False)
    if done.returncode:
        raise SystemExit(f"compgs {' '.join(arguments)}: exit code {done.returncode}")


def git_commit() -> str:
    """Of the program; with "+changes" if files differ from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False
        )
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "src", "benchmarks")
    return (git("rev-parse", "--short", "HEAD") or "unknown") + ("+changes" if changed else "")


def machine() -> dict[str, Any]:
    """Processor, cores, and the threads that were allowed."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": os.environ.get("NUMBA_NUM_THREADS", "all"),
    }


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


# the command --------------------------------------------------------------------------------------------------------


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=list(STUDIES))
    parser.add_argument("--only", nargs="+", metavar="VARIANT", help="some of the variants")
    add_training_options(parser, ROOT / "runs" / "ablation")
    return parser.parse_args(arguments)


def add_training_options(parser: argparse.ArgumentParser, runs: Path) -> None:
    """The scene, where its trainings (by default in `runs`) and tables go, and what `common_arguments` passes on."""
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--runs", type=Path, default=runs, help="folder for the trainings")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, help="default: the preset's")
    parser.add_argument("--preset", help="default: the default one, or what a variant brings")
    parser.add_argument("-r", "--downscale", type=int, default=1)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--lpips", action="store_true")
    parser.add_argument("--flip", action="store_true")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="of all variants"
    )


def common_arguments(options: argparse.Namespace) -> list[str]:
    """Arguments of `compgs train` that all variants share."""
    given = {"--preset": options.preset, "--steps": options.steps, "--threads": options.threads}
    result = ["-r", str(options.downscale)]
    for name, value in given.items():
        result += [name, str(value)] if value is not None else []
    return [
        *result,
        *_set(*options.set),
        *(f"--{name}" for name in ("lpips", "flip") if getattr(options, name)),
    ]


def main(arguments: Sequence[str] | None = None, run: Callable[[list[str]], None] = run_compgs) -> None:
    options = parse(arguments)
    scene = options.scene.resolve()
    chosen = [v for v in STUDIES[options.name] if not options.only or v.name in options.only]
    if not chosen:
        known = ", ".join(v.name for v in STUDIES[options.name])
        raise SystemExit(f"--only {' '.join(options.only)}: {options.name} has {known}")
    check_matplotlib()
    records = []
    for seed in options.seeds:  # the seeds outside: stopped early, there is a whole table of fewer seeds
        for variant in chosen:
            folder = options.runs / options.name / f"{scene.name}_{variant.name}_seed{seed}"
            command = train_command(variant, scene, folder, common_arguments(options), seed)
            print(f"== {variant.label}, seed {seed}: {folder}", flush=True)
            records.append(run_variant(variant, command, folder, seed, run))
    records.sort(key=lambda record: [v.name for v in chosen].index(record["variant"]))
    rows = rows_of(records)
    stem = options.output / f"ablation_{options.name}_{scene.name}"
    given = sys.argv[1:] if arguments is None else arguments
    text = report(
        options.name, scene.name, records, f"python benchmarks/ablation.py {' '.join(map(str, given))}"
    )
    write_bytes(stem.with_suffix(".md"), text.encode())
    write_json(stem.with_suffix(".json"), {"rows": [asdict(row) for row in rows], "records": records})
    write_bytes(stem.with_suffix(".png"), figure(options.name, scene.name, rows))
    print(text)


if __name__ == "__main__":
    main()
