"""Everything that must hold on a GPU, as one command for a machine that is there for minutes.

    python tools/device_check.py -o build/device_check                     # CUDA against the CPU
    python tools/device_check.py -o build/check --device cpu --quick       # the same stages, the CPU on both sides

Each stage runs in a process of its own, with a time limit of its own, and writes one line of JSON to stages.jsonl: what
hangs or fails costs itself alone. The order is such that an early end loses least. `--stages` chooses some.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
ROOT = Path(__file__).resolve().parent.parent

STAGES: dict[str, tuple[int, Callable[["Given"], dict[str, Any]]]] = {}  # seconds allowed, what it does


@dataclass(frozen=True)
class Given:
    """What the command was given."""

    device: str
    out: Path
    scene: Path | None  # a large capture
    small: Path | None  # a small one, for figures beside the CPU's
    seconds: int  # for which the large capture is trained
    quick: bool  # fewer steps: whether a stage runs at all


def stage(seconds: int) -> Callable[[Callable[[Given], dict[str, Any]]], Callable[[Given], dict[str, Any]]]:
    """Register a stage and the seconds that it may take."""

    def register(function: Callable[[Given], dict[str, Any]]) -> Callable[[Given], dict[str, Any]]:
        STAGES[function.__name__] = (seconds, function)
        return function

    return register


@stage(60)
def versions(given: Given) -> dict[str, Any]:
    """Say what is installed, and that everything can be imported."""
    import importlib

    names = ("torch", "numba", "numpy", "scipy", "safetensors", "tyro", "gsplat")
    found: dict[str, Any] = {"python": sys.version.split()[0]}
    for name in names:
        try:
            found[name] = getattr(importlib.import_module(name), "__version__", "there")
        except ImportError as error:
            found[name] = f"missing: {error}"
    import torch

    from compgs.devices import choose

    found["gpu"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    choice = choose(None)
    return {**found, "chosen": choice.name, "reason": choice.reason, "cores": os.cpu_count()}


@stage(300)
def kernels(given: Given) -> dict[str, Any]:
    """Compile or load gsplat's kernels, and draw one Gaussian."""
    import torch

    from compgs.devices import prepare_device
    from compgs.gaussians import Gaussians
    from compgs.tensors.rasterize import rasterize

    told: list[str] = []
    prepare_device(given.device, told.append)
    one = torch.ones(1, device=given.device)
    mean = torch.tensor([[0.0, 0.0, 3.0]], device=given.device)
    turn = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=given.device)
    gaussian = Gaussians(mean, turn, 0.3 * one.expand(1, 3), 0.9 * one, one.expand(1, 3))
    image = rasterize(gaussian, front_camera(64, 48)).image
    return {"told": told, "brightest": float(image.max())}


@stage(150)
def parity(given: Given) -> dict[str, Any]:
    """Compare one model's image, loss, gradients, bits and surveys on the device with the CPU's, number by number."""
    trained = [one_step(given.device), one_step("cpu")]
    worst = {}
    for name in trained[1]:
        found, expected = (part[name].double().cpu() for part in trained)
        worst[name] = float((found - expected).norm() / expected.norm().clamp_min(1e-30))
    wrong = [name for name, error in worst.items() if not error < TOLERANCES.get(name, 0.02)]
    assert not wrong, f"further apart than allowed: {[(name, worst[name]) for name in wrong]}"
    return worst


# gsplat ends a Gaussian at 3.33 standard deviations where ours ends at the alpha cutoff: gradients differ by less than
# 1 % of their norm; bits come from the same formulas in other order.
TOLERANCES = {"image": 2e-3, "loss": 1e-3, "bits": 1e-4}


@stage(300)
def end_to_end(given: Given) -> dict[str, Any]:
    """Train a generated scene with growth, prunings, turns and the mean; stop, resume, encode, decode, draw on both."""
    import numpy as np

    import compgs
    from compgs.config import load_config

    scene = compgs.load_scene(generated(given, 40, 320, 240))
    steps = 60 if given.quick else 600
    config = load_config("default")
    config = replace(config, training=replace(config.training, steps=steps))
    folder = given.out / "end_to_end"
    estimates: list[int] = []

    def stop_half_way(status: Any) -> None:
        if status.step >= steps // 2:
            raise KeyboardInterrupt

    begun = time.perf_counter()
    with contextlib.suppress(KeyboardInterrupt):
        compgs.train(scene, config, output=folder, device=given.device, progress=stop_half_way)
    model = compgs.train(
        scene,
        config,
        output=folder,
        resume=True,
        device=given.device,
        progress=lambda status: estimates.append(status.estimated_bytes),
    )
    seconds = time.perf_counter() - begun
    path = given.out / "generated.cgs"
    path.unlink(missing_ok=True)
    compgs.encode(model, path)
    decoded = compgs.decode(path)
    camera = scene.test_views[0].camera
    here = np.asarray(compgs.render(decoded, camera).image, np.float64)
    from compgs.devices import placed

    there = np.asarray(compgs.render(placed(decoded, given.device), camera).image, np.float64)
    apart = -10 * np.log10(max(float(((here.clip(0, 1) - there.clip(0, 1)) ** 2).mean()), 1e-12))
    results = compgs.evaluate(path, scene, device="cpu")
    estimate = (sum(model.estimated_bits(model.mask).values())) / 8
    assert apart > 50, f"the decoded file looks different on {given.device}: {apart:.1f} dB"
    return {
        "seconds": seconds,
        "psnr": results.psnr,
        "bytes": results.bytes,
        "anchors": model.anchors,
        "estimated_latent_bytes": estimate,
        "last_estimate": estimates[-1],
        "drawn_alike_db": apart,
    }


