"""Write a copy of gsplat that compiles in a minute: three channels, 3D Gaussians, nothing else.

gsplat 1.5 compiles its kernels on first use, for 19 counts of channels and for 2D Gaussians, lenses and more: ten to
twenty minutes. CompGS needs four of its operators with three channels. The copy has these alone.

    python tools/strip_gsplat.py build/stripped            # from the installed gsplat
    python tools/strip_gsplat.py build/stripped --source unpacked/gsplat

Use it by putting the folder first on PYTHONPATH. A compiled `csrc*.so` beside its `__init__.py` is used where it loads.
"""

import argparse
import importlib.util
import re
import shutil
import sys
from pathlib import Path

KEPT = (
    "Projection.cpp",
    "ProjectionEWA3DGSFused.cu",
    "Intersect.cpp",
    "IntersectTile.cu",
    "Rasterization.cpp",
    "RasterizeToPixels3DGSFwd.cu",
    "RasterizeToPixels3DGSBwd.cu",
)
OPERATORS = (
    "intersect_tile",
    "intersect_offset",
    "projection_ewa_3dgs_fused_fwd",
    "projection_ewa_3dgs_fused_bwd",
    "rasterize_to_pixels_3dgs_fwd",
    "rasterize_to_pixels_3dgs_bwd",
)
CHANNELS = "3"

# Instances of templates, one line for each count of channels.
INSTANCE = re.compile(r"^\s*__(?:INS|LAUNCH_KERNEL)__\((\d+)\)")

# What was left out is still named by wrappers that nobody calls. Each function has a section of its own, all but the
# module's entry are hidden, and the linker drops the sections that nothing reaches, with the names in them.
SECTIONS = ("-ffunction-sections", "-fdata-sections", "-fvisibility=hidden")
LINKING = ("-Wl,--gc-sections",)

BINDINGS = """\
#include <torch/extension.h>

#include "Cameras.h"
#include "Ops.h"

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {{
    py::enum_<gsplat::CameraModelType>(m, "CameraModelType")
        .value("PINHOLE", gsplat::CameraModelType::PINHOLE)
        .value("ORTHO", gsplat::CameraModelType::ORTHO)
        .value("FISHEYE", gsplat::CameraModelType::FISHEYE)
        .value("FTHETA", gsplat::CameraModelType::FTHETA)
        .export_values();
{operators}
}}
"""

BACKEND = '''\
"""Compiled operators: those beside this package where they load, else built now, in about a minute."""

from pathlib import Path

try:
    from gsplat import csrc as _C
except ImportError:
    from torch.utils.cpp_extension import CUDA_HOME, load

    _C = None
    if CUDA_HOME is not None:
        here = Path(__file__).parent
        _C = load(
            name="gsplat_cuda_stripped",
            sources=[str(path) for path in (*sorted((here / "csrc").glob("*.c*")), here / "ext.cpp")],
            extra_include_paths=[str(here / "include"), str(here / "csrc" / "third_party" / "glm")],
            extra_cflags=["-O3", {flags}],
            extra_cuda_cflags=["-O3", "-use_fast_math", "-Xcompiler", "{joined}"],
            extra_ldflags=[{linking}],
            verbose=False,
        )

__all__ = ["_C"]
'''


def installed() -> Path:
    """Return the folder of the installed gsplat; importing it is not needed."""
    found = importlib.util.find_spec("gsplat")
    if found is None or found.origin is None:
        sys.exit("gsplat is not installed: pip install gsplat, or give --source")
    return Path(found.origin).parent


def strip(source: Path, folder: Path) -> Path:
    """Write the stripped package into `folder`/gsplat and return that path."""
    target = folder / "gsplat"
    if target.exists():
        shutil.rmtree(target)
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("csrc", "*.pyc", "*.so", "__pycache__"))
    kernels, kept = source / "cuda" / "csrc", target / "cuda" / "csrc"
    kept.mkdir()
    for path in kernels.iterdir():
        if path.suffix in (".h", ".cuh"):
            shutil.copy(path, kept)
    glm = Path("third_party") / "glm" / "glm"
    shutil.copytree(kernels / glm, kept / glm)
    for name in KEPT:
        lines = (kernels / name).read_text().splitlines(keepends=True)
        (kept / name).write_text("".join(line for line in lines if wanted(line)))
    operators = "\n".join(f'    m.def("{name}", &gsplat::{name});' for name in OPERATORS)
    (target / "cuda" / "ext.cpp").write_text(BINDINGS.format(operators=operators))
    (target / "cuda" / "_backend.py").write_text(
        BACKEND.format(
            flags=", ".join(f'"{flag}"' for flag in SECTIONS),
            joined=",".join(SECTIONS),
            linking=", ".join(f'"{flag}"' for flag in LINKING),
        )
    )
    return target


def wanted(line: str) -> bool:
    """Whether a line of a kernel stays: all do but instances for other counts of channels."""
    found = INSTANCE.match(line)
    return found is None or found.group(1) == CHANNELS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder in which gsplat/ is written")
    parser.add_argument("--source", type=Path, help="folder of the package, where it is not installed")
    given = parser.parse_args()
    print(strip(given.source or installed(), given.folder))


if __name__ == "__main__":
    main()
