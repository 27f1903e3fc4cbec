"""What a file of n bytes may promise: symbols, and work. A decoder's memory and time are bounded by the file's length.

A trained file is far from each bound; a small file that asks for much is refused before anything is allocated or
computed, and an encoder pads a scene that compresses too well.
"""

from compgs.codec.content import Dimensions, FileContent
from compgs.codec.format import (
    FREE_HEAD_PRODUCTS,
    FREE_NETWORK_PRODUCTS,
    FREE_SYMBOLS,
    HEAD_PRODUCTS_PER_BYTE,
    NETWORK_PRODUCTS_PER_BYTE,
    SYMBOLS_PER_BYTE,
)
from compgs.codec.integer_network import IntegerNetwork
from compgs.errors import CorruptSection

# What is counted, what is free, and how much of it a byte may bring.
SYMBOLS = ("symbols", FREE_SYMBOLS, SYMBOLS_PER_BYTE)
NETWORK_PRODUCTS = ("products of entropy networks", FREE_NETWORK_PRODUCTS, NETWORK_PRODUCTS_PER_BYTE)
HEAD_PRODUCTS = ("products of prediction heads", FREE_HEAD_PRODUCTS, HEAD_PRODUCTS_PER_BYTE)
Limit = tuple[str, int, int]


def check_amount(limit: Limit, amount: int, size: int, section: str) -> None:
    """Raises CorruptSection if `amount` is more than a file of `size` bytes may have."""
    what, free, per_byte = limit
    if amount > free + per_byte * size:
        raise CorruptSection(
            f"{section}: {amount} {what}, a file of {size} bytes has at most {free + per_byte * size}"
        )


def symbols(dimensions: Dimensions, anchors: int) -> int:
    """Symbols of so many anchors with all their coupled primitives."""
    return anchors * dimensions.symbols_per_anchor()


def least_bytes(content: FileContent, anchors: int | None = None) -> int:
    """Bytes that a file needs at least, or its beginning up to so many of the content's anchors (canonical order)."""
    anchors = len(content.coordinates) if anchors is None else anchors
    coupled = int(content.mask[:anchors].sum())
    products = sum(g.prior.products for g in content.groups if isinstance(g.prior, IntegerNetwork))
    weights = sum(tensor.values.size for _, tensor in content.heads)
    amounts = (
        (SYMBOLS, symbols(content.dimensions, anchors)),
        (NETWORK_PRODUCTS, anchors * products),
        (HEAD_PRODUCTS, coupled * weights),
    )
    return max(-(-max(0, amount - free) // per_byte) for (_, free, per_byte), amount in amounts)