@stage(240)
def gpu_tests(given: Given) -> dict[str, Any]:
    """Run the tests that are marked gpu; other files may need packages that are not there."""
    files = sorted(
        str(path) for path in (ROOT / "tests").rglob("test_*.py") if "mark.gpu" in path.read_text()
    )
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    (given.out / "gpu_tests.txt").write_text(done.stdout + done.stderr)
    assert done.returncode in (0, 5), done.stdout[-1500:] + done.stderr[-500:]
    return {"last": done.stdout.strip().splitlines()[-1]}


@stage(300)
def commands(given: Given) -> dict[str, Any]:
    """Run the commands that compute on a device, each as a user starts it, on a generated scene."""
    scene, out = generated(given, 24, 160, 120), given.out / "commands"
    small = ["--steps", "20" if given.quick else "200"]
    calls = {
        "train": ["train", scene, "-o", out / "ours", *small],
        "decode": ["decode", out / "ours" / "ours.cgs", "-o", out / "decoded"],
        "evaluate": ["evaluate", out / "ours"],
        "render": ["render", out / "ours", "-o", out / "pictures", "--path", "orbit", "--frames", "3"],
        "train 3dgs": ["train", scene, "-o", out / "splats", "--method", "3dgs", *small],
        "train scaffold-gs": ["train", scene, "-o", out / "scaffold", "--method", "scaffold-gs", *small],
        "compress": [
            "compress",
            out / "splats" / "splats.ply",
            "-o",
            out / "compressed.cgs",
            "--views",
            "8",
            *small,
        ],
        "export": ["export", out / "ours" / "ours.cgs", out / "ours.spz"],
    }
    found: dict[str, Any] = {}
    for name, call in calls.items():
        begun = time.perf_counter()
        command = [sys.executable, "-m", "compgs", *map(str, call), "--device", given.device]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, f"{name}: {(done.stdout + done.stderr)[-1500:]}"
        found[name] = round(time.perf_counter() - begun, 1)
    return found


