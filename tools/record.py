"""Keeps what a run measured as a record, from which tools/figures.py makes the figures of the pages.

    python tools/record.py runs/truck truck --title Truck --command "compgs train scenes/truck --steps 8000"

Writes docs/results/records/truck.json: the run's settings, plan, times and results, the command, the commit and the
machine. The folder of a later `compgs evaluate --lpips` may be named by --evaluation: its results are taken instead.
"""

import argparse
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from compgs.outputs import write_json

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "docs" / "results" / "records"
SCHEMA = "compgs record 1"


def record(run: Path, evaluation: Path, **told: Any) -> dict[str, Any]:
    """Return the record of a finished run."""
    config, training = _json(run / "config.json"), _json(run / "training.json")
    training.pop("curve", None)  # every hundredth step: long, and no figure of a page
    return {
        "schema": SCHEMA,
        **told,
        "preset": config["preset"],
        "downscale": config["scene"]["downscale"],
        "settings": config["settings"],
        "plan": config["plan"],
        "training": training,
        "results": _json(evaluation / "results.json"),
    }


def processor() -> str:
    """Return the processor's name, where Linux says it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )


def commit() -> str:
    """Return the short hash of the checkout's commit."""
    command = ["git", "rev-parse", "--short=7", "HEAD"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="the folder that `compgs train` left")
    parser.add_argument("name", help="of the record")
    parser.add_argument("--title", required=True, help="what the tables call the capture")
    parser.add_argument("--page", default="captures.md", help="page in docs/results that says more")
    parser.add_argument("--note", default="", help="what else was running")
    parser.add_argument("--command", required=True, help="as somebody else would type it")
    parser.add_argument("--evaluation", type=Path, help="folder of `compgs evaluate -o`, if it measured more")
    parser.add_argument("--commit", default=None, help="of the program that ran (default: this checkout's)")
    asked = parser.parse_args()
    told = {
        "name": asked.name,
        "title": asked.title,
        "page": asked.page,
        "command": asked.command,
        "commit": asked.commit or commit(),
        "machine": {"processor": processor(), "cores": os.cpu_count()},
        "note": asked.note,
    }
    RECORDS.mkdir(exist_ok=True)
    write_json(RECORDS / f"{asked.name}.json", record(asked.run, asked.evaluation or asked.run, **told))


if __name__ == "__main__":
    main()
