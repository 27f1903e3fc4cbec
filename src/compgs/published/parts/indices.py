"""Indices of a codebook in a file: of as many bits as its entries need, or, in ascending order, as counts."""

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.packed import Packed, packed_bits, unpacked_bits


def index_bits(codes: int) -> int:
    """Bits of an index of so many codes: ceil(log2 K), 0 for a single code, which needs none."""
    return max(0, codes - 1).bit_length()


def packed_indices(labels: np.ndarray, codes: int) -> np.ndarray:
    """[ceil(M x bits / 8)] uint8: labels [M] of so many codes."""
    bits = index_bits(codes)
    return packed_bits(labels, bits) if bits else np.zeros(0, np.uint8)


def stored_indices(packed: Packed, name: str, count: int, codes: int) -> np.ndarray:
    """Inverse of `packed_indices`, [count] int64. Raises SplatFileError for labels of codes that there are not."""
    bits = index_bits(codes)
    data = packed.array(name, np.uint8, (-(-count * bits // 8),))
    labels = unpacked_bits(data, bits, count) if bits else np.zeros(count, np.int64)
    return checked_labels(packed, name, labels, codes)


def checked_labels(packed: Packed, name: str, labels: np.ndarray, codes: int) -> np.ndarray:
    """The same labels [M]. Raises SplatFileError unless each is one of so many codes."""
    wrong = np.flatnonzero((labels < 0) | (labels >= codes))
    if len(wrong):
        raise SplatFileError(
            f"{packed.path}: {name}: expected indices of {codes} entries, found {labels[wrong[0]]} for splat {wrong[0]}"
        )
    return labels


def label_counts(labels: np.ndarray, codes: int) -> np.ndarray:
    """[K] uint32: how many splats have each code, where the splats are in ascending order of it."""
    assert (np.diff(labels) >= 0).all()
    return np.bincount(labels, minlength=codes).astype(np.uint32)


def stored_counts(packed: Packed, name: str, count: int, codes: int) -> np.ndarray:
    """Inverse of `label_counts`, [count] int64. Raises SplatFileError unless they are as many as there are splats."""
    counts = packed.array(name, np.uint32, (codes,)).astype(np.int64)
    if counts.sum() != count:
        raise SplatFileError(f"{packed.path}: {name}: are of {counts.sum()} splats, expected {count}")
    return np.repeat(np.arange(codes), counts)
