"""Several trainings side by side, on a machine that is there for minutes; what each leaves is kept as it ends.

    python tools/device_runs.py build/runs --seconds 480 \\
        "truck=train scenes/truck" "truck_small=train scenes/truck --steps 18000 --lmbda 1e-3"

A training of this program keeps a GPU half idle, so several at once use it better. Each part is NAME=ARGUMENTS of
compgs; its run is FOLDER/runs/NAME, its output FOLDER/NAME.txt, its file is copied to FOLDER/NAME.cgs at once. Those
that have not ended after --seconds are stopped as Ctrl-C stops them: they save a checkpoint.
"""

import argparse
import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Collection
from pathlib import Path

SAVING = 30  # seconds for a checkpoint, after which a run is killed


def start(name: str, arguments: str, folder: Path) -> subprocess.Popen[bytes]:
    """Start one command; what it says goes to a file of its own."""
    command = [sys.executable, "-m", "compgs", *shlex.split(arguments), "-o", str(folder / "runs" / name)]
    with open(folder / f"{name}.txt", "wb") as said:
        return subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)


def stop(running: Collection[subprocess.Popen[bytes]]) -> None:
    """Stop runs so that all of them save at once; kill what takes too long."""
    end = time.monotonic() + SAVING
    for each in running:
        each.send_signal(signal.SIGTERM)
    for each in running:
        try:
            each.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            each.kill()
            each.wait()


def run_all(parts: dict[str, str], folder: Path, seconds: float) -> list[dict[str, object]]:
    """Run all commands at once, each at most so long, and return a line on each, in the order in which they ended."""
    begun = time.monotonic()
    left = {name: start(name, arguments, folder) for name, arguments in parts.items()}
    lines: list[dict[str, object]] = []
    while left:
        late = time.monotonic() - begun > seconds
        if late:
            stop(left.values())
        for name, running in list(left.items()):
            if running.poll() is None:
                continue
            made = folder / "runs" / name / f"{name}.cgs"
            if made.is_file():
                shutil.copy(made, folder)
            took = round(time.monotonic() - begun, 1)
            ended = {"name": name, "code": running.returncode, "seconds": took, "file": made.is_file()}
            lines.append({**ended, "in time": not late})
            print(json.dumps(lines[-1]), flush=True)
            del left[name]
        time.sleep(0.2)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="what to write; must not exist")
    parser.add_argument(
        "parts", nargs="+", metavar="NAME=ARGUMENTS", help="a command of compgs, without its -o"
    )
    parser.add_argument("--seconds", type=float, required=True, help="after which the rest is stopped")
    given = parser.parse_args()
    if given.folder.exists():
        sys.exit(f"{given.folder}: exists already; choose another folder or remove it")
    unnamed = [part for part in given.parts if not part.partition("=")[0].isidentifier()]
    parts = dict(part.split("=", 1) for part in given.parts if "=" in part)
    if unnamed or len(parts) < len(given.parts):
        sys.exit(f"expected NAME=ARGUMENTS with names that differ, found {unnamed or given.parts}")
    (given.folder / "runs").mkdir(parents=True)
    lines = run_all(parts, given.folder, given.seconds)
    sys.exit(0 if all(line["code"] == 0 for line in lines) else 1)


if __name__ == "__main__":
    main()
