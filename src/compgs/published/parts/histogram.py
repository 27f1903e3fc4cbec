"""Whole numbers entropy-coded by their own histogram, with this project's coder (`compgs.codec.rans`).

Three arrays of the file, by the name of the numbers:

| array | what |
|---|---|
| `NAME.lowest` | the symbol that the histogram begins with |
| `NAME.levels` | log2 of the histogram in eighths; the last is for all numbers outside of it |
| `NAME.symbols` | the coded numbers |
"""

import numpy as np

from compgs.codec.rans import decode_symbols, encode_symbols
from compgs.codec.tables import (
    LEVELS,
    MAX_HYPER_SYMBOLS,
    MAX_LOWEST,
    HyperTable,
    channel_tables,
    hyper_tables,
)
from compgs.errors import CorruptSection, SplatFileError
from compgs.formats.packed import Packed

_NO_PRIOR = np.zeros((1, 1))  # the histogram alone


def packed_symbols(name: str, symbols: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of whole numbers [M] int32, M at least 1."""
    (table,) = hyper_tables(_NO_PRIOR, symbols[:, None].astype(np.int64))
    data = encode_symbols(
        symbols.astype(np.int32), np.zeros(len(symbols), np.uint8), channel_tables((table,))
    )
    return {
        f"{name}.lowest": np.array([table.lowest], np.int32),
        f"{name}.levels": table.levels,
        f"{name}.symbols": np.frombuffer(data, np.uint8),
    }


def unpacked_symbols(packed: Packed, name: str, count: int) -> np.ndarray:
    """Inverse of `packed_symbols`: [count] int32. Raises SplatFileError for what it cannot have made."""
    lowest = int(packed.array(f"{name}.lowest", np.int32, (1,))[0])
    levels = packed.array(f"{name}.levels", np.uint8, (None,))
    data = packed.array(f"{name}.symbols", np.uint8, (None,)).tobytes()
    whole = 2 <= len(levels) <= MAX_HYPER_SYMBOLS + 1 and levels.max() < LEVELS
    if not whole or abs(lowest) > MAX_LOWEST:
        raise SplatFileError(
            f"{packed.path}: {name}: expected a histogram of 1 to {MAX_HYPER_SYMBOLS} symbols near 0, found "
            f"{len(levels) - 1} from {lowest} on"
        )
    tables = channel_tables((HyperTable(lowest, levels),))
    try:
        return decode_symbols(data, np.zeros(count, np.uint8), tables, f"{packed.path}: {name}")
    except CorruptSection as error:
        raise SplatFileError(f"{error}; copy it again") from error
