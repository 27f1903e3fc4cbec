"""What the first command on a machine costs: nothing is compiled yet.

    python benchmarks/cold_start.py            wall and processor seconds of each job, with all cores and with one
    python benchmarks/cold_start.py --kernels  and of each kernel
    python benchmarks/cold_start.py --list     writes the list of what helpers compile: src/compgs/numerics/kernels.json

Each job is a new process with an empty folder of kernels. It begins when Python does, imports included; the work
itself takes a fraction of a second, on a scene that is made for it. Processor seconds are those of the job's process,
without its helpers'; on one core there are none. On a busy machine they tell more than the wall does.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

JOBS = {
    "decode": "a file is decoded",
    "render": "... and its first frame rendered",
    "train": "the first step of a training",
    "encode": "a model is written (after a training step)",
}


def decode(folder: Path) -> None:
    import compgs

    compgs.decode(folder / "scene.cgs", "cpu")


def render(folder: Path) -> None:
    import compgs

    camera = compgs.load_scene(folder / "scene").test_views[0].camera
    compgs.render(compgs.decode(folder / "scene.cgs", "cpu"), camera)


def train(folder: Path) -> Any:
    import compgs
    from compgs.cli.settings import with_settings
    from compgs.config import load_config

    scene = compgs.load_scene(folder / "scene")
    settings = (
        f"training.steps={os.environ.get('STEPS', '1')}",
        "training.phases=0.05,0.2,0.8,0.8,0.9",
        "control.start=0.2",
    )
    return compgs.train(scene, with_settings(load_config("default"), settings), device="cpu")


def encode(folder: Path) -> None:
    import compgs

    compgs.encode(train(folder), folder / "again.cgs", overwrite=True)


def job(name: str, folder: Path, started: float) -> None:
    """Prints what it took, and every kernel that was compiled, in JSON."""
    from numba.core import event

    from compgs.numerics.ahead import entry_of, start_helpers

    kernels: list[dict[str, Any]] = []
    inner = [0.0]  # seconds of the kernels that each kernel under way has called for
    starts: list[float] = []

    class Recorder(event.Listener):
        def on_start(self, event: Any) -> None:
            starts.append(time.thread_time())
            inner.append(0.0)

        def on_end(self, event: Any) -> None:
            elapsed = time.thread_time() - starts.pop()
            seconds = elapsed - inner.pop()
            inner[-1] += elapsed
            kernel, arguments = event.data["dispatcher"], event.data["args"]
            if kernel.__module__.startswith("compgs."):
                kernels.append({"entry": entry_of(kernel, arguments), "seconds": seconds})

    event.register("numba:compile", Recorder())
    stages = {"render": ("decode", "render"), "encode": ("train", "encode")}.get(name, (name,))
    start_helpers(*stages)
    {"decode": decode, "render": render, "train": train, "encode": encode}[name](folder)
    used = {"wall": time.time() - started, "processor": time.process_time()}
    print(json.dumps(used | {"kernels": kernels}))


def measured(name: str, folder: Path, *, one_core: bool, steps: int = 1) -> dict[str, Any]:
    """What a job says about itself, in a new process with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, __file__, "--job", name, "--folder", str(folder)]
        if one_core and hasattr(os, "sched_setaffinity"):
            core = min(os.sched_getaffinity(0))
            code = f"import os; os.sched_setaffinity(0, {{{core}}}); os.execv({command[0]!r}, {command!r})"
            command = [sys.executable, "-c", code]
        environment = os.environ | {
            "NUMBA_CACHE_DIR": cache,
            "STARTED": str(time.time()),
            "STEPS": str(steps),
        }
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        return json.loads(done.stdout.splitlines()[-1])


def prepare(folder: Path) -> None:
    """A scene and a file of it."""
    from compgs.cli.main import main

    assert (
        main(["demo-scene", str(folder / "scene"), "--views", "12", "--width", "96", "--height", "72"]) == 0
    )
    assert main(["train", str(folder / "scene"), "-o", str(folder / "run"), "--steps", "60"]) == 0
    (folder / "run" / "run.cgs").rename(folder / "scene.cgs")


def write_list(folder: Path) -> None:
    """Of all kernels that the stages compile, as they are first completed."""
    from compgs.numerics import ahead

    # As many steps of training as reach the rate and the control of density, too.
    alone = {name: measured(name, folder, one_core=True, steps=60)["kernels"] for name in JOBS}
    entries = {name: [ahead.Entry(*kernel["entry"]) for kernel in kernels] for name, kernels in alone.items()}
    entries["render"] = [e for e in entries["render"] if e not in entries["decode"]]
    entries["encode"] = [e for e in entries["encode"] if e not in entries["train"]]
    ahead.write_list(entries)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kernels", action="store_true")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--only", choices=JOBS)
    parser.add_argument("--folder", type=Path, help="of an earlier preparation, or for a new one")
    parser.add_argument("--job", choices=JOBS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        job(options.job, options.folder, float(os.environ["STARTED"]))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        if not (folder / "scene.cgs").is_file():
            prepare(folder)
        if options.list:
            write_list(folder)
            return
        for name in [options.only] if options.only else JOBS:
            together = measured(name, folder, one_core=False)
            alone = measured(name, folder, one_core=True)
            print(
                f"{name:8} all cores: {together['wall']:5.1f} s, of these {together['processor']:5.1f} s processor; "
                f"one core: {alone['wall']:5.1f} s, {alone['processor']:5.1f} s processor: {JOBS[name]}",
                flush=True,
            )
            if options.kernels:
                for kernel in sorted(alone["kernels"], key=lambda k: -k["seconds"]):
                    print(f"    {kernel['seconds']:5.2f} s  {kernel['entry'][0]}.{kernel['entry'][1]}")


if __name__ == "__main__":
    main()
