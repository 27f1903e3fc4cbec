"""What the program knows of a method."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from compgs.config import Config

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run

# Settings of plain 3DGS, which methods that build on it have, too.
SPLAT_SETTINGS = (
    "splats",
    "training.steps",
    "training.views_per_step",
    "training.seed",
    "training.exposure",
    "training.poses",
    "training.robust",
)
# Of files in the shared container: `compgs.formats.packed.SUFFIX`, without loading the formats.
PACKED_SUFFIX = ".packed"
Presets = Mapping[str, Mapping[str, Mapping[str, Any]]]


class KnowsItsFile(Protocol):
    """What a training gives that is the content of a file already, such as `parts.content.Content`."""

    def write(self, path: Path) -> int: ...


def write_itself(content: KnowsItsFile, path: Path, config: Any) -> int:
    """`Method.write` of such methods. Raises OutputError."""
    return content.write(path)


class Trains(Protocol):
    def __call__(self, scene: "Scene", config: Any, run: "Run", start: "SplatModel | None" = None) -> Any: ...


@dataclass(frozen=True)
class Method:
    """One way from a scene to a file, and from the file to pictures."""

    name: str  # by which it is chosen
    description: str  # one line
    reference: str  # who published it, and where
    suffix: str  # of the file's name, with the dot
    uses: tuple[
        str, ...
    ]  # sections of its settings (`splats`) and single settings (`training.steps`) that it uses
    # What it gives can be rendered (`compgs.render.Renderable`, or with `as_hybrid_model`) and written. With `start`,
    # trained splats take the place of its plain 3DGS phase. Raises as `compgs.train` does.
    train: Trains
    # Writes it whole or not at all, replacing what is there; the number of bytes. Raises OutputError.
    write: Callable[[Any, Path, Any], int]  # what was trained, path, settings
    settings: type[Config] = Config  # or a dataclass derived from it, with a section of the method's own
    # Its own, beside those of `compgs.config`: what differs from the default, by section and name.
    presets: Presets = field(default_factory=dict)
    from_splats: bool = False  # takes `start`
