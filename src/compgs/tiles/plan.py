"""The division of a capture: rectangles on the ground that leave nothing out and overlap nowhere.

    points ──seen how often──► cuts ──► cores (a partition) ──margins──► padded cores ──► views of each tile

A tile holds the anchors in its core, and is trained with the points of its padded core and the views that show it. The
outer cores have no end: the sky and the far background are theirs.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.errors import CheckpointError, ConfigError
from compgs.formats.tiled import Core, core_entry, core_from_entry, ground_entry
from compgs.formats.tiled_ground import Ground, contains, cores_of, grid_of, sides
from compgs.outputs import write_json
from compgs.scene.points import MIN_POINTS, median_spacing
from compgs.scene.views import Scene
from compgs.tiles.ground import ground_of
from compgs.tiles.sight import shares_of_picture, times_seen

PLAN_NAME = "plan.json"
SCHEMA = "compgs tiles plan 1"
# A tile for each so many points or views: what a training keeps within a few gigabytes.
POINTS_A_TILE, VIEWS_A_TILE = 250_000, 400
# By how much a tile's training sees more than its core at each edge: this share of the core's side, but at most as far
# as this share of the core's points lies beyond. Sides say little where a few points lie far away.
MARGIN = 0.2
LEAST_SHARE = 0.1  # of a picture, from which on a view shows a tile
FEWEST_VIEWS = 8  # of a tile, if so many show anything of it
LOOKED_AT = 20_000  # points by which cuts and views are found; a share needs no more
LOOKED_AT_A_TILE = 500


@dataclass(frozen=True)
class Tile:
    """A part of the capture."""

    name: str  # column_row
    core: Core
    padded: Core
    points: int  # in the core
    spacing: float  # world units: the median distance of the padded core's points to their nearest neighbours
    views: tuple[str, ...]  # names of training views

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return {
            "name": self.name,
            "core": core_entry(self.core),
            "padded": core_entry(self.padded),
            "points": self.points,
            "spacing": self.spacing,
            "views": list(self.views),
        }

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> "Tile":
        """Inverse of `to_dict`. Raises ValueError, KeyError, TypeError."""
        core, padded = (core_from_entry(entry[name]) for name in ("core", "padded"))
        points, spacing, views = int(entry["points"]), float(entry["spacing"]), entry["views"]
        if not 0 < spacing < math.inf:
            raise ValueError(f"a spacing of {spacing}")
        return cls(str(entry["name"]), core, padded, points, spacing, tuple(map(str, views)))


@dataclass(frozen=True)
class Plan:
    """All tiles of a capture, column by column."""

    scene: str  # its name
    columns: int  # along the ground's first axis
    rows: int
    ground: Ground
    tiles: tuple[Tile, ...]

    @property
    def grid(self) -> str:
        return f"{self.columns}x{self.rows}"

    def tile(self, name: str) -> Tile:
        """Raises ConfigError for a name that no tile has."""
        for each in self.tiles:
            if each.name == name:
                return each
        raise ConfigError(
            f"tile {name!r}: not of the plan, which has {', '.join(t.name for t in self.tiles)}"
        )

    def to_dict(self) -> dict[str, Any]:
        """The content of `plan.json`."""
        return {
            "schema": SCHEMA,
            "scene": self.scene,
            "columns": self.columns,
            "rows": self.rows,
            "ground": ground_entry(self.ground),
            "tiles": [tile.to_dict() for tile in self.tiles],
        }


def grid_for(scene: Scene) -> tuple[int, int]:
    """Columns and rows of tiles that are about square, one for each POINTS_A_TILE points and VIEWS_A_TILE views."""
    points, views = len(scene.points), len(scene.train_views)
    count = math.ceil(max(points / POINTS_A_TILE, views / VIEWS_A_TILE, 1))
    cameras = [view.camera for view in scene.train_views]
    return grid_of(count, ground_of(cameras, scene.points.positions).places(scene.points.positions))


def plan_tiles(scene: Scene, columns: int, rows: int) -> Plan:
    """Cut a capture in columns, and each of them in rows, so that the points of all tiles are seen equally often.

    Raises ConfigError where a tile would have too few points, or no view.
    """
    cameras = [view.camera for view in scene.train_views]
    positions = np.asarray(scene.points.positions, dtype=np.float64)
    ground = ground_of(cameras, positions)
    looked_at = max(LOOKED_AT, LOOKED_AT_A_TILE * columns * rows)
    sample = positions[:: max(1, len(positions) // looked_at)]
    cores = cores_of(ground.places(sample), times_seen(cameras, sample), columns, rows)
    places = ground.places(positions)
    inside = {name: contains(core, places) for name, core in cores.items()}
    for name, points in inside.items():
        if points.sum() < MIN_POINTS:
            raise ConfigError(
                f"grid {columns}x{rows}: tile {name} would have {points.sum()} points, expected at least "
                f"{MIN_POINTS}; use fewer tiles"
            )
    padded = {name: _padded(core, places, inside[name]) for name, core in cores.items()}
    views = _views_of(scene, cameras, sample, ground, cores, padded)
    tiles = tuple(
        Tile(
            name=name,
            core=core,
            padded=padded[name],
            points=int(inside[name].sum()),
            spacing=median_spacing(positions[contains(padded[name], places)]),
            views=views[name],
        )
        for name, core in cores.items()
    )
    for tile in tiles:
        if not tile.views:
            raise ConfigError(f"grid {columns}x{rows}: no view shows tile {tile.name}; use fewer tiles")
    return Plan(scene.name, columns, rows, ground, tiles)


def _padded(core: Core, places: np.ndarray, inside: np.ndarray) -> Core:
    """The core with its margins; places: [P, 2] of all points, inside: [P] bool."""
    lengths, few = sides(places[inside]), math.ceil(MARGIN * inside.sum())
    low, high = list(core.low), list(core.high)
    for axis in (0, 1):
        other = 1 - axis
        beside = (places[:, other] >= core.low[other]) & (places[:, other] < core.high[other])
        for edges, sign in ((low, -1), (high, 1)):
            if math.isfinite(edges[axis]):
                beyond = sign * (places[beside, axis] - edges[axis])
                nearest = np.sort(beyond[beyond >= 0])[:few]
                margin = MARGIN * lengths[axis]
                edges[axis] += sign * min(margin, float(nearest[-1]) if len(nearest) else margin)
    return Core((low[0], low[1]), (high[0], high[1]))


def _views_of(
    scene: Scene,
    cameras: Sequence[Camera],
    sample: np.ndarray,
    ground: Ground,
    cores: dict[str, Core],
    padded: dict[str, Core],
) -> dict[str, tuple[str, ...]]:
    """Names of the views of each tile: those that show enough of it, and every view where it shows most."""
    places = ground.places(sample)

    def shares(areas: dict[str, Core]) -> np.ndarray:
        members = np.stack([contains(area, places) for area in areas.values()], axis=1)
        return shares_of_picture(cameras, sample, members.astype(np.float64))

    shown = shares(padded)  # [V, T]
    chosen = shown >= LEAST_SHARE
    whole = shares(cores)
    sees = np.flatnonzero(whole.any(axis=1))
    chosen[sees, whole[sees].argmax(axis=1)] = True
    for tile in range(len(padded)):
        if chosen[:, tile].sum() < FEWEST_VIEWS:
            best = np.argsort(-shown[:, tile], kind="stable")[:FEWEST_VIEWS]
            chosen[best[shown[best, tile] > 0], tile] = True
    names = [view.name for view in scene.train_views]
    return {
        name: tuple(view for view, is_of in zip(names, column, strict=True) if is_of)
        for name, column in zip(padded, chosen.T, strict=True)
    }


# the file ----------------------------------------------------------------------------------------------------------


def write_plan(folder: Path, plan: Plan) -> None:
    """Raises OutputError."""
    write_json(folder / PLAN_NAME, plan.to_dict())


def read_plan(path: Path) -> Plan:
    """Raises CheckpointError if the file is not there, or is no plan."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema"] != SCHEMA:
            raise ValueError(f"schema {content['schema']!r}, expected {SCHEMA!r}")
        tiles = tuple(map(Tile.from_dict, content["tiles"]))
        ground = Ground.from_entry(content["ground"])
        return Plan(str(content["scene"]), int(content["columns"]), int(content["rows"]), ground, tiles)
    except OSError as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error.strerror}); compgs tiles makes a plan"
        ) from error
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path}: not a plan of tiles ({error!s:.200}); train anew") from error
