"""Compile the stripped gsplat for another machine: its Python, its PyTorch, its GPU. No GPU is needed here.

    python tools/compile_gsplat.py build/stripped --torch 2.11.0 --python 3.12 --include PYTHON3.12/include --gpu 90

build/stripped/gsplat is what tools/strip_gsplat.py wrote. nvcc must be of the CUDA version of that PyTorch. The wheel
of PyTorch is downloaded for its headers and for the names in its libraries; nothing of it is run. It takes some minutes
on two cores, and leaves csrc.so beside gsplat's __init__.py, where an import finds it.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from strip_gsplat import LINKING, SECTIONS

PLATFORM = "manylinux_2_28_x86_64"  # of PyTorch's wheels
LIBRARIES = ("c10", "c10_cuda", "torch_cpu", "torch_cuda", "torch", "torch_python")
DEFINED = ("-DTORCH_API_INCLUDE_EXTENSION_H", "-DTORCH_EXTENSION_NAME=csrc")


def unpack_torch(version: str, python: str, folder: Path) -> Path:
    """Download PyTorch's wheel for a version of Python, and return the folder with its headers and libraries."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
    where = [
        "--python-version",
        python,
        "--implementation",
        "cp",
        "--platform",
        PLATFORM,
        "--dest",
        str(folder),
    ]
    subprocess.run([*command, *where, f"torch=={version}"], check=True)
    (wheel,) = folder.glob("torch-*.whl")
    wanted = ("torch/include/", *(f"torch/lib/lib{name}.so" for name in LIBRARIES))
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder, [name for name in packed.namelist() if name.startswith(wanted)])
    wheel.unlink()
    return folder / "torch"


def commands(sources: Sequence[Path], included: Sequence[Path], gpu: str, objects: Path) -> list[list[str]]:
    """Return a compiler's command for each source; the object is named after it."""
    paths = [part for path in included for part in ("-isystem", str(path))]
    made = []
    for source in sources:
        ending = [
            *DEFINED,
            *paths,
            "-std=c++17",
            "-O3",
            "-c",
            str(source),
            "-o",
            str(objects / f"{source.name}.o"),
        ]
        if source.suffix == ".cu":
            host = ",".join(("-fPIC", *SECTIONS))
            code = f"-gencode=arch=compute_{gpu},code=sm_{gpu}"
            made.append(
                ["nvcc", "-use_fast_math", "--expt-relaxed-constexpr", "-Xcompiler", host, code, *ending]
            )
        else:
            made.append(["g++", "-fPIC", *SECTIONS, *ending])
    return made


def toolkit() -> Path:
    """Return CUDA's folder, which nvcc names; the nvcc on PATH may be a link or a script somewhere else."""
    if shutil.which("nvcc") is None:
        sys.exit("nvcc was not found on PATH")
    said = subprocess.run(
        ["nvcc", "-dryrun", "-x", "cu", os.devnull], capture_output=True, text=True, check=True
    )
    return Path(said.stderr.partition("TOP=")[2].splitlines()[0])


def compile_kernels(package: Path, torch: Path, include: Path, gpu: str) -> Path:
    """Compile a stripped gsplat against a PyTorch and the headers of a Python, and return the library's path.

    Raises CalledProcessError where a compiler fails; it has said why.
    """
    cuda = package / "cuda"
    home, headers = toolkit(), torch / "include"
    included = [
        cuda / "include",
        cuda / "csrc" / "third_party" / "glm",
        headers,
        headers / "torch" / "csrc" / "api" / "include",
        include,
        home / "include",
    ]
    sources = [*sorted((cuda / "csrc").glob("*.c*")), cuda / "ext.cpp"]
    target = package / "csrc.so"
    with tempfile.TemporaryDirectory() as objects:
        calls = commands([s for s in sources if s.suffix != ".cuh"], included, gpu, Path(objects))
        with ThreadPoolExecutor() as workers:
            list(workers.map(lambda call: subprocess.run(call, check=True), calls))
        linked = [str(path) for path in sorted(Path(objects).glob("*.o"))]
        places = [f"-L{torch / 'lib'}", f"-L{home / 'lib64'}"]
        libraries = [f"-l{name}" for name in (*LIBRARIES, "cudart")]
        # What PyTorch's libraries themselves need is found on the machine that runs this.
        lenient = "-Wl,--allow-shlib-undefined"
        subprocess.run(
            ["g++", "-shared", *LINKING, *linked, *places, *libraries, lenient, "-o", str(target)], check=True
        )
    return target


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder with the stripped gsplat/")
    parser.add_argument("--torch", default="2.11.0", help="that machine's PyTorch (default: %(default)s)")
    parser.add_argument("--python", default="3.12", help="its Python (default: %(default)s)")
    parser.add_argument("--include", type=Path, required=True, help="folder with that Python's Python.h")
    parser.add_argument(
        "--gpu", default="90", help="compute capability, 90 for Hopper (default: %(default)s)"
    )
    given = parser.parse_args()
    if not (given.include / "Python.h").is_file():
        sys.exit(f"{given.include}: expected the folder of Python.h of Python {given.python}")
    with tempfile.TemporaryDirectory() as scratch:
        torch = unpack_torch(given.torch, given.python, Path(scratch))
        print(compile_kernels(given.folder / "gsplat", torch, given.include, given.gpu))


if __name__ == "__main__":
    main()