@stage(400)
def large(given: Given) -> dict[str, Any]:
    """Train the large capture for some seconds: milliseconds by part, memory, what comes out."""
    import torch

    import compgs
    from compgs.config import load_config
    from compgs.training.run.profile import StepProfile

    if given.scene is None:
        return {"skipped": "no --scene"}
    begun = time.perf_counter()
    scene = compgs.load_scene(given.scene)
    read = time.perf_counter() - begun
    config = load_config("default")
    steps = 30 if given.quick else 3000
    config = replace(config, training=replace(config.training, steps=steps))
    profile, marks = StepProfile(), []
    begun = time.perf_counter()

    def watch(status: Any) -> None:
        marks.append((status.step, round(time.perf_counter() - begun, 2), status.primitives))
        if time.perf_counter() - begun > given.seconds:
            raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        compgs.train(scene, config, device=given.device, progress=watch, profile=profile)
    memory = torch.cuda.max_memory_allocated() / 2**20 if given.device.startswith("cuda") else 0.0
    return {
        "read_seconds": read,
        "marks": marks[:: max(1, len(marks) // 12)],
        "milliseconds": {part: round(ms, 3) for part, ms in profile.milliseconds().items()},
        "peak_mib": memory,
    }


@stage(240)
def variants(given: Given) -> dict[str, Any]:
    """Take some steps with each option that has code of its own."""
    import compgs
    from compgs.config import load_config

    scene = compgs.load_scene(generated(given, 24, 160, 120))
    base = load_config("default")
    steps = 12 if given.quick else 50
    changes: dict[str, dict[str, dict[str, Any]]] = {
        "exposures": {"training": {"exposure": True}},
        "four views a step": {"training": {"views_per_step": 4}},
        "own residuals": {"model": {"residuals": True}},
        "separate heads": {"model": {"heads": "separate"}},
        "a size": {"training": {"target_bytes": 30_000}},
    }
    losses = {}
    for name, sections in changes.items():
        config = replace(base, training=replace(base.training, steps=steps))
        for section, values in sections.items():
            config = replace(config, **{section: replace(getattr(config, section), **values)})
        seen: list[float] = []
        compgs.train(scene, config, device=given.device, progress=lambda s, seen=seen: seen.append(s.loss))
        losses[name] = seen[-1]
    paper = replace(load_config("paper"), training=replace(load_config("paper").training, steps=steps))
    seen = []
    compgs.train(scene, paper, device=given.device, progress=lambda s: seen.append(s.loss))
    return {**losses, "paper": seen[-1]}


@stage(240)
def small(given: Given) -> dict[str, Any]:
    """Train a small capture as its published figures were trained."""
    import compgs
    from compgs.config import load_config

    if given.small is None:
        return {"skipped": "no --small"}
    scene = compgs.load_scene(given.small)
    config = load_config("default")
    steps = 40 if given.quick else 1500
    config = replace(config, training=replace(config.training, steps=steps, lmbda=0.001))
    begun = time.perf_counter()
    model = compgs.train(scene, config, device=given.device)
    seconds = time.perf_counter() - begun
    path = given.out / "small.cgs"
    path.unlink(missing_ok=True)
    compgs.encode(model, path)
    results = compgs.evaluate(path, scene, device="cpu")
    return {"seconds": seconds, "psnr": results.psnr, "ssim": results.ssim, "bytes": results.bytes}


@stage(120)
def million(given: Given) -> dict[str, Any]:
    """Draw a million Gaussians at four megapixels, forward and backward."""
    import torch

    from compgs.gaussians import Gaussians
    from compgs.tensors.rasterize import rasterize

    count = 2_000 if given.quick else 1_000_000
    width, height = (160, 120) if given.quick else (2400, 1600)
    chance = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=chance) + torch.tensor([0.0, 0.0, 4.0])
    parts = (
        means,
        torch.randn(count, 4, generator=chance),
        torch.rand(count, 3, generator=chance) * 0.01 + 1e-3,
        torch.rand(count, generator=chance),
        torch.rand(count, 3, generator=chance),
    )
    gaussians = Gaussians(*(part.to(given.device).requires_grad_() for part in parts))
    seconds = []
    for _ in range(5):
        begun = time.perf_counter()
        rasterize(gaussians, front_camera(width, height)).image.square().mean().backward()
        if given.device.startswith("cuda"):
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - begun)
    return {"milliseconds": [round(1e3 * s, 2) for s in seconds]}


@stage(180)
def trace(given: Given) -> dict[str, Any]:
    """Profile 20 steps: which operators take the time, and how many kernels a step starts."""
    import torch
    from torch.profiler import ProfilerActivity, profile

    from compgs.config import load_config
    from compgs.scene import load_scene
    from compgs.training.trainer import Trainer

    scene = load_scene(given.scene or generated(given, 24, 160, 120))
    config = load_config("default")
    trainer = Trainer(scene, config, torch.device(given.device))
    trainer.step = config.training.steps // 5  # there is a rate, nothing is rounded yet
    steps = 4 if given.quick else 20
    for _ in range(steps):
        trainer.train_step()
    kinds = [ProfilerActivity.CPU]
    if given.device.startswith("cuda"):
        kinds.append(ProfilerActivity.CUDA)
    begun = time.perf_counter()
    with profile(activities=kinds) as found:
        for _ in range(steps):
            trainer.train_step()
    seconds = time.perf_counter() - begun
    order = "self_cuda_time_total" if len(kinds) > 1 else "self_cpu_time_total"
    table = found.key_averages().table(sort_by=order, row_limit=40, max_name_column_width=60)
    (given.out / "trace.txt").write_text(table)
    launches = sum(e.count for e in found.key_averages() if "LaunchKernel" in e.key)
    return {"ms_a_step": 1e3 * seconds / steps, "launches_a_step": launches / steps}


# what stages share ----------------------------------------------------------------------------------------------


def front_camera(width: int, height: int) -> Any:
    """Return a camera at the origin that looks along z."""
    import numpy as np

    from compgs.cameras import Camera

    return Camera(np.eye(4), width, width, width / 2, height / 2, width, height)


def generated(given: Given, views: int, width: int, height: int) -> Path:
    """Return the folder of a generated scene; it is made on first use."""
    from compgs.scene.generated import generate_scene

    folder = given.out / f"scene_{views}_{width}"
    if not folder.exists():
        generate_scene(folder, views=views, width=width, height=height)
    return folder


