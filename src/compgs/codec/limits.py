"""What a file of n bytes may promise: symbols, flags, and work. Its length bounds a decoder's memory and time.

A trained file is far from each bound; a small file that asks for much is refused before anything is allocated or
computed, and an encoder pads a scene that compresses too well.
"""

from itertools import starmap

from compgs.codec.content import Dimensions, FileContent
from compgs.codec.format import (
    FLAGS_PER_BYTE,
    FREE_FLAGS,
    FREE_HEAD_PRODUCTS,
    FREE_NETWORK_PRODUCTS,
    FREE_NODES,
    FREE_SYMBOLS,
    HEAD_PRODUCTS_PER_BYTE,
    NETWORK_PRODUCTS_PER_BYTE,
    NODES_PER_BYTE,
    SYMBOLS_PER_BYTE,
)
from compgs.codec.integer_network import IntegerNetwork
from compgs.errors import CorruptSection
from compgs.ordering.order import walked_nodes

# What is counted, what is free, and how much of it a byte may bring.
SYMBOLS = ("symbols", FREE_SYMBOLS, SYMBOLS_PER_BYTE)
NETWORK_PRODUCTS = ("products of entropy networks", FREE_NETWORK_PRODUCTS, NETWORK_PRODUCTS_PER_BYTE)
HEAD_PRODUCTS = ("products of prediction heads", FREE_HEAD_PRODUCTS, HEAD_PRODUCTS_PER_BYTE)
FLAGS = ("flags of masks", FREE_FLAGS, FLAGS_PER_BYTE)
NODES = ("nodes of the octree", FREE_NODES, NODES_PER_BYTE)
Limit = tuple[str, int, int]


def check_amount(limit: Limit, amount: int, size: int, section: str) -> None:
    """Raises CorruptSection if `amount` is more than a file of `size` bytes may have."""
    if amount > most(limit, size):
        raise CorruptSection(
            f"{section}: {amount} {limit[0]}, a file of {size} bytes has at most {most(limit, size)}"
        )


def most(limit: Limit, size: int) -> int:
    """What a file of `size` bytes may have."""
    _, free, per_byte = limit
    return free + per_byte * size


def symbols(dimensions: Dimensions, anchors: int) -> int:
    """Symbols of so many anchors with all their coupled primitives."""
    return anchors * dimensions.symbols_per_anchor()


def least_bytes(content: FileContent, anchors: int | None = None) -> int:
    """Bytes that a file needs at least, or its beginning up to so many of the content's anchors (canonical order), by
    what is there for each of these. Any beginning that is a scene needs `least_bytes_of_all`, too.
    """
    anchors = len(content.coordinates) if anchors is None else anchors
    coupled = int(content.mask[:anchors].sum())
    products = sum(g.prior.products for g in content.groups if isinstance(g.prior, IntegerNetwork))
    weights = sum(tensor.values.size for _, tensor in content.heads)
    amounts = (
        (SYMBOLS, symbols(content.dimensions, anchors)),
        (NETWORK_PRODUCTS, anchors * products),
        (HEAD_PRODUCTS, coupled * weights),
    )
    return max(starmap(_bytes_for, amounts))


def least_bytes_of_all(content: FileContent) -> int:
    """Bytes that a file needs at least for the positions and masks of all anchors, as each beginning has them."""
    flags, nodes = content.mask.size, walked_nodes(content.coordinates)
    return max(_bytes_for(FLAGS, flags), _bytes_for(NODES, nodes))


def _bytes_for(limit: Limit, amount: int) -> int:
    _, free, per_byte = limit
    return -(-max(0, amount - free) // per_byte)
