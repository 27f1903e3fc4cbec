"""Bits and seconds for anchor positions, beside lzma on the same clouds and TMC13's published figures.

    python benchmarks/geometry.py cloud.npy [...] [--runs 5] [--json geometry.json] [--markdown geometry.md]

A cloud is an .npy file of distinct voxel coordinates, int32 [N, 3]. Seconds are the least of the runs on one
thread: elapsed, and in brackets those that the processor spent on this process (elapsed times of a busy
machine mean little, ratios within a run do). Where `tmc3` is on PATH, G-PCC is measured too.
"""

import argparse
import json
import lzma
import os
import platform
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgs.codec.mask_coder import decode_masks, encode_masks
from compgs.codec.octree import decode_positions, encode_positions
from compgs.codec.tmc3 import PROGRAM, decode_positions_tmc3, encode_positions_tmc3
from compgs.ordering.order import canonical_order, sorted_morton

T = TypeVar("T")

# Whole-file bits per anchor, lossless, measured once with TMC13 on the same clouds: with the paper's
# options, and the best of seven sets of options.
TMC13 = {"garden_sfm_v001": (14.315, 14.131), "garden_grown_v001": (14.828, 13.429)}


def timed(function: Callable[[], T], runs: int) -> tuple[T, list[float]]:
    """The result and [elapsed, processor] seconds, the least of the runs each."""
    seconds = []
    for _ in range(runs):
        start = time.perf_counter(), time.process_time()
        result = function()
        seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    return result, [min(s) for s in zip(*seconds, strict=True)]


def lzma_encoded(cloud: NDArray[np.int32]) -> bytes:
    """Differences of the sorted Morton codes, byte plane by byte plane."""
    _, codes, _ = sorted_morton(cloud)
    differences = np.diff(codes, prepend=0).astype("<i8").view(np.uint8).reshape(-1, 8)
    return lzma.compress(np.ascontiguousarray(differences.T).tobytes(), preset=9)


def lzma_decoded(data: bytes) -> NDArray[np.int64]:
    planes = np.frombuffer(lzma.decompress(data), np.uint8).reshape(8, -1)
    return np.cumsum(np.ascontiguousarray(planes.T).view("<i8").ravel())


def measure_cloud(path: Path, runs: int) -> dict[str, Any]:
    cloud = np.load(path)
    count = len(cloud)
    data, encode_s = timed(lambda: encode_positions(cloud), runs)
    back, decode_s = timed(lambda: decode_positions(data, count), runs)
    if not (back == cloud[canonical_order(cloud)]).all():
        raise SystemExit(f"{path.name}: the decoded cloud differs")
    packed, lzma_encode_s = timed(lambda: lzma_encoded(cloud), 1)
    _, lzma_decode_s = timed(lambda: lzma_decoded(packed), runs)
    coders: dict[str, dict[str, Any]] = {
        "octree": {"bytes": len(data), "encode_s": encode_s, "decode_s": decode_s},
        "lzma": {"bytes": len(packed), "encode_s": lzma_encode_s, "decode_s": lzma_decode_s},
    }
    if shutil.which(PROGRAM):
        theirs, encode_s = timed(lambda: encode_positions_tmc3(cloud), 1)
        _, decode_s = timed(lambda: decode_positions_tmc3(theirs, count), 1)
        coders["tmc3"] = {"bytes": len(theirs), "encode_s": encode_s, "decode_s": decode_s}
    for result in coders.values():
        result["bits_per_anchor"] = 8 * result["bytes"] / count
    return {"cloud": path.stem, "anchors": count, "coders": coders}


def measure_masks(anchors: int, coupled: int, runs: int) -> dict[str, Any]:
    """Independent flags, of which three of four are set: nothing to be gained, 0.8113 bits each at best."""
    mask = np.random.default_rng(0).random((anchors, coupled)) < 0.75
    data, encode_s = timed(lambda: encode_masks(mask), runs)
    back, decode_s = timed(lambda: decode_masks(data, anchors, coupled), runs)
    if not (back == mask).all():
        raise SystemExit("the decoded masks differ")
    return {
        "anchors": anchors,
        "coupled": coupled,
        "bits_per_flag": 8 * len(data) / mask.size,
        "encode_s": encode_s,
        "decode_s": decode_s,
    }


def seconds(pair: list[float]) -> str:
    return f"{pair[0]:.2f} ({pair[1]:.2f})"


def markdown(results: dict[str, Any], command: str) -> str:
    machine = f"Python {results['python']}, numpy {results['numpy']}, {results['cpus']} cores"
    if results["note"]:
        machine += f", {results['note']}"
    lines = [
        "# Anchor positions and masks",
        "",
        f"    {command}",
        "",
        f"{machine}. Seconds: elapsed, least of the runs, one thread; in brackets the processor's time.",
        "",
        "Bits per anchor, all bytes counted, lossless:",
        "",
        "| cloud | anchors | this coder | lzma of Morton codes | TMC13, paper | TMC13, best of 7 |",
        "|---|---|---|---|---|---|",
    ]
    for r in results["clouds"]:
        c = r["coders"]
        published = [f"{v:.3f}" for v in TMC13.get(r["cloud"], ())] or ["-", "-"]
        if "tmc3" in c:
            published[0] = f"{c['tmc3']['bits_per_anchor']:.3f} (this run)"
        bits = [
            f"**{c['octree']['bits_per_anchor']:.3f}**",
            f"{c['lzma']['bits_per_anchor']:.3f}",
            *published,
        ]
        lines.append(f"| {r['cloud']} | {r['anchors']} | " + " | ".join(bits) + " |")
    lines += [
        "",
        "TMC13's figures (with the paper's options, and the best of seven sets) were measured beforehand.",
        "",
        "| cloud | encode s | decode s | lzma encode s | lzma decode s |",
        "|---|---|---|---|---|",
    ]
    for r in results["clouds"]:
        times = [r["coders"][k][way] for k in ("octree", "lzma") for way in ("encode_s", "decode_s")]
        lines.append(f"| {r['cloud']} | " + " | ".join(map(seconds, times)) + " |")
    m = results["masks"]
    lines += [
        "",
        f"Masks of {m['anchors']} anchors x {m['coupled']} coupled primitives, independent, 3 of 4 set: "
        f"{m['bits_per_flag']:.4f} bits a flag (entropy 0.8113), encoded in {seconds(m['encode_s'])} s, "
        f"decoded in {seconds(m['decode_s'])} s.",
        "",
        f"The first call took {results['first_call_s']:.1f} s (kernels compiled, or found in numba's cache).",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", nargs="+", type=Path)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--note", default="", help="about the machine, for the table")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    few = np.array([[0, 0, 0], [1, 2, 3]], np.int32)
    _, first = timed(lambda: decode_positions(encode_positions(few), 2), 1)
    decode_masks(encode_masks(np.eye(3, dtype=np.bool_)), 3, 3)
    results = {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "cpus": os.cpu_count(),
        "note": options.note,
        "first_call_s": first[0],
        "clouds": [measure_cloud(path, options.runs) for path in options.clouds],
        "masks": measure_masks(300_000, 10, options.runs),
    }
    names = " ".join(path.name for path in options.clouds)
    text = markdown(results, f"python benchmarks/geometry.py {names} --runs {options.runs}")
    for target, body in ((options.json, json.dumps(results, indent=1) + "\n"), (options.markdown, text)):
        if target is not None:
            part = target.with_name(target.name + ".part")
            part.write_text(body, encoding="utf-8")
            os.replace(part, target)
    print(text)


if __name__ == "__main__":
    main()
