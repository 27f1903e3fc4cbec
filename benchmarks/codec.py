"""The codec's speed and memory on a made-up scene, beside constriction on the same symbols in the same run.

    python benchmarks/codec.py [--anchors 300000] [--blocks 0] [--output codec.json]

--blocks: residual blocks of the entropy networks; 0 is one linear layer.

Each line is a process of its own, so that peak memory is its own. "compiling" starts with an empty kernel
cache (the first call after installation), "cold" is the first call of a process that finds its kernels,
"warm" the best of five. "CPU" is the processor time of a warm call, all threads together: it shows what a
busy machine hides.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

CONSTRICTION_SYMBOLS = 2_000_000


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def warm(function: Callable[[], Any]) -> dict[str, float]:
    """Best wall clock and processor seconds of five calls."""
    walls, processor = [], []
    for _ in range(5):
        before = time.process_time()
        walls.append(timed(function)[0])
        processor.append(time.process_time() - before)
    return {"warm_s": min(walls), "cpu_s": min(processor)}


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def make(path: Path, anchors: int, blocks: int) -> dict[str, Any]:
    """Write the scene that the other processes read."""
    from made_content import make_content

    from compgs.codec.writer import write_content

    path.write_bytes(write_content(make_content(anchors, 0, blocks=blocks, hidden=32)))
    return {}


def encode(path: Path) -> dict[str, Any]:
    from compgs.codec.reader import read_content
    from compgs.codec.writer import write_content

    data = path.read_bytes()
    content = read_content(data)
    before = peak_mb()
    cold, again = timed(lambda: write_content(content))
    assert again == data, "encoding a decoded file must give its bytes again"
    return {
        "cold_s": cold,
        **warm(lambda: write_content(content)),
        "peak_mb": peak_mb(),
        "peak_before_mb": before,
    }


def decode(path: Path) -> dict[str, Any]:
    from compgs.codec.reader import read_latents

    data = path.read_bytes()
    before = peak_mb()
    cold, _ = timed(lambda: read_latents(data))
    return {
        "cold_s": cold,
        **warm(lambda: read_latents(data)),
        "peak_mb": peak_mb(),
        "peak_before_mb": before,
    }


def parts(path: Path) -> dict[str, Any]:
    """Sizes by section, and seconds of the parts of decoding."""
    from compgs.codec.content import (
        Role,
        conditional_tables,
        cross_entropy_bits,
        existing_symbols,
        surroundings,
    )
    from compgs.codec.mask_coder import decode_masks, encode_masks
    from compgs.codec.octree import decode_positions, encode_positions
    from compgs.codec.rans import decode_symbols, encode_symbols
    from compgs.codec.reader import file_info, group_names, read_latents
    from compgs.ordering.order import canonical_order

    data = path.read_bytes()
    content, latents = read_latents(data)
    info = file_info(data)
    seconds: dict[str, float] = {}

    def best(name: str, function: Callable[[], Any]) -> Any:
        runs = [timed(function) for _ in range(3)]
        seconds[name] = min(run[0] for run in runs)
        return runs[0][1]

    positions = best("encode positions", lambda: encode_positions(content.coordinates))
    best("decode positions", lambda: decode_positions(positions, info.anchors))
    best("order of anchors", lambda: canonical_order(content.coordinates))
    masks = best("encode masks", lambda: encode_masks(content.mask))
    best("decode masks", lambda: decode_masks(masks, *content.mask.shape))
    residual = content.group(Role.RESIDUAL)
    places = best("contexts of coordinates", lambda: surroundings(content.coordinates).places)
    _, index, tables = best(
        "residual network",
        lambda: conditional_tables(residual.shape, residual.prior, latents, places, content.mask),
    )
    index, symbols = index.ravel(), existing_symbols(residual, content.mask).ravel()
    stream = best("encode residual symbols", lambda: encode_symbols(symbols, index, tables))
    best("decode residual symbols", lambda: decode_symbols(stream, index, tables))
    bits = cross_entropy_bits(content)
    coded = {s.name: s.bytes for s in info.sections}
    ours = sum(coded[name] for name in group_names(info.dimensions))
    return {
        "bytes": info.bytes,
        "sections": coded,
        "anchors": info.anchors,
        "coupled": info.coupled,
        "ranges": [[r.level, r.anchors, r.bytes] for r in info.ranges],
        "symbols": sum(existing_symbols(group, content.mask).size for group in content.groups),
        "residual_symbols": len(symbols),
        "overhead_percent": (8 * ours / sum(bits) - 1) * 100,
        "seconds": seconds,
    }


def beside_constriction(path: Path) -> dict[str, Any]:
    """The first two million reference symbols through both coders, ours with one thread and with all."""
    import constriction
    import numba
    import numpy as np

    from compgs.codec.content import Role, conditional_tables, surroundings
    from compgs.codec.rans import decode_symbols, encode_symbols
    from compgs.codec.reader import read_latents
    from compgs.codec.tables import gaussian_tables

    content, latents = read_latents(path.read_bytes())
    group, places = content.group(Role.REFERENCE), surroundings(content.coordinates).places
    _, index, _ = conditional_tables(group.shape, group.prior, latents, places, content.mask)
    index = np.ascontiguousarray(index.ravel()[:CONSTRICTION_SYMBOLS])
    symbols = np.ascontiguousarray(group.symbols.ravel()[:CONSTRICTION_SYMBOLS])
    means, scales = np.zeros(len(index)), 2.0 ** (index / 12 - 5)
    model = constriction.stream.model.QuantizedGaussian(-1000, 1000)
    coder = constriction.stream.stack.AnsCoder()
    theirs_encode, _ = timed(lambda: coder.encode_reverse(symbols, model, means, scales))
    theirs_bytes = coder.num_bits() / 8
    theirs_decode, decoded = timed(lambda: coder.decode(model, means, scales))
    assert (decoded == symbols).all()
    result: dict[str, Any] = {
        "symbols": len(symbols),
        "constriction": {"bytes": theirs_bytes, "encode_s": theirs_encode, "decode_s": theirs_decode},
    }
    for threads in sorted({1, numba.get_num_threads()}):
        numba.set_num_threads(threads)
        data = encode_symbols(symbols, index, gaussian_tables())
        e = min(timed(lambda: encode_symbols(symbols, index, gaussian_tables()))[0] for _ in range(3))
        d = min(timed(lambda: decode_symbols(data, index, gaussian_tables()))[0] for _ in range(3))  # noqa: B023
        result[f"{threads} threads"] = {"bytes": len(data), "encode_s": e, "decode_s": d}
    return result


def first_encode(path: Path) -> dict[str, Any]:
    """A tiny scene, whose kernels are the same, made and written: it cannot be made without some of them."""
    from made_content import make_content

    from compgs.codec.writer import write_content

    return {"cold_s": timed(lambda: write_content(make_content(20, 0)))[0]}


def first_decode(path: Path) -> dict[str, Any]:
    from compgs.codec.reader import read_latents

    return {"cold_s": timed(lambda: read_latents(path.read_bytes()))[0]}


JOBS = {"encode": encode, "decode": decode, "parts": parts, "constriction": beside_constriction}


def child(
    job: str, path: Path, options: Sequence[str] = (), environment: dict[str, str] | None = None
) -> dict[str, Any]:
    command = [sys.executable, __file__, "--job", job, "--file", str(path), *options]
    result = subprocess.run(
        command, env=os.environ | (environment or {}), capture_output=True, text=True, check=False
    )
    if result.returncode:
        raise SystemExit(f"{job}: {result.stderr}")
    return json.loads(result.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--anchors", type=int, default=300_000)
    parser.add_argument("--blocks", type=int, default=0)
    parser.add_argument("--output", type=Path, help="also write the figures as JSON")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        others = {"make": make, "first encode": first_encode, "first decode": first_decode}
        job = others.get(options.job) or JOBS[options.job]
        made = (options.anchors, options.blocks) if options.job == "make" else ()
        print(json.dumps(job(options.file, *made)))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.cgs"
        child("make", path, ["--anchors", str(options.anchors), "--blocks", str(options.blocks)])
        results = {job: child(job, path) for job in JOBS}
        for job in ("encode", "decode"):
            empty = {"NUMBA_CACHE_DIR": str(Path(folder) / job)}
            results[f"compiling {job}"] = child(f"first {job}", path, environment=empty)
    results["machine"] = {"cores": os.cpu_count(), "python": platform.python_version()}
    report(results)
    if options.output:
        options.output.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def report(results: dict[str, Any]) -> None:
    p, c = results["parts"], results["constriction"]
    millions = p["symbols"] / 1e6
    print(f"{p['anchors']} anchors, {p['coupled']} coupled, {millions:.1f} M symbols, {p['bytes']} bytes")
    print("\n| | first call, compiling | cold | warm | CPU | M symbols/s | peak MB | of it before |")
    print("|---|---|---|---|---|---|---|---|")
    for job in ("encode", "decode"):
        r = results[job]
        compiling = results[f"compiling {job}"]["cold_s"]
        print(
            f"| {job} | {compiling:.1f} s | {r['cold_s']:.2f} s | {r['warm_s']:.2f} s | {r['cpu_s']:.2f} s | "
            f"{millions / r['warm_s']:.1f} | {r['peak_mb']:.0f} | {r['peak_before_mb']:.0f} |"
        )
    print("\n| part | seconds |\n|---|---|")
    for name, value in p["seconds"].items():
        print(f"| {name} | {value:.3f} |")
    print(f"\nentropy coding: {p['overhead_percent']:.3f} % above the cross-entropy of the integer tables")
    print("\n| coder | bytes | encode M symbols/s | decode M symbols/s | encode ratio | decode ratio |")
    print("|---|---|---|---|---|---|")
    theirs = c["constriction"]
    for name in ("constriction", *(k for k in c if k.endswith("threads"))):
        r = c[name]
        print(
            f"| {name} | {r['bytes']:.0f} | {c['symbols'] / r['encode_s'] / 1e6:.1f} | "
            f"{c['symbols'] / r['decode_s'] / 1e6:.1f} | {theirs['encode_s'] / r['encode_s']:.1f} | "
            f"{theirs['decode_s'] / r['decode_s']:.1f} |"
        )
    print("\n| up to octree level | anchors | bytes of the file |\n|---|---|---|")
    for level, anchors, size in p["ranges"]:
        print(f"| {level} | {anchors} | {size} |")
    print("\n| section | bytes | bits per anchor |\n|---|---|---|")
    for name, value in p["sections"].items():
        print(f"| {name} | {value} | {8 * value / p['anchors']:.3f} |")


if __name__ == "__main__":
    main()
