"""Plain 3D Gaussian Splatting, in the files that people keep it in: .ply as published, .spz, .sog."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from compgs.errors import ConfigError
from compgs.methods.method import SPLAT_SETTINGS, Method
from compgs.notes import note

if TYPE_CHECKING:
    from compgs.config import Config
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def train_plain(
    scene: "Scene", config: "Config", run: "Run", start: "SplatModel | None" = None
) -> "SplatModel":
    """Plain 3DGS; with `start`, these splats as they are. Raises as `compgs.train` does."""
    from compgs.training.splats.phases import Phase, train_phases

    return train_phases(scene, (Phase(config),), run, start).model()


def _train_near(
    scene: "Scene", config: "Config", run: "Run", start: "SplatModel | None" = None
) -> "SplatModel":
    """The same for a format that does not say where its positions count from."""
    check_near(scene, run.method)
    return train_plain(scene, config, run, start)


def check_near(scene: "Scene", method: str) -> None:
    """Raises ConfigError where a scene lies too far away for the file of `spz`, `sog` and their pruned kin."""
    from compgs.scene.world import world_offset

    if any(world_offset(scene)):
        suffix = method.rpartition("-")[2]
        raise ConfigError(
            f"{scene.name}: lies far from the origin of its coordinates, and a .{suffix} file cannot say where its "
            "positions count from; use method 3dgs, or move the capture"
        )


def _writes(suffix: str) -> "Callable[[SplatModel, Path, Config], int]":
    def write(model: "SplatModel", path: Path, config: "Config") -> int:
        from compgs.formats import encoded, told
        from compgs.outputs import write_bytes

        name = suffix.removeprefix(".")
        data = encoded(model.splats, name)
        if text := told(model.splats, name):
            note(path, text)
        write_bytes(path, data)
        return len(data)

    return write


PLAIN = Method(
    name="3dgs",
    description="plain 3D Gaussian Splatting, uncompressed",
    reference="Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023",
    suffix=".ply",
    uses=SPLAT_SETTINGS,
    train=train_plain,
    write=_writes(".ply"),
    from_splats=True,
)
SPZ = Method(
    name="spz",
    description="plain 3DGS in Niantic's format: columns of fixed point numbers, gzip",
    reference="Niantic, spz, 2024",
    suffix=".spz",
    uses=SPLAT_SETTINGS,
    train=_train_near,
    write=_writes(".spz"),
    from_splats=True,
)
SOG = Method(
    name="sog",
    description="plain 3DGS in PlayCanvas' format: codebooks and images in Morton order",
    reference="PlayCanvas, Spatially Ordered Gaussians, 2025",
    suffix=".sog",
    uses=SPLAT_SETTINGS,
    train=_train_near,
    write=_writes(".sog"),
    from_splats=True,
)
