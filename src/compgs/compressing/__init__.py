"""From splats to a small file, without photographs: the splats are rendered, and the renderings are trained on.

`compgs.compress(source, output)` does it all; `begin`, `Compression.train` and `Compression.judge` are its parts.
"""

from compgs.extras import require

require("train", "compgs.compress")  # before anything below loads what may not be installed

from compgs.compressing.compression import (  # noqa: E402
    Compressed,
    Compression,
    begin,
    check_places,
    compress,
    default_config,
    resumed,
)
from compgs.compressing.run import Looking, folder_of  # noqa: E402

__all__ = [
    "Compressed",
    "Compression",
    "Looking",
    "begin",
    "check_places",
    "compress",
    "default_config",
    "folder_of",
    "resumed",
]
