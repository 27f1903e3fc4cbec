"""Where scenes are drawn: on the CPU by kernels, on CUDA by torch and gsplat, which are loaded for that alone."""

from typing import TYPE_CHECKING, Any, TypeVar

from compgs.errors import ConfigError
from compgs.extras import missing, require

if TYPE_CHECKING:
    import torch

    Device = str | torch.device

CPU = "cpu"
_Scene = TypeVar("_Scene")


def chosen_device(device: "Device | None") -> str:
    """The name of the given one, else `cuda` where there is such a GPU and what draws on it, else `cpu`.

    Raises ConfigError for a device that is not known or not there, MissingDependency where packages for it are missing.
    """
    if device is None:
        return "cuda" if not missing("cuda") and _gpus() else CPU
    name = str(device)
    check_device(name)
    return name


def check_device(name: str) -> None:
    """Raises ConfigError for a device that is not known or not there, MissingDependency where its packages are not."""
    kind, colon, number = name.partition(":")
    if kind not in (CPU, "cuda") or (colon and not number.isdecimal()):
        raise ConfigError(f"device {name}: expected cpu or cuda")
    if kind == CPU:
        return
    require("cuda", f"device {name}:")
    if int(number or 0) >= _gpus():
        raise ConfigError(
            f"device {name}: PyTorch finds {_gpus()} CUDA devices; use cpu, or install a CUDA build of PyTorch"
        )


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
