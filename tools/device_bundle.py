"""Pack what a GPU machine without a network needs beside this repository: packages, gsplat, and captures that fit.

    python tools/device_bundle.py build/device --scene ../scenes/truck --most 45MB
    python tools/device_bundle.py build/device --scene ../scenes/truck --include PYTHON3.12/include   # compiled here

writes build/device/site (put it first on PYTHONPATH: tyro with what it needs, and the stripped gsplat, compiled if the
headers of that machine's Python are given), build/device/scenes (the captures, their photographs as AVIF files of the
best quality that fits, under their own names) and build/device/run.sh, which checks the device:

    bash build/device/run.sh build/device_check
"""

import argparse
import io
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from compile_gsplat import compile_kernels, unpack_torch
from PIL import Image
from strip_gsplat import strip

# What machines with PyTorch mostly lack: all of pure Python.
PACKAGES = ("tyro", "docstring_parser", "shtab", "typeguard", "typing_extensions")
GSPLAT = "gsplat==1.5.3"
QUALITIES = (95, 92, 90, 88, 86, 84, 80, 75)  # of AVIF: 40 to 45 dB on photographs

RUN = """\
# Checks this machine's GPU; the folder to write to is the argument.
here=$(cd "$(dirname "$0")" && pwd)
export PYTHONPATH=$here/site:$PWD/src:$PYTHONPATH OMP_WAIT_POLICY=PASSIVE PYTHONUNBUFFERED=1
python3 tools/device_check.py -o "$1" --scene "$(ls -d "$here"/scenes/*/ | head -1)"
"""


def download(package: str, folder: Path) -> Path:
    """Return the wheel of a package, without those that it needs."""
    before = set(folder.glob("*.whl"))
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--dest",
        str(folder),
        package,
    ]
    subprocess.run(command, check=True)
    return (set(folder.glob("*.whl")) - before).pop()


def pack_packages(site: Path) -> None:
    """Unpack the packages and the stripped gsplat into `site`."""
    with tempfile.TemporaryDirectory() as scratch:
        wheels = Path(scratch)
        for package in PACKAGES:
            with zipfile.ZipFile(download(package, wheels)) as wheel:
                wheel.extractall(site)
        with zipfile.ZipFile(download(GSPLAT, wheels)) as wheel:
            wheel.extractall(wheels / "whole")
        strip(wheels / "whole" / "gsplat", site)


def as_avif(path: Path, quality: int) -> bytes:
    """Return a photograph as an AVIF file of some quality, colors at full resolution."""
    buffer = io.BytesIO()
    with Image.open(path) as image:
        image.convert("RGB").save(buffer, "AVIF", quality=quality, subsampling="4:4:4")
    return buffer.getvalue()


def pack_scene(scene: Path, folder: Path, most: int) -> int:
    """Copy a COLMAP capture with photographs of the best quality for which all take at most so many bytes; return it.

    A photograph that is no larger as it is stays. Names stay, since readers go by what a file holds. Exits where even
    the lowest quality is too large.
    """
    photographs = sorted(path for path in (scene / "images").iterdir() if path.is_file())
    sample = photographs[:: max(1, len(photographs) // 12)]
    for quality in QUALITIES:
        share = sum(len(as_avif(path, quality)) for path in sample) / len(sample)
        if share * len(photographs) <= 0.97 * most:
            break
    else:
        sys.exit(f"{scene}: its {len(photographs)} photographs do not fit into {most:,} bytes")
    (folder / "images").mkdir(parents=True)
    for path in photographs:
        packed = as_avif(path, quality)
        target = folder / "images" / path.name
        target.write_bytes(packed) if len(packed) < path.stat().st_size else shutil.copy(path, target)
    shutil.copytree(scene / "sparse", folder / "sparse", copy_function=shutil.copy)
    return quality


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="what to write; must not exist")
    parser.add_argument(
        "--scene", type=Path, action="append", default=[], help="a COLMAP capture; repeatable"
    )
    parser.add_argument(
        "--most", default="45MB", help="megabytes for a capture's photographs (default: %(default)s)"
    )
    parser.add_argument(
        "--include", type=Path, help="folder of Python.h of that machine: gsplat is compiled here"
    )
    parser.add_argument("--torch", default="2.11.0", help="that machine's PyTorch (default: %(default)s)")
    parser.add_argument("--python", default="3.12", help="that machine's Python (default: %(default)s)")
    parser.add_argument("--gpu", default="90", help="its compute capability (default: %(default)s)")
    given = parser.parse_args()
    if given.folder.exists():
        sys.exit(f"{given.folder}: exists already; choose another folder or remove it")
    given.folder.mkdir(parents=True)
    pack_packages(given.folder / "site")
    if given.include is not None:
        with tempfile.TemporaryDirectory() as scratch:
            torch = unpack_torch(given.torch, given.python, Path(scratch))
            compile_kernels(given.folder / "site" / "gsplat", torch, given.include, given.gpu)
    for scene in given.scene:
        target = given.folder / "scenes" / scene.name
        quality = pack_scene(scene, target, int(given.most.removesuffix("MB")) * 10**6)
        print(f"{scene.name}: photographs of quality {quality}")
    (given.folder / "run.sh").write_text(RUN)
    total = sum(path.stat().st_size for path in given.folder.rglob("*") if path.is_file())
    print(f"{given.folder}: {total / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
