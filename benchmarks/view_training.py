"""What `compgs train --viewer` costs a training that is looked at, beside one that is not.

    python benchmarks/view_training.py ../shared/scenes/plush_480 -r 2 --steps 600

Trainings on one thread, alternately without a viewer and with one in which a headless Chromium turns the scene all the
time. Processor seconds are those of the training's process, the pictures for the visitor included: that is what a
visitor costs. Seconds on the wall are those of training.json; where Chromium has no graphics card it draws on the same
cores as the training, whatever cores it is told to keep to, and they tell what that costs.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))
from viewer.devtools import tab  # noqa: E402

WIDTH, HEIGHT = 640, 480  # of the visitor's window


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("-r", type=int, default=1)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--times", type=int, default=3)
    options = parser.parse_args()
    browser = shutil.which("chromium")
    if browser is None:
        raise SystemExit("no chromium on PATH")
    command = [sys.executable, "-m", "compgs", "train", str(options.scene), "-r", str(options.r)]
    command += ["--steps", str(options.steps), "--threads", "1"]
    found: dict[str, list[tuple[float, float]]] = {"alone": [], "looked at": []}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(options.times):
            found["alone"].append(trained(command, Path(folder), None))
            found["looked at"].append(trained(command, Path(folder), browser))
    print("| | seconds of training | processor seconds of the process |")
    print("|---|---|---|")
    for name, pairs in found.items():
        walls, processors = zip(*pairs, strict=True)
        told = [f"{median(each):.1f} ({min(each):.1f} to {max(each):.1f})" for each in (walls, processors)]
        print(f"| {name} | {told[0]} | {told[1]} |")


def trained(command: list[str], folder: Path, browser: str | None) -> tuple[float, float]:
    """Seconds of training, and processor seconds of its process."""
    run = folder / "run"
    more = ["-o", str(run), "--overwrite", *(["--viewer", "--viewer-port", "0"] if browser else [])]
    before = os.times()
    process = subprocess.Popen(
        [*command, *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    if browser:
        address = next(filter(None, (re.search(r"http://\S+", line) for line in process.stdout)))[0]
        with tab(browser, Path(tempfile.mkdtemp(dir=folder)), WIDTH, HEIGHT) as page:
            page.open(address)
            at = 0
            while process.poll() is None:
                at = (at + 40) % 300
                page.drag((150 + at, 200), (190 + at, 215))
            process.communicate()
            after = os.times()  # before Chromium is waited for, whose seconds are not the training's
    else:
        process.communicate()
        after = os.times()
    assert process.returncode == 0, command
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    return json.loads((run / "training.json").read_text())["seconds"], processor


if __name__ == "__main__":
    main()
