"""Points from a plane sweep: time and memory of each part, before a training of a large capture.

    python benchmarks/plane_sweep.py scenes/truck [-r 2] [--every 3] [--pixels 8] [--threads 1]

Each line is a part of `compgs.stereo`: its seconds, of how many calls, the peak of resident memory while it ran, and
what the process holds after it. The last line has the number of points and a hash of their positions and colors:
the same photographs give the same hash. Memory is that of the whole process, decoded photographs included.
"""

import argparse
import hashlib
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import compgs  # before torch: its threads must not spin

PARTS = ("looks_of", "sight_of", "neighbours_of", "swept", "agreed", "thinned")
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def memory(name: str) -> float:
    """MB (10^6 bytes): VmRSS now, VmHWM the most since `CLEAR` was written."""
    lines = STATUS.read_text().splitlines()
    return next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(name + ":"))


class Measured:
    """A function, its calls measured."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds, self.calls, self.peak, self.after = function, 0.0, 0, 0.0, 0.0

    def __call__(self, *args: Any) -> Any:
        CLEAR.write_text("5")
        start = time.perf_counter()
        result = self.function(*args)
        self.seconds += time.perf_counter() - start
        self.calls += 1
        self.peak, self.after = max(self.peak, memory("VmHWM")), memory("VmRSS")
        return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("-r", dest="downscale", type=int, default=1)
    parser.add_argument("--every", type=int, default=1, help="take every n-th training view")
    parser.add_argument("--pixels", type=float, default=8.0, help="between two points")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()

    import torch

    from compgs.stereo import dense_points

    torch.set_num_threads(args.threads)
    module = sys.modules[dense_points.__module__]
    scene = compgs.load_scene(args.scene, downscale=args.downscale)
    scene = replace(scene, train_views=scene.train_views[:: args.every])
    parts = {name: Measured(getattr(module, name)) for name in PARTS}
    for name, part in parts.items():
        setattr(module, name, part)
    print(f"{len(scene.train_views)} views, {memory('VmRSS'):.0f} MB before", flush=True)
    start = time.perf_counter(), time.process_time()
    points = dense_points(scene, args.pixels / args.downscale, torch.device("cpu"))
    seconds, processor = time.perf_counter() - start[0], time.process_time() - start[1]
    print("| part | calls | s | peak, MB | after, MB |\n|---|---:|---:|---:|---:|")
    for name, part in parts.items():
        print(f"| `{name}` | {part.calls} | {part.seconds:.1f} | {part.peak:.0f} | {part.after:.0f} |")
    known = hashlib.sha256(points.positions.tobytes() + points.colors.tobytes()).hexdigest()[:16]
    print(
        f"{seconds:.0f} s, {processor:.0f} s of processor time; {memory('VmRSS'):.0f} MB after; "
        f"{len(points):,} points {known}"
    )


if __name__ == "__main__":
    main()
