"""The check of a GPU runs here, with the CPU on both sides; what it packs for a machine without network fits."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, features

ROOT = Path(__file__).resolve().parent.parent


def tool(name: str):
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
        assert spec and spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.pop(0)


@pytest.mark.slow
def test_its_stages_pass_where_the_cpu_is_on_both_sides(tmp_path):
    command = [sys.executable, str(ROOT / "tools" / "device_check.py"), "-o", str(tmp_path / "check")]
    stages = "versions,kernels,parity,gpu_tests,trace"
    done = subprocess.run(
        [*command, "--device", "cpu", "--quick", "--stages", stages],
        capture_output=True,
        text=True,
        timeout=900,
    )
    lines = [json.loads(line) for line in (tmp_path / "check" / "stages.jsonl").read_text().splitlines()]
    assert [line["stage"] for line in lines] == stages.split(","), done.stdout + done.stderr
    assert all(line["ok"] for line in lines), lines
    parity = next(line for line in lines if line["stage"] == "parity")
    errors = {name: value for name, value in parity.items() if name.startswith("gradient of")}
    assert len(errors) > 20 and max(errors.values()) < 1e-5  # of the same kernels, twice


def test_a_stage_that_fails_costs_itself_alone(tmp_path, monkeypatch, capsys):
    check = tool("device_check")
    given = check.Given("cpu", tmp_path, None, None, 1, True)

    def broken(given):
        raise ZeroDivisionError("as a test wants it")

    monkeypatch.setitem(check.STAGES, "parity", (10, broken))
    line = check.run_stage("parity", given)
    assert not line["ok"] and "as a test wants it" in line["error"]
    assert check.run_stage("large", given)["skipped"] == "no --scene"


def test_a_stripped_gsplat_has_three_channels_and_the_operators_that_are_used(tmp_path):
    strip = tool("strip_gsplat")
    kernels = tmp_path / "gsplat" / "cuda" / "csrc"
    (kernels / "third_party" / "glm" / "glm").mkdir(parents=True)
    (tmp_path / "gsplat" / "__init__.py").write_text("")
    for name in (*strip.KEPT, "RasterizeToPixels2DGSFwd.cu"):
        (kernels / name).write_text("__INS__(1)\n__INS__(3)\n        __LAUNCH_KERNEL__(16)\nint kept;\n")
    target = strip.strip(tmp_path / "gsplat", tmp_path / "out")
    left = sorted(path.name for path in (target / "cuda" / "csrc").glob("*.c*"))
    assert left == sorted(strip.KEPT)
    assert (target / "cuda" / "csrc" / strip.KEPT[1]).read_text() == "__INS__(3)\nint kept;\n"
    bindings = (target / "cuda" / "ext.cpp").read_text()
    assert all(f"&gsplat::{name}" in bindings for name in strip.OPERATORS)
    compile((target / "cuda" / "_backend.py").read_text(), "_backend.py", "exec")


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow writes no AVIF")
def test_a_packed_capture_takes_no_more_than_it_may(tmp_path):
    bundle = tool("device_bundle")
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (scene / "sparse" / "0").mkdir(parents=True)
    (scene / "sparse" / "0" / "cameras.bin").write_bytes(b"cameras")
    chance = np.random.default_rng(0)
    for number in range(6):
        pixels = chance.integers(0, 256, (64, 96, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(scene / "images" / f"{number}.jpg", quality=100, subsampling=0)
    whole = sum(path.stat().st_size for path in (scene / "images").iterdir())
    quality = bundle.pack_scene(scene, tmp_path / "packed", int(0.45 * whole))
    packed = sum(path.stat().st_size for path in (tmp_path / "packed" / "images").iterdir())
    assert quality < 95 and 0.2 * whole < packed <= 0.45 * whole
    assert (tmp_path / "packed" / "sparse" / "0" / "cameras.bin").read_bytes() == b"cameras"
    with pytest.raises(SystemExit, match="do not fit"):
        bundle.pack_scene(scene, tmp_path / "none", 1000)


def test_runs_side_by_side_keep_their_files_and_end_in_time(tmp_path, monkeypatch, capsys):
    runs, folder = tool("device_runs"), tmp_path / "out"
    (folder / "runs").mkdir(parents=True)
    does = {
        "done": "import pathlib; p = pathlib.Path(r'{}'); p.mkdir(); (p / 'done.cgs').write_text('made')",
        "fails": "raise SystemExit(3)",
        "slow": "import time; time.sleep(600)",
    }

    def start(name, arguments, folder):
        return subprocess.Popen([sys.executable, "-c", does[name].format(folder / "runs" / name)])

    monkeypatch.setattr(runs, "start", start)
    lines = {line["name"]: line for line in runs.run_all(dict.fromkeys(does, ""), folder, 8)}
    assert (folder / "done.cgs").read_text() == "made" and lines["done"]["code"] == 0
    assert lines["fails"]["code"] == 3 and not lines["fails"]["file"]
    assert lines["slow"]["code"] == -15 and not lines["slow"]["in time"]
    assert [json.loads(line)["name"] for line in capsys.readouterr().out.splitlines()] == list(lines)
