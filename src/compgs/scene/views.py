"""What was captured: views (image + camera), points, and the scene that holds them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgs.cameras import Camera
from compgs.pictures import png, table

THUMBNAILS = 6  # photographs of a scene that a notebook shows


@dataclass(frozen=True, eq=False)
class View:
    """A photograph and where it was taken from."""

    name: str  # relative to the folder of the images, "/" between its parts
    camera: Camera
    pixels: (
        np.ndarray | Callable[[], np.ndarray]
    )  # [H, W, 3] uint8, display RGB, undistorted; or what reads them
    # [H, W] bool, True where a pixel counts (`scene/masks.py`), or what reads it; None: all count
    counted: np.ndarray | Callable[[], np.ndarray | None] | None = None
    # what the header says of the light that was let in (`headers`), or what reads it; None: nothing
    light: float | Callable[[], float | None] | None = None

    def __repr__(self) -> str:
        return f"View({self.name!r}, {self.camera.width} x {self.camera.height} pixels)"

    def _repr_png_(self) -> bytes:
        """The photograph, in a notebook."""
        return png(self.image)

    @property
    def image(self) -> np.ndarray:
        """[H, W, 3] uint8, display RGB, undistorted; perhaps read only now. Raises UnreadableImage."""
        return self.pixels() if callable(self.pixels) else self.pixels

    @property
    def mask(self) -> np.ndarray | None:
        """[H, W] bool, True where a pixel counts in training and in metrics; None: all. Raises UnreadableImage."""
        return self.counted() if callable(self.counted) else self.counted

    @property
    def stops(self) -> float | None:
        """Log2 of the light that the header says was let in, or None: compares with views of one capture alone."""
        return self.light() if callable(self.light) else self.light


@dataclass(frozen=True, eq=False)
class Points:
    """Sparse points of the scene, as structure from motion gives them."""

    positions: np.ndarray  # [P, 3] float64 as read, world units
    colors: np.ndarray  # [P, 3] uint8, display RGB

    def __repr__(self) -> str:
        return f"Points({len(self):,})"

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False)
class Scene:
    """Views and points, split into what is trained on and what is held out."""

    name: str
    train_views: tuple[View, ...]
    test_views: tuple[View, ...]  # held out
    points: Points
    background: tuple[float, float, float]  # display RGB, 0 to 1, behind everything
    extent: float  # world units: 1.1 x the largest distance of a camera from their mean (3DGS)
    source: Path  # the folder that was read
    notes: tuple[str, ...] = ()  # what was decided or replaced on loading, one sentence each
    poses_in_doubt: str = ""  # why poses may be off by a pixel, in words; empty: nothing says so
    split: str = ""  # how the held-out views were chosen, in words; empty: not known, or none is held out
    guessed: bool = False  # the points are at random places where the cameras look: too few were known

    def __repr__(self) -> str:
        views = f"{len(self.train_views)} training views, {len(self.test_views)} held out"
        return f"Scene({self.name!r}, {views}, {len(self.points):,} points)"

    def _repr_html_(self) -> str:
        """Show in a notebook what there is, and some of the photographs."""
        views = (*self.train_views, *self.test_views)
        first = views[0].camera if views else None
        facts = {
            "training views": len(self.train_views),
            "held out": len(self.test_views),
            "pixels": f"{first.width} x {first.height}" if first else "",
            "points": f"{len(self.points):,}",
            **{f"note {i}": note for i, note in enumerate(self.notes, 1)},
        }
        shown = views[:: max(1, len(views) // THUMBNAILS)][:THUMBNAILS]
        return table(self.name, facts, [view.image for view in shown])


def scene_extent(centers: np.ndarray) -> float:  # centers: [V, 3]
    """1.1 x the largest distance of a camera from their mean centre, in world units (3DGS)."""
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
