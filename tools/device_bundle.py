"""Pack what a GPU machine without a network needs beside this repository: packages, gsplat, and a capture that fits.

    python tools/device_bundle.py build/device --scene ../scenes/truck --most 45MB

writes build/device/site (put it first on PYTHONPATH: tyro with what it needs, and the stripped gsplat),
build/device/scene (the capture, its photographs as JPEGs of the best quality that fits) and build/device/run.sh, which
checks the device:

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

from PIL import Image
from strip_gsplat import strip

# What machines with PyTorch mostly lack: all of pure Python.
PACKAGES = ("tyro", "docstring_parser", "shtab", "typeguard", "typing_extensions")
GSPLAT = "gsplat==1.5.3"
QUALITIES = (95, 92, 90, 88, 86, 84, 80, 75)

RUN = """\
# Checks this machine's GPU; the folder to write to is the argument.
here=$(cd "$(dirname "$0")" && pwd)
export PYTHONPATH=$here/site:$PWD/src:$PYTHONPATH OMP_WAIT_POLICY=PASSIVE PYTHONUNBUFFERED=1
python3 tools/device_check.py -o "$1" --scene "$here/scene"
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


def as_jpeg(path: Path, quality: int) -> bytes:
    """Return a photograph as a JPEG of some quality, colors at full resolution."""
    buffer = io.BytesIO()
    with Image.open(path) as image:
        image.convert("RGB").save(buffer, "JPEG", quality=quality, subsampling=0, optimize=True)
    return buffer.getvalue()


def pack_scene(scene: Path, folder: Path, most: int) -> int:
    """Copy a COLMAP capture with photographs of the best quality for which all take at most so many bytes; return it.

    A photograph that is no larger as it is stays as it is. Exits where even the lowest quality is too large.
    """
    photographs = sorted(path for path in (scene / "images").iterdir() if path.is_file())
    sample = photographs[:: max(1, len(photographs) // 12)]
    for quality in QUALITIES:
        share = sum(len(as_jpeg(path, quality)) for path in sample) / len(sample)
        if share * len(photographs) <= 0.97 * most:
            break
    else:
        sys.exit(f"{scene}: its {len(photographs)} photographs do not fit into {most:,} bytes")
    (folder / "images").mkdir(parents=True)
    for path in photographs:
        packed = as_jpeg(path, quality)
        target = folder / "images" / path.name
        target.write_bytes(packed) if len(packed) < path.stat().st_size else shutil.copy(path, target)
    shutil.copytree(scene / "sparse", folder / "sparse", copy_function=shutil.copy)
    return quality


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="what to write; must not exist")
    parser.add_argument("--scene", type=Path, help="a COLMAP capture to take along")
    parser.add_argument("--most", default="45MB", help="megabytes for its photographs (default: %(default)s)")
    given = parser.parse_args()
    if given.folder.exists():
        sys.exit(f"{given.folder}: exists already; choose another folder or remove it")
    given.folder.mkdir(parents=True)
    pack_packages(given.folder / "site")
    if given.scene is not None:
        quality = pack_scene(given.scene, given.folder / "scene", int(given.most.removesuffix("MB")) * 10**6)
        print(f"photographs as JPEGs of quality {quality}")
    (given.folder / "run.sh").write_text(RUN)
    total = sum(path.stat().st_size for path in given.folder.rglob("*") if path.is_file())
    print(f"{given.folder}: {total / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