def one_step(device: str) -> dict[str, Any]:
    """Return what one training view gives on a device: image, loss, gradients, bits, surveys, by name."""
    import tempfile

    import torch

    from compgs.config import load_config
    from compgs.losses import rate, rate_distortion_loss
    from compgs.scene import load_scene
    from compgs.scene.generated import generate_scene
    from compgs.training.survey import predict_view
    from compgs.training.trainer import Trainer

    with tempfile.TemporaryDirectory() as folder:
        generate_scene(Path(folder) / "scene", views=12, width=160, height=120)
        scene = load_scene(Path(folder) / "scene")
        config = load_config("default")
        training = replace(config.training, rules="all but hidden_anchors, coarse_photographs", lmbda=0.002)
        trainer = Trainer(scene, replace(config, training=training), torch.device("cpu"))
        chance = torch.Generator().manual_seed(5)
        with torch.no_grad():
            for parameter in trainer.model.parameters():  # nothing is at its start, where much is zero
                parameter += 0.1 * torch.randn(parameter.shape, generator=chance)
        trainer = Trainer(scene, trainer.config, torch.device(device), trainer.model)
        model, camera = trainer.model, scene.train_views[0].camera
        rows = trainer.survey.visible_anchors(camera)
        latents = model.quantized(rows, rate=True, noise=None, stored_weights=False)
        prediction = predict_view(model, latents, rows, camera, stored=False)
        rendered = trainer.pictures.rasterize(prediction.gaussians, camera, watched=True)
        loss = trainer.pictures.compare(rendered, trainer.views.photograph(0))
        loss = loss + trainer.gradients.regularize(prediction, prediction.gaussians, camera)
        bits = rate(latents.bits, model.entropy.channels, config.training.rate)
        rate_distortion_loss(loss, bits, training.lmbda).backward()
        found = {"image": rendered.image, "loss": loss[None], "bits": bits[None]}
        found |= {f"gradient of {n}": p.grad for n, p in model.named_parameters() if p.grad is not None}
        found["visible anchors"] = rows
        found["contributions"] = trainer.survey.contributions()
        found["changes"] = trainer.survey.changes()
        return {name: tensor.detach().cpu() for name, tensor in found.items()}


# running them ---------------------------------------------------------------------------------------------------


def run_stage(name: str, given: Given) -> dict[str, Any]:
    """Run one stage in this process and return its line."""
    begun = time.perf_counter()
    try:
        found = STAGES[name][1](given)
        line = {"stage": name, "ok": True, **found}
    except BaseException as error:
        place = traceback.format_exc().strip().splitlines()[-12:]
        line = {
            "stage": name,
            "ok": False,
            "error": f"{type(error).__name__}: {error}"[:3000],
            "trace": place,
        }
    return {**line, "wall_seconds": round(time.perf_counter() - begun, 2)}


def lines(given: Given, names: list[str], own: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the line of each stage as it ends; each has a process and a limit of its own."""
    for name in names:
        seconds = STAGES[name][0]
        command = [sys.executable, str(Path(__file__).resolve()), *own, "--one", name]
        begun = time.perf_counter()
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=seconds)
            last = done.stdout.strip().splitlines()[-1:] or ["{}"]
            line = json.loads(last[0]) if last[0].startswith("{") else {}
            if not line.get("stage"):
                tail = (done.stdout + done.stderr)[-1500:]
                line = {"stage": name, "ok": False, "error": f"ended with {done.returncode}", "trace": [tail]}
        except subprocess.TimeoutExpired:
            line = {"stage": name, "ok": False, "error": f"took more than its {seconds} s"}
        yield {**line, "process_seconds": round(time.perf_counter() - begun, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "-o", "--out", type=Path, required=True, help="folder for stages.jsonl and what stages write"
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--scene", type=Path, help="a large capture, for the stages `large` and `trace`")
    parser.add_argument("--small", type=Path, help="a small capture, for the stage `small`")
    parser.add_argument("--seconds", type=int, default=60, help="for which the large capture is trained")
    parser.add_argument("--stages", help=f"some of {','.join(STAGES)}")
    parser.add_argument("--quick", action="store_true", help="few steps: whether the stages run")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    given = Given(a.device, a.out.resolve(), a.scene, a.small, a.seconds, a.quick)
    if a.one:
        print("\n" + json.dumps(run_stage(a.one, given)), flush=True)
        return
    names = a.stages.split(",") if a.stages else list(STAGES)
    unknown = [name for name in names if name not in STAGES]
    if unknown:
        sys.exit(f"unknown stage {unknown[0]}; there are {', '.join(STAGES)}")
    failed = 0
    with open(a.out / "stages.jsonl", "w", encoding="utf-8") as file:
        for line in lines(given, names, sys.argv[1:]):
            file.write(json.dumps(line) + "\n")
            file.flush()
            failed += not line["ok"]
            print(json.dumps(line)[:1800], flush=True)
    print(f"{len(names) - failed} of {len(names)} stages passed")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
