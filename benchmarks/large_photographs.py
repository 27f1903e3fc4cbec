"""Large photographs: time and memory until the first step, and how long a photograph is waited for in later ones.

    python benchmarks/large_photographs.py [--views 16] [--megapixels 12 --megapixels 50] [-r 1 -r 4]

The photographs are generated JPEGs (quality 90) of a smooth picture with noise, about 3 bits a pixel, as cameras write
them; the poses are a ring around a cloud of 5 000 points. Each line is a process of its own, so that its peak of memory
is its own. Nothing is extrapolated: what was run is what is printed.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import compgs  # before torch: its threads must not spin

POINTS = 5_000


def make_capture(folder: Path, views: int, megapixels: float) -> int:
    """Photographs of 4:3 in nerfstudio's layout; bytes of one."""
    import numpy as np
    from PIL import Image

    from compgs.scene.generated import camera_path

    height = round((megapixels * 1e6 * 3 / 4) ** 0.5)
    width = round(megapixels * 1e6 / height)
    rng = np.random.default_rng(0)
    coarse = Image.fromarray(rng.integers(0, 256, (24, 32, 3), dtype=np.uint8))
    smooth = np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC)).astype(np.int16)
    noisy = np.clip(smooth + rng.integers(-12, 13, smooth.shape, dtype=np.int16), 0, 255).astype(np.uint8)
    (folder / "images").mkdir(parents=True)
    first = folder / "images" / "0000.jpg"
    Image.fromarray(noisy).save(first, quality=90)
    frames = []
    for number, camera in enumerate(camera_path(views, width, height)):
        name = f"images/{number:04d}.jpg"
        if number:
            (folder / name).write_bytes(first.read_bytes())
        pose = np.linalg.inv(np.asarray(camera.world_to_camera)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": width, "h": height}
    (folder / "transforms.json").write_text(
        json.dumps({**lens, "camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": frames}),
        encoding="utf-8",
    )
    positions = rng.uniform(-1.0, 1.0, (POINTS, 3))
    lines = [f"{x:.5f} {y:.5f} {z:.5f} 128 128 128" for x, y, z in positions]
    head = ["ply", "format ascii 1.0", f"element vertex {POINTS}"]
    head += [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    (folder / "points.ply").write_text("\n".join([*head, "end_header", *lines]) + "\n", encoding="ascii")
    return first.stat().st_size


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def until_the_first_step(folder: Path, downscale: int, steps: int) -> dict[str, Any]:
    import torch

    from compgs.config import Config
    from compgs.scene.image_cache import MOST_BYTES
    from compgs.training.trainer import Trainer

    before = peak_mb()
    start, processor = time.perf_counter(), time.process_time()
    scene = compgs.load_scene(folder, downscale=downscale)
    loaded, loaded_processor, loaded_peak = time.perf_counter(), time.process_time(), peak_mb()
    trainer = Trainer(scene, Config(), torch.device("cpu"))
    trainer.train_step()
    first, first_processor = time.perf_counter(), time.process_time()
    waits = []
    photograph = trainer.views.stored
    trainer.views.stored = lambda view: (
        lambda t: (photograph(view), waits.append(time.process_time() - t))[0]
    )(time.process_time())
    for _ in range(steps):
        trainer.train_step()
    camera = scene.train_views[0].camera
    views = len(scene.train_views) + len(scene.test_views)
    return {
        "size": f"{camera.width}x{camera.height}",
        "decoded_at_once": 3 * views * camera.width * camera.height <= MOST_BYTES,
        "loading": loaded_processor - processor,
        "loading_wall": loaded - start,
        "first_step": first_processor - processor,
        "first_step_wall": first - start,
        "wait": sum(waits) / max(1, len(waits)),
        "step": (time.process_time() - first_processor) / steps,
        "loading_mb": loaded_peak - before,
        "peak_mb": peak_mb(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--megapixels", type=float, action="append", default=[])
    parser.add_argument("-r", "--downscale", type=int, action="append", default=[])
    parser.add_argument("--steps", type=int, default=4, help="measured after the first")
    parser.add_argument("--job", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        print(json.dumps(until_the_first_step(options.job, options.downscale[0], options.steps)))
        return
    print(
        "| photographs | -r | trained at | decoded | loading s | MB of it | first step s | a photograph s | a step s |",
        end="",
    )
    print(" peak MB |\n|---|---|---|---|---|---|---|---|---|---|")
    for megapixels in options.megapixels or [12.0, 50.0]:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "capture"
            size = make_capture(folder, options.views, megapixels)
            for downscale in options.downscale or [1, 4, 8]:
                command = [sys.executable, __file__, "--job", str(folder), "-r", str(downscale)]
                command += ["--steps", str(options.steps)]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
                if done.returncode:
                    raise SystemExit(done.stderr)
                f = json.loads(done.stdout)
                print(
                    f"| {options.views} of {megapixels:g} MP, {size / 1e6:.1f} MB each | {downscale} | {f['size']} | "
                    f"{'at once' if f['decoded_at_once'] else 'when looked at'} | "
                    f"{f['loading']:.1f} ({f['loading_wall']:.1f}) | {f['loading_mb']:.0f} | "
                    f"{f['first_step']:.1f} ({f['first_step_wall']:.1f}) | {f['wait']:.2f} | {f['step']:.2f} | "
                    f"{f['peak_mb']:.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
