"""Rendering a decoded file: time to load, time of a frame by part, memory against the size of the decoded model.

    python benchmarks/rendering.py [--anchors 50000 | --file scene.cgs --scene capture] [--threads 2] [--output f.json]

Without a file, a made-up scene is encoded first: anchors on surfaces, random embeddings, four of five coupled
primitives kept. With one, `--scene` is the capture whose held-out views are rendered, at their own size. Decoding and
rendering are processes of their own; both handle a tiny file first, so that neither time nor memory is that of
loading kernels.
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import compgs  # noqa: F401  # before torch: its threads must not spin

TINY = 200  # anchors
KEPT = 0.8  # share of coupled primitives that exist


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def megabytes(*tensors: Any) -> float:
    return sum(t.numel() * t.element_size() for t in tensors) / 1e6


def model_mb(model: Any) -> float:
    """What decoding hands over."""
    p = model.primitives
    return megabytes(
        p.positions, p.log_scales, p.references, p.residuals, p.anchor_index, *model.heads.parameters()
    )


def cameras(options: argparse.Namespace) -> list[Any]:
    if options.scene:
        from compgs.scene import load_scene

        return [view.camera for view in load_scene(options.scene, downscale=options.downscale).test_views]
    from compgs.scene.generated import camera_path

    return camera_path(8, options.width, options.height)


def make(options: argparse.Namespace) -> dict[str, Any]:
    """Write a made-up scene."""
    import torch
    from made_scene import made_scene

    from compgs.codec.encoder import encode
    from compgs.training.trainer import initial_model

    model = initial_model(*made_scene(options.anchors, options.width, options.height))
    noise = torch.Generator().manual_seed(0)
    with torch.no_grad():
        model.references += torch.randn(model.references.shape, generator=noise)
        model.residuals += torch.randn(model.residuals.shape, generator=noise)
    model.mask = torch.rand(model.mask.shape, generator=noise) < KEPT
    encode(model, options.file)
    return {}


def decode(options: argparse.Namespace) -> dict[str, Any]:
    from compgs.codec.decoder import decode

    decode(options.tiny)
    before = peak_mb()
    seconds, model = timed(lambda: decode(options.file))
    return {
        "seconds": seconds,
        "model_mb": model_mb(model),
        "growth_mb": peak_mb() - before,
        "peak_mb": peak_mb(),
    }


def render(options: argparse.Namespace) -> dict[str, Any]:
    import numba
    import torch

    from compgs.codec.decoder import decode
    from compgs.render import RasterSettings, rasterize, render, visible_mask

    torch.set_num_threads(options.threads)
    numba.set_num_threads(options.threads)
    views = cameras(options)
    render(decode(options.tiny), views[0])
    before = peak_mb()
    load, model = timed(lambda: decode(options.file))
    decoding = peak_mb()
    geometry, _ = timed(lambda: model.bounds)
    first, _ = timed(lambda: render(model, views[0]))
    settings = RasterSettings(background=model.background)
    parts: dict[str, list[float]] = {"frame": [], "culling": [], "opacity and color": [], "rasterization": []}
    shares, drawn = [], []
    processor = time.process_time()
    for i in range(options.frames):
        parts["frame"].append(timed(lambda: render(model, views[i % len(views)]))[0])  # noqa: B023
    processor = time.process_time() - processor
    growth = peak_mb() - before
    for i in range(options.frames):
        camera = views[i % len(views)]
        with torch.no_grad():
            t, visible = timed(lambda: visible_mask(*model.bounds, camera, settings))  # noqa: B023
            parts["culling"].append(t)
            t, gaussians = timed(lambda: model.gaussians(camera, visible))  # noqa: B023
            parts["opacity and color"].append(t)
            t, _ = timed(lambda: rasterize(gaussians, camera, settings))  # noqa: B023
            parts["rasterization"].append(t)
        shares.append(float(visible.float().mean()))
        drawn.append(len(gaussians.means))
    geometry_mb = megabytes(*model.geometry, *model.bounds[1:])
    return {
        "anchors": model.anchors,
        "coupled": model.coupled,
        "file_bytes": options.file.stat().st_size,
        "width": views[0].width,
        "height": views[0].height,
        "visible": sum(shares) / len(shares),
        "drawn": sum(drawn) / len(drawn),
        "load_s": load,
        "geometry_s": geometry,
        "first_frame_s": first,
        "ms": {name: 1e3 * sorted(values)[len(values) // 2] for name, values in parts.items()},
        "cpu_ms": 1e3 * processor / options.frames,
        "frames_per_second": options.frames / sum(parts["frame"]),
        "model_mb": model_mb(model),
        "geometry_mb": geometry_mb,
        "decoding_growth_mb": decoding - before,
        "growth_mb": growth,
    }


JOBS = {"make": make, "decode": decode, "render": render}


def child(job: str, options: argparse.Namespace, **changed: Any) -> dict[str, Any]:
    values = vars(options) | changed
    names = ("anchors", "file", "tiny", "scene", "downscale", "width", "height", "frames", "threads")
    arguments = [f"--{name}={values[name]}" for name in names if values[name] is not None]
    command = [sys.executable, __file__, "--job", job, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise SystemExit(f"{job}: {result.stderr or f'ended with {result.returncode}'}")
    return json.loads(result.stdout)


def report(results: dict[str, Any]) -> None:
    r, d = results["render"], results["decode"]
    print(f"{r['anchors']} anchors, {r['coupled']} coupled primitives, {r['file_bytes']} bytes, ", end="")
    print(f"{r['width']}x{r['height']}, {results['machine']['threads']} threads")
    print(f"in a view: {r['visible']:.0%} of the anchors, {r['drawn']:.0f} primitives drawn")
    print(
        f"\ndecoding {r['load_s']:.2f} s, geometry {r['geometry_s']:.2f} s, first frame {r['first_frame_s']:.2f} s"
    )
    print(f"**{r['frames_per_second']:.1f} frames a second**\n\n| part | ms |\n|---|---|")
    for name, value in r["ms"].items():
        print(f"| {name} | {value:.1f} |")
    print(f"| processor time of a frame | {r['cpu_ms']:.1f} |")
    whole = r["model_mb"] + r["geometry_mb"]
    print("\n| | of it kept, MB | peak growth, MB | ratio |\n|---|---|---|---|")
    print(f"| decoding | {d['model_mb']:.1f} | {d['growth_mb']:.1f} | {d['growth_mb'] / d['model_mb']:.2f} |")
    print(f"| decoding and rendering | {whole:.1f} | {r['growth_mb']:.1f} | {r['growth_mb'] / whole:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--anchors", type=int, default=50_000)
    parser.add_argument("--file", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--downscale", type=int, default=1, help="of the capture's images")
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--height", type=int, default=360)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--output", type=Path, help="also write the figures as JSON")
    parser.add_argument("--tiny", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--job", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        print(json.dumps(JOBS[options.job](options)))
        return
    if options.file and not options.scene:
        parser.error("--file needs --scene: the views to render")
    with tempfile.TemporaryDirectory() as folder:
        options.tiny = Path(folder) / "tiny.cgs"
        child("make", options, anchors=TINY, file=options.tiny, scene=None)
        if not options.file:
            options.file = Path(folder) / "made.cgs"
            child("make", options)
        results: dict[str, Any] = {job: child(job, options) for job in ("decode", "render")}
    results["machine"] = {
        "cores": os.cpu_count(),
        "threads": options.threads,
        "python": platform.python_version(),
    }
    report(results)
    if options.output:
        options.output.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
