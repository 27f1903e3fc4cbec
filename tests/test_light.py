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

GOLDEN = Path(__file__).parent / "golden"
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


COMMANDS = """
from compgs.cli.main import main
from pathlib import Path
folder = Path(sys.argv[1])
small = str(folder / "small.cgs")
commands = [
    ["info", small],
    ["decode", small, "-o", str(folder / "arrays")],
    ["decode", small, "--prefix", "level 6"],
    ["render", small, "--frames", "2", "--width", "48", "--height", "32", "-o", str(folder / "frames")],
    ["encode", small, "-o", str(folder / "smaller.cgs"), "--drop", "0.2", "--coarser", "2"],
    ["export", small, str(folder / "a.html")],
    *(["export", small, str(folder / f"a.{kind}"), "--degree", "1", "--refine", "3"]
      for kind in ("ply", "spz", "sog", "glb")),
    ["export", str(folder / "a.ply"), str(folder / "b.spz"), "--max-splats", "50", "--refine", "3"],
]
for command in commands:
    code = main(command)
    assert code == 0, (code, command)
"""


def test_every_light_command_works_without_torch_scipy_and_safetensors(folder: Path) -> None:
    code, out, err = without_extras(COMMANDS, str(folder))
    assert code == 0, err
    for name in (
        "arrays/geometry.npz",
        "frames/00001.png",
        "smaller.cgs",
        "a.html",
        "a.ply",
        "a.glb",
        "b.spz",
    ):
        assert (folder / name).stat().st_size > 0, name
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


PYTHON = """
import compgs
import numpy as np
model = compgs.decode(sys.argv[1])
image = compgs.render(model, model.viewpoints[0]).image
assert isinstance(image, np.ndarray) and image.dtype == np.float32 and image.std() > 0
assert type(compgs.open_scene(sys.argv[1])) is type(model)
from compgs import metrics
eight = metrics.to_8bit(image)
assert metrics.ssim(eight, eight) > 0.9999 and metrics.psnr(eight, eight) == float("inf")
from compgs.viewer.gallery import gallery_server
from pathlib import Path
gallery_server(Path(sys.argv[1]).parent, "127.0.0.1", 0).server_close()
for name in ("train", "encode"):
    try:
        getattr(compgs, name)
    except compgs.CompGSError as error:
        print(error)
"""


def test_python_users_get_arrays_and_are_told_what_training_needs(folder: Path) -> None:
    code, out, err = without_extras(PYTHON, str(folder / "small.cgs"))
    assert code == 0, err
    needs = "needs torch, scipy and safetensors: pip install '.[train]' in the project's folder"
    assert out.splitlines() == [f"compgs.train {needs}", f"compgs.encode {needs}"]


MISSING = """
from compgs.cli.main import main
from pathlib import Path
folder = Path(sys.argv[1])
(folder / "run").mkdir()
(folder / "run" / "checkpoint.safetensors").write_bytes(b"")
for command in (
    ["train", str(folder / "nowhere"), "-o", str(folder / "new")],
    ["encode", str(folder / "run"), "-o", str(folder / "run.cgs")],
    ["render", str(folder / "small.cgs"), "--device", "cuda", "-o", str(folder / "there")],
):
    assert main(command) == 1, command
assert not (folder / "new").exists() and not (folder / "there").exists()
"""


def test_what_is_missing_is_one_line_with_the_remedy_before_any_work(folder: Path) -> None:
    code, _, err = without_extras(MISSING, str(folder))
    assert code == 0, err
    lines = [" ".join(line.split()) for line in err.split("error:")[1:]]
    assert len(lines) == 3
    remedies = ["'.[train]'", "'.[train]'", "'.[cuda]'"]
    for line, remedy in zip(lines, remedies, strict=True):
        assert line.startswith(("training needs torch, scipy and safetensors", "device cuda needs torch"))
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
