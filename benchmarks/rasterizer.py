"""How near the CPU rasterizer is to the machine's limit.

    python benchmarks/rasterizer.py [--threads 2] [--gaussians 100000] [--width 512] [--height 512]

Times binning + forward and backward of random splats against a hand-vectorized C++ version of the same algorithm
(yardstick/rasterizer.cpp, compiled here with g++), in turns within one run, and against the rate of a bare
multiply-add loop. Fastest of the repeats; on a machine with other work only the ratios mean something.
"""

import argparse
import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import compgs  # noqa: F401  (before torch: its threads must not spin)

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
parser.add_argument("--gaussians", type=int, default=100_000)
parser.add_argument("--width", type=int, default=512)
parser.add_argument("--height", type=int, default=512)
parser.add_argument("--radius", type=float, default=4.5, help="mean three-sigma radius in pixels")
parser.add_argument("--repeats", type=int, default=15)
options = parser.parse_args()
os.environ["NUMBA_NUM_THREADS"] = str(options.threads)

import numpy as np  # noqa: E402
import torch  # noqa: E402

from compgs.cameras import Camera  # noqa: E402
from compgs.render.binning import bin_splats  # noqa: E402
from compgs.render.projection import camera_numbers  # noqa: E402
from compgs.render.settings import DEFAULT_SETTINGS  # noqa: E402
from compgs.tensors.numba_backend import Blend, Project  # noqa: E402

# Counted in tiles.py: one pixel of one splat, an fma as two, comparisons and selections as none.
FORWARD_FLOPS = 2 + 7 + 13 + 2 + 6  # offset, exponent, exp2, transmittance, color
BACKWARD_FLOPS = 2 + 7 + 13 + 2 + 5 + 2 + 5 + 17  # .., color . gradient, behind, dL/dalpha, sums
FLAGS = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC"]


def random_splats(count: int, width: int, height: int, radius: float) -> dict[str, torch.Tensor]:
    """Splats as after projection: log-normal radii, axes up to 1 : 3, a wide range of opacities."""
    r = np.random.default_rng(0)
    means = np.stack([r.uniform(0, width, count), r.uniform(0, height, count)], -1)
    major = r.lognormal(np.log(radius / 3) - 0.5 * 0.5**2, 0.5, count)
    minor, angle = major * r.uniform(0.3, 1, count), r.uniform(0, np.pi, count)
    cos, sin = np.cos(angle), np.sin(angle)
    xx, yy = (cos * major) ** 2 + (sin * minor) ** 2 + 0.3, (sin * major) ** 2 + (cos * minor) ** 2 + 0.3
    xy = cos * sin * (major**2 - minor**2)
    arrays = {
        "means2d": means,
        "covariances": np.stack([xx, xy, yy], -1),
        "determinants": xx * yy - xy * xy,
        "depths": r.uniform(1, 10, count),
        "opacities": 1 / (1 + np.exp(-r.normal(-0.8, 1.6, count))),
        "colors": r.uniform(0, 1, (count, 3)),
    }
    return {name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()}


