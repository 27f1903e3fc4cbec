"""Scenes larger than memory: a capture is divided on the ground, its tiles are trained one by one, and put together.

```text
ground.py     the plane that is divided            sight.py     what each view shows of each tile
plan.py       the division: cores, margins, views  block.py     the capture as one tile's training sees it
cutting.py    a trained tile without its margins   jobs.py      a run for each tile, and all of them merged
```

Rectangles on the ground are those of `compgs.formats.tiled_ground`, by which files are divided, too.
`compgs.formats.tiled` is what comes out: a folder of .cgs files that is opened tile by tile.
"""

from compgs.tiles.block import block_scene
from compgs.tiles.cutting import cut_to_core
from compgs.tiles.jobs import TileJob, forget, merge, run_tiles, tile_jobs
from compgs.tiles.plan import Plan, Tile, grid_for, plan_tiles, read_plan, write_plan

__all__ = [
    "Plan",
    "Tile",
    "TileJob",
    "block_scene",
    "cut_to_core",
    "forget",
    "grid_for",
    "merge",
    "plan_tiles",
    "read_plan",
    "run_tiles",
    "tile_jobs",
    "write_plan",
]
