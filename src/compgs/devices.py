"""Where a scene is trained and drawn: on the CPU by kernels, on CUDA by torch and gsplat, loaded for that alone.

A device that is asked for is used or refused. Left out, it is CUDA where torch sees a GPU and gsplat is installed with
a compiler for its kernels, or with kernels that are compiled already; else the CPU. `choose` says which, and why.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from compgs.errors import ConfigError, install_line
from compgs.extras import missing, require

if TYPE_CHECKING:
    import torch

    Device = str | torch.device

CPU = "cpu"
_Scene = TypeVar("_Scene")


@dataclass(frozen=True)
class Choice:
    """A device, and why it was taken."""

    name: str  # `cpu`, `cuda` or `cuda:N`
    reason: str  # a sentence for people; empty: it was asked for


def choose(device: "Device | None") -> Choice:
    """The given device, or the best one that works here.

    Raises ConfigError for a device that is not known or not there, MissingDependency where packages for it are missing.
    """
    if device is not None:
        name = str(device)
        check_device(name)
        return Choice(name, "")
    if "torch" in missing("cuda") or not _gpus():
        return Choice(CPU, "PyTorch finds no CUDA GPU")
    if missing("cuda"):
        return Choice(CPU, f"there is a GPU, but gsplat is not installed ({install_line('cuda')})")
    if not _kernels_can_be_had():
        return Choice(CPU, "there is a GPU, but nvcc, which compiles gsplat's kernels, was not found")
    return Choice("cuda", "PyTorch finds a GPU, and gsplat is installed")


def chosen_device(device: "Device | None") -> str:
    """The name of the device that `choose` chooses. Raises as it does."""
    return choose(device).name


def prepare_device(name: str, say: Callable[[str], None] = lambda told: None) -> None:
    """Load, or compile, what computes on a device, so that no step waits for it; `say` is told before minutes pass.

    Raises MissingDependency where CUDA kernels are missing and cannot be compiled.
    """
    if name.partition(":")[0] == CPU:
        return
    from compgs.tensors.gsplat_backend import build_kernels

    build_kernels(say)


def check_device(name: str) -> None:
    """Raises ConfigError for a device that is not known or not there, MissingDependency where its packages are not."""
    kind, colon, number = name.partition(":")
    if kind not in (CPU, "cuda") or (colon and not number.isdecimal()):
        raise ConfigError(f"device {name}: expected cpu or cuda")
    if kind == CPU:
        return
    if "torch" in missing("cuda"):
        require("cuda", f"device {name}:")
    if int(number or 0) >= _gpus():
        raise ConfigError(
            f"device {name}: PyTorch finds {_gpus()} CUDA devices; use cpu, or install a CUDA build of PyTorch"
        )
    require("cuda", f"device {name}:")


def placed(model: _Scene, device: "Device | None") -> _Scene:
    """A decoded scene where it is to be drawn; the scene itself for the CPU. Raises as `check_device` does."""
    name = CPU if device is None else str(device)
    check_device(name)
    if name.partition(":")[0] == CPU:
        return model
    import torch

    from compgs.tensors.gsplat_backend import load_gsplat
    from compgs.tensors.scenes import on_device

    load_gsplat()
    return on_device(model, torch.device(name))  # type: ignore[arg-type, return-value]


def drawn(gaussians: Any, camera: Any, settings: Any, device: str) -> Any:
    """The picture (`RasterResult`) of `Gaussians` of numpy arrays, drawn on another device than the CPU."""
    import torch

    from compgs.tensors.scenes import drawn_gaussians

    return drawn_gaussians(gaussians, camera, settings, torch.device(device))


def device_name(device: str) -> str:
    """`cpu`, or the name of the GPU."""
    if device.partition(":")[0] == CPU:
        return CPU
    import torch

    return torch.cuda.get_device_name(device)


def _gpus() -> int:
    import torch

    return torch.cuda.device_count()


def _kernels_can_be_had() -> bool:
    """Whether gsplat has compiled kernels, or there is a compiler for them; none is loaded or started."""
    import importlib.util

    if importlib.util.find_spec("gsplat.csrc") is not None:
        return True
    from torch.utils.cpp_extension import CUDA_HOME

    return CUDA_HOME is not None or shutil.which("nvcc") is not None
