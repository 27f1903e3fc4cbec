"""How bits become bytes: integers, exact on every machine (docs/bitstream.md).

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
