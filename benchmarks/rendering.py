"""Rendering a decoded file: time to load, time of a frame by part, memory against the size of the decoded model.

    python benchmarks/rendering.py [--anchors 50000 300000 | --file scene.cgs --scene capture] [--threads 2]
        [--output f.json]

Without a file, made-up scenes are encoded first: anchors on surfaces, random embeddings, four of five coupled
primitives kept. With one, `--scene` is the capture whose held-out views are rendered, at their own size, also with the
networks of opacity and color in half precision. Decoding and rendering are processes of their own; both handle a tiny
file first, so that neither time nor memory is that of loading kernels.
"""

import argparse
import importlib
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import compgs  # noqa: F401  # before torch: its threads must not spin

TINY = 200  # anchors
KEPT = 0.8  # share of coupled primitives that exist
# Where a frame's time goes: part, module and function.
PARTS = (
    ("culling", "compgs.render.render_model", "visible_mask"),
    ("networks", "compgs.model.prediction_kernels", "paired_appearance"),
    ("gathering what is drawn", "compgs.model.prediction_kernels", "gather_drawn"),
    ("projection", "compgs.render.rasterize", "project_forward"),
    ("binning: tiles of each splat", "compgs.render.rasterize", "pack_splats"),
    ("binning: lists of each tile", "compgs.render.rasterize", "list_tiles"),
    ("blending", "compgs.render.rasterize", "blend"),
)


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


class Stopwatch:
    """Milliseconds a frame of some functions of a module's namespace, from call to return."""

    def __init__(self) -> None:
        self.ms: dict[str, list[float]] = {}
        for part, module, name in PARTS:
            place = importlib.import_module(module)
            setattr(place, name, self.around(part, getattr(place, name)))

    def around(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        times = self.ms[part] = []

        def measured(*args: Any, **kwargs: Any) -> Any:
            seconds, result = timed(lambda: function(*args, **kwargs))
            times[-1] += 1e3 * seconds  # of the frame
            return result

        return measured

    def next_frame(self) -> None:
        for times in self.ms.values():
            times.append(0.0)


def median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def megabytes(*arrays: Any) -> float:
    return sum(array.nbytes for array in arrays) / 1e6


def model_mb(model: Any) -> float:
    """What decoding hands over."""
    p = model.primitives
    return megabytes(
        p.positions, p.log_scales, p.references, p.residuals, p.anchor_index, *model.heads.tensors.values()
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
    from compgs.training.start import initial_model

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

    from compgs.codec.decoder import decode
    from compgs.render import RasterSettings, render, visible_mask

    numba.set_num_threads(options.threads)
    views = cameras(options)
    render(decode(options.tiny), views[0])
    before = peak_mb()
    load, model = timed(lambda: decode(options.file))
    decoding = peak_mb()
    geometry, _ = timed(lambda: model.bounds)
    first, _ = timed(lambda: render(model, views[0]))
    frames: list[float] = []
    processor = time.process_time()
    for i in range(options.frames):
        frames.append(timed(lambda: render(model, views[i % len(views)]))[0])  # noqa: B023
    processor = time.process_time() - processor
    growth = peak_mb() - before
    watch = Stopwatch()
    for i in range(options.frames):
        watch.next_frame()
        render(model, views[i % len(views)])
    parts = {part: median(times) for part, times in watch.ms.items()}
    watch.next_frame()
    shares, drawn = [], []
    for view in views:
        visible = visible_mask(*model.bounds, view, RasterSettings())
        shares.append(float(visible.mean()))
        drawn.append(len(model.gaussians(view, visible)))
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
        "frame_ms": 1e3 * median(frames),
        "parts_ms": {part: ms for part, ms in parts.items() if ms},
        "cpu_ms": 1e3 * processor / options.frames,
        "frames_per_second": options.frames / sum(frames),
        "model_mb": model_mb(model),
        "geometry_mb": geometry_mb,
        "decoding_growth_mb": decoding - before,
        "growth_mb": growth,
    }


def precision(options: argparse.Namespace) -> dict[str, Any]:
    """PSNR of the held-out views by the type in which the networks of opacity and color compute."""
    import torch

    from compgs.codec.decoder import decode
    from compgs.metrics import psnr, to_8bit
    from compgs.render import render
    from compgs.scene import load_scene
    from compgs.tensors.scenes import HybridOnDevice

    views = load_scene(options.scene, downscale=options.downscale).test_views
    model = decode(options.file)
    found = {}
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        rough = replace(HybridOnDevice.of(model, torch.device("cpu")), appearance_dtype=dtype)
        values = [psnr(to_8bit(render(rough, v.camera).image), v.image) for v in views]
        found[str(dtype).removeprefix("torch.")] = sum(values) / len(values)
    return found


JOBS = {"make": make, "decode": decode, "render": render, "precision": precision}


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
    print(f"| frame, median | {r['frame_ms']:.1f} |")
    for name, value in r["parts_ms"].items():
        print(f"| {name} | {value:.1f} |")
    print(f"| processor time of a frame | {r['cpu_ms']:.1f} |")
    whole = r["model_mb"] + r["geometry_mb"]
    print("\n| | decoded model, MB | peak growth, MB | ratio |\n|---|---|---|---|")
    print(f"| decoding | {d['model_mb']:.1f} | {d['growth_mb']:.1f} | {d['growth_mb'] / d['model_mb']:.2f} |")
    for name, size in (("with geometry", whole), ("without geometry", r["model_mb"])):
        print(
            f"| decoding and rendering, {name} | {size:.1f} | {r['growth_mb']:.1f} | {r['growth_mb'] / size:.2f} |"
        )
    if "precision" in results:
        print("\n| opacity and color in | PSNR, dB |\n|---|---|")
        for dtype, value in results["precision"].items():
            print(f"| {dtype} | {value:.4f} |")
    print()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--anchors", type=int, nargs="+", default=[50_000])
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
        options.anchors = options.anchors[0]
        print(json.dumps(JOBS[options.job](options)))
        return
    if options.file and not options.scene:
        parser.error("--file needs --scene: the views to render")
    with tempfile.TemporaryDirectory() as folder:
        options.tiny = Path(folder) / "tiny.cgs"
        child("make", options, anchors=TINY, file=options.tiny, scene=None)
        machine = {"cores": os.cpu_count(), "threads": options.threads, "python": platform.python_version()}
        every = []
        for anchors in [None] if options.file else options.anchors:
            file = options.file or Path(folder) / f"{anchors}.cgs"
            if not options.file:
                child("make", options, anchors=anchors, file=file)
            jobs = ["decode", "render", *(["precision"] if options.file else [])]
            results: dict[str, Any] = {job: child(job, options, anchors=anchors, file=file) for job in jobs}
            every.append(results | {"machine": machine})
            report(every[-1])
    if options.output:
        options.output.write_text(json.dumps(every, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
