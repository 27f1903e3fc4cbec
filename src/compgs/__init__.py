"""CompGS: compressed Gaussian splatting.

    import compgs

    scene = compgs.load_scene("captures/garden")
    model = compgs.train(scene, preset="quick")
    compgs.encode(model, "garden.cgs")

    model = compgs.decode("garden.cgs")
    result = compgs.render(model, scene.test_views[0].camera)

Names are resolved on first use, so that `import compgs` is instant and decoding never loads the training code.
"""

import importlib
import os
import time
from typing import TYPE_CHECKING

# torch's OpenMP threads spin between parallel regions and take the cores from numba's: a training step
# costs twice as much. Only has an effect when it is set before torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"

# Seconds since the epoch when the first source of the package was read: what changes later may not be what is loaded.
started = time.time()

_HOME = {
    "load_scene": "compgs.scene",
    "train": "compgs.methods",
    "compress": "compgs.compressing",
    "encode": "compgs.codec",
    "decode": "compgs.codec",
    "render": "compgs.render",
    "evaluate": "compgs.evaluation",
    "compare": "compgs.evaluation",
    "report": "compgs.evaluation.reports",
    "export": "compgs.exporting",
    "open_scene": "compgs.opening",
    "load_config": "compgs.config",
    "Camera": "compgs.cameras",
    "Gaussians": "compgs.gaussians",
    "CompGSError": "compgs.errors",
}

__all__ = [
    "Camera",
    "CompGSError",
    "Gaussians",
    "__version__",
    "compare",
    "compress",
    "decode",
    "encode",
    "evaluate",
    "export",
    "load_config",
    "load_scene",
    "open_scene",
    "render",
    "report",
    "train",
]

if TYPE_CHECKING:
    from compgs.cameras import Camera
    from compgs.codec import decode, encode
    from compgs.compressing import compress
    from compgs.config import load_config
    from compgs.errors import CompGSError
    from compgs.evaluation import compare as compare
    from compgs.evaluation import evaluate as evaluate
    from compgs.evaluation.reports import report as report
    from compgs.exporting import export
    from compgs.gaussians import Gaussians
    from compgs.methods import train
    from compgs.opening import open_scene
    from compgs.render import render
    from compgs.scene import load_scene


def __getattr__(name: str) -> object:
    if name == "methods":
        return importlib.import_module("compgs.methods")
    if name not in _HOME:
        raise AttributeError(f"module 'compgs' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
