"""The installation without extras: what somebody does who has received a file, where torch, scipy and safetensors are
not installed.
"""

import functools
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden"
CHECK = ROOT / "tools" / "check_light.py"
# What is hidden is not installed, as far as the program can tell.
PROGRAM = """
import importlib.machinery
import sys

class Hidden(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        hidden = name.partition(".")[0] in ("torch", "scipy", "safetensors")
        return None if hidden else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(importlib.machinery.PathFinder)] = Hidden
"""


@functools.cache
def without_extras(program: str, *arguments: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a program in a process that has numpy, numba and what is small."""
    command = [sys.executable, "-c", PROGRAM + program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, cgs_bytes: bytes) -> Path:
    """Holds small.cgs, with viewpoints."""
    path = tmp_path_factory.mktemp("light")
    (path / "small.cgs").write_bytes(cgs_bytes)
    return path


def test_every_light_command_works_without_torch_scipy_and_safetensors(folder: Path) -> None:
    program = "import runpy; sys.argv.pop(0); runpy.run_path(sys.argv[0], run_name='__main__')"
    out_folder = folder / "out"
    code, out, err = without_extras(program, str(CHECK), str(folder / "small.cgs"), str(out_folder))
    assert code == 0, err
    assert "all of it works" in out
    for name in (
        "arrays/geometry.npz",
        "frames/00001.png",
        "smaller.cgs",
        "a.html",
        "a.ply",
        "a.glb",
        "b.spz",
    ):
        assert (out_folder / name).stat().st_size > 0, name
    assert out.count(" dB") >= 5  # the loss of baking was measured


def test_every_golden_file_is_decoded_by_the_command() -> None:
    files = sorted(str(path) for path in GOLDEN.glob("*.cgs"))
    assert len(files) >= 4
    program = (
        "from compgs.cli.main import main\n"
        "for file in sys.argv[1:]:\n"
        "    assert main(['decode', file]) == 0, file\n"
    )
    code, out, err = without_extras(program, *files)
    assert code == 0, err
    assert out.count("decoded in") == len(files)


MISSING = """
from compgs.cli.main import main
from pathlib import Path
folder = Path(sys.argv[1])
(folder / "run").mkdir()
(folder / "run" / "checkpoint.safetensors").write_bytes(b"")
for command in (
    ["train", str(folder), "-o", str(folder / "new")],
    ["encode", str(folder / "run"), "-o", str(folder / "run.cgs")],
    ["compress", str(folder / "small.cgs"), "-o", str(folder / "new.cgs")],
    ["render", str(folder / "small.cgs"), "--device", "cuda", "-o", str(folder / "there")],
):
    assert main(command) == 1, command
assert not (folder / "new").exists() and not (folder / "there").exists()
import compgs
for use in (lambda: compgs.train(folder), lambda: compgs.encode, lambda: compgs.compress):
    try:
        use()
    except compgs.CompGSError as error:
        print(f"error: {error}", file=sys.stderr)
"""


def test_what_is_missing_is_one_line_with_the_remedy_before_any_work(folder: Path) -> None:
    code, _, err = without_extras(MISSING, str(folder))
    assert code == 0, err
    lines = [" ".join(line.split()) for line in err.split("error:")[1:]]
    assert len(lines) == 7
    remedies = [*3 * ["'.[train]'"], "'.[cuda]'", *3 * ["'.[train]'"]]
    for line, remedy in zip(lines, remedies, strict=True):
        needs = (
            "training needs torch, scipy and",
            "--device cuda: needs torch",
            "compgs.encode needs torch",
            "compgs.compress needs torch",
        )
        assert line.startswith(needs), line
        assert f"pip install {remedy} in the project's folder" in line


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="needs the extra `train`")
def test_pictures_are_those_of_torch(folder: Path) -> None:
    import numpy as np
    import torch

    import compgs
    from compgs.tensors.scenes import HybridOnDevice

    model = compgs.decode(folder / "small.cgs")
    camera = model.viewpoints[0]
    by_torch = compgs.render(HybridOnDevice.of(model, torch.device("cpu")), camera).image
    np.testing.assert_allclose(compgs.render(model, camera).image, by_torch, atol=1e-5)
