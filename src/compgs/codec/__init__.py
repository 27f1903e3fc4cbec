"""How bits become bytes: integers, exact on every machine (docs/bitstream.md).

| file | does |
|---|---|
| `encoder`, `decoder` | a trained model to a file, and a file to a scene: where to begin reading |
| `writer`, `reader` | sections to bytes, and back |
| `content` | what a file holds, as integers |
| `latents` | the latents of a range of anchors, group after group |
| `format`, `fields`, `sections` | the container, numbers in it, and the small sections |
| `octree`, `mask_coder`, `tmc3` | positions, and which coupled primitives exist |
| `rans`, `binary_coder` | the entropy coders |
| `tables`, `integer_network`, `weights` | probabilities: tables, networks in integers, and their weights |
| `rows`, `row_fitting` | what symbols say about later ones of their row |
| `neighbour_context` | what anchors around say about one |
| `viewpoints`, `viewpoint_cameras` | cameras that the file keeps to look from |
| `limits` | what a file of so many bytes may promise |
| `reduce` | a smaller file from a file, without training |

`encode` and `decode` are resolved on first use: only the encoder of trained models needs torch.
"""

from typing import TYPE_CHECKING

__all__ = ["decode", "encode"]

if TYPE_CHECKING:
    from compgs.codec.decoder import decode
    from compgs.codec.encoder import encode


def __getattr__(name: str) -> object:
    if name == "encode":
        from compgs.extras import require

        require("train", "compgs.encode")
        from compgs.codec.encoder import encode

        return encode
    if name == "decode":
        from compgs.codec.decoder import decode

        return decode
    raise AttributeError(f"module 'compgs.codec' has no attribute {name!r}")