def compile_yardstick(folder: Path) -> ctypes.CDLL | None:
    """The C++ version, or None without a compiler."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    library = folder / "rasterizer.so"
    source = Path(__file__).parent / "yardstick" / "rasterizer.cpp"
    subprocess.run([compiler, *FLAGS, str(source), "-o", str(library)], check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.yardstick_fma.restype = ctypes.c_double
    loaded.yardstick_binning_seconds.restype = ctypes.c_double
    loaded.yardstick_fma.argtypes = [ctypes.c_int, ctypes.c_int64]
    return loaded


def pointers(*arrays: torch.Tensor) -> list[ctypes.c_void_p]:
    return [ctypes.c_void_p(array.data_ptr()) for array in arrays]


def seconds(action: Callable[[], object]) -> float:
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def main() -> None:
    torch.set_num_threads(options.threads)
    n, width, height = options.gaussians, options.width, options.height
    splats = random_splats(n, width, height, options.radius)
    camera = Camera(np.eye(4), 500.0, 500.0, width / 2, height / 2, width, height)
    generator = torch.Generator().manual_seed(0)
    grad_image = torch.randn(height, width, 3, generator=generator)
    grad_transmittance = torch.randn(height, width, generator=generator)
    learned = [splats[k].requires_grad_() for k in ("means2d", "covariances", "opacities", "colors")]
    fixed = [splats["depths"], splats["determinants"]]
    inputs = [
        splats[k].detach()
        for k in ("means2d", "covariances", "determinants", "depths", "opacities", "colors")
    ]

    def numba_forward() -> tuple[torch.Tensor, torch.Tensor]:
        for tensor in learned:
            tensor.grad = None
        image, transmittance, _ = Blend.apply(*learned, *fixed, camera, DEFAULT_SETTINGS)
        return image, transmittance

    times: dict[str, list[float]] = {}

    def record(name: str, value: float) -> None:
        times.setdefault(name, []).append(value)

    with tempfile.TemporaryDirectory() as folder:
        yardstick = compile_yardstick(Path(folder))
        image_cpp, transmittance_cpp = torch.empty(height, width, 3), torch.empty(height, width)
        grads_cpp = [torch.empty_like(tensor) for tensor in learned]
        for _ in range(options.repeats + 1):
            begin = time.perf_counter()
            image, transmittance = numba_forward()
            middle = time.perf_counter()
            torch.autograd.backward((image, transmittance), (grad_image, grad_transmittance))
            record("numba forward", middle - begin)
            record("numba backward", time.perf_counter() - middle)
            record(
                "numba binning",
                seconds(lambda: bin_splats(*(t.numpy() for t in inputs), width, height, DEFAULT_SETTINGS)),
            )
            if yardstick is None:
                continue
            outputs = pointers(image_cpp, transmittance_cpp)
            call = (options.threads, n, width, height, *pointers(*inputs), *outputs)
            record("C++ forward", seconds(lambda call=call: yardstick.yardstick_forward(*call)))
            record("C++ binning", yardstick.yardstick_binning_seconds())
            call = pointers(
                image_cpp, transmittance_cpp, grad_image, grad_transmittance, inputs[4], *grads_cpp
            )
            record("C++ backward", seconds(lambda call=call: yardstick.yardstick_backward(*call)))
            record("peak", yardstick.yardstick_fma(options.threads, 300_000))

        if yardstick is not None:
            assert (image - image_cpp).abs().max() < 2 / 255, "the two versions disagree"
            for tensor, other in zip(learned, grads_cpp, strict=True):
                assert (tensor.grad - other).norm() < 1e-2 * tensor.grad.norm(), "the two versions disagree"
    best = {name: min(values[1:]) for name, values in times.items() if name != "peak"}  # the first compiles
    peak = max(times.get("peak", [0.0]))

    # Only what precedes a tile's end was blended.
    state = image.grad_fn
    lists, ends = state.lists, state.ends
    used = np.concatenate([lists.entries[a:b, 1] for a, b in zip(lists.starts, ends, strict=False)])
    pixels = 8 * int(((used & 255) - (used >> 8) + 1).sum())
    print(f"{n} splats at {width}x{height}, {options.threads} threads, fastest of {options.repeats}")
    print(f"{len(used)} of {len(lists.entries)} entries blended, {pixels / 1e6:.1f} million pixels of splats")
    print(f"{'':20}{'numba ms':>10}{'C++ ms':>10}{'ratio':>8}{'GFLOP/s':>10}{'of peak':>9}")
    rows = [("binning", 0), ("forward", FORWARD_FLOPS), ("backward", BACKWARD_FLOPS)]
    for name, flops in [*rows, ("total", FORWARD_FLOPS + BACKWARD_FLOPS)]:
        parts = ["forward", "backward"] if name == "total" else [name]
        ours = sum(best[f"numba {part}"] for part in parts)
        line = f"{name + (', with binning' if name == 'forward' else ''):20}{1e3 * ours:10.1f}"
        if yardstick is not None:
            theirs = sum(best[f"C++ {part}"] for part in parts)
            rate = pixels * flops / ours / 1e9
            line += f"{1e3 * theirs:10.1f}{ours / theirs:8.2f}"
            line += f"{rate:10.1f}{rate / peak:9.1%}" if flops else ""
        print(line)
    print(f"peak of a multiply-add loop: {peak:.0f} GFLOP/s" if yardstick else "no g++: no yardstick")
    print_projection(camera)


def print_projection(camera: Camera) -> None:
    r = np.random.default_rng(0)
    n = options.gaussians
    means = r.normal(0, 0.5, (n, 3)) + np.array([0, 0, 4])
    arrays = (means, r.normal(size=(n, 4)), np.exp(r.normal(-4, 0.4, (n, 3))))
    leaves = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays]
    numbers, grads = camera_numbers(camera, DEFAULT_SETTINGS), (torch.randn(n, 2), torch.randn(n, 3))

    def both() -> None:
        for leaf in leaves:
            leaf.grad = None
        means2d, covariances, _, _ = Project.apply(*leaves, numbers)
        torch.autograd.backward((means2d, covariances), grads)

    both()
    best = min(seconds(both) for _ in range(options.repeats))
    print(f"projection, forward + backward: {1e3 * best:.1f} ms")


if __name__ == "__main__":
    main()
