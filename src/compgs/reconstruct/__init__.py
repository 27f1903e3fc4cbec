"""Photographs or a video without poses -> a scene that `load_scene` reads: poses and points by COLMAP (pycolmap). And
a capture that has cameras -> the same with better ones.

```text
photographs.py   finds photographs, stores them upright            video.py    the sharpest frames of a video
cameras.py       which photographs share a camera                   mapping.py  the three stages of COLMAP, run aside
worker.py        the process that runs them                         report.py   what came out: numbers and a picture
retrieval.py     which photographs are worth comparing              adjust.py   better cameras for a capture
adjusting.py     the bundle adjustment itself, run aside            features.py  features, for both
scene_folder.py  a folder that appears when all of it is there
```
"""

from compgs.reconstruct.adjust import Adjusted, AdjustOptions, adjust
from compgs.reconstruct.mapping import Stage
from compgs.reconstruct.photographs import find_photographs, holds_photographs
from compgs.reconstruct.reconstruct import ReconstructOptions, reconstruct
from compgs.reconstruct.reconstruction import Reconstruction

__all__ = [
    "AdjustOptions",
    "Adjusted",
    "ReconstructOptions",
    "Reconstruction",
    "Stage",
    "adjust",
    "find_photographs",
    "holds_photographs",
    "reconstruct",
]
