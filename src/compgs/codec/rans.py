"""Asymmetric numeral systems over frequency tables (Duda 2013; docs/bitstream.md, "Streams").

The coder knows no model: a symbol comes with the number of its table. 64-bit states, 32-bit words, 16-bit
frequencies. ANS and not a range coder, because decoding is a multiplication and a table look-up without a
division; two interleaved states, because they overlap in the processor; chunks of a fixed number of symbols,
because each has its own states and words, so that threads decode them side by side and the result does not
depend on how many there are.

    encoder   symbols last to first, words written backwards decoder   the mirror image: symbols first to
    last, words read forwards, and it must end in the initial states
"""

import numpy as np

from compgs.codec.fields import FieldReader, varint
from compgs.codec.rows import (
    FAR,
    Rows,
    evidence,
    followed_tables,
    seen_after,
    shift_after,
    shift_edges,
    shifted,
)
from compgs.codec.tables import LOOKUP_BITS, PRECISION_BITS, FrequencyTables
from compgs.errors import CorruptSection
from compgs.numerics.compiled import chunk_of, njit, rows_a_thread

CHUNK_SYMBOLS = 1 << 20
SINGLE_STATE_SYMBOLS = (
    1 << 18
)  # a chunk with fewer symbols has one state: a second would cost 6 bytes and save nothing
INITIAL_STATE = 1 << 31  # states are at least this, and below 2^63
MAX_ESCAPE_BYTES = 5

_INITIAL = np.uint64(INITIAL_STATE)
_PRECISION = np.uint64(PRECISION_BITS)
_SLOT = np.uint64((1 << PRECISION_BITS) - 1)
_LOOKUP = np.uint64(PRECISION_BITS - LOOKUP_BITS)
_WORD = np.uint64(32)
_ONE = np.uint64(1)
_LOW_WORD = np.uint64((1 << 32) - 1)
_FULL = np.uint64(63 - PRECISION_BITS)  # a state of frequency << 47 or more would leave 63 bits when coded
# Stands for an escaped symbol until its value is read; no table holds it.
_ESCAPED = np.int32(-(1 << 31))
ALONE = Rows()


def encode_symbols(
    symbols: np.ndarray,  # [M] int32
    table_index: np.ndarray,  # [M] uint8
    tables: FrequencyTables,
    rows: Rows = ALONE,
) -> bytes:
    """Bytes of a stream of symbols; nothing for no symbols."""
    count = len(symbols)
    if count == 0:
        return b""
    assert symbols.shape == table_index.shape and int(table_index.max()) < len(tables)
    chunks = -(-count // CHUNK_SYMBOLS)
    words = np.empty((chunks, _max_words(min(count, CHUNK_SYMBOLS))), np.uint32)
    first = np.zeros(chunks, np.int64)
    escapes = np.zeros(chunks, np.int64)
    layout = (tables.lowest, tables.counts, tables.offsets, tables.cumulative)
    symbols = np.ascontiguousarray(symbols, np.int32)
    table_index = _followed(symbols, table_index, tables, rows)
    _encode_chunks(symbols, table_index, *layout, words, first, escapes)
    escape_bytes = b""
    if escapes.any():
        escape_bytes = _collect_escapes(
            symbols, table_index, tables.lowest, tables.counts, int(escapes.sum())
        ).tobytes()
    payload = [words[i, first[i] :].astype("<u4").tobytes() for i in range(chunks)]
    sizes = [varint(len(p) // 4) for p in payload]
    return b"".join([*sizes, varint(len(escape_bytes)), *payload, escape_bytes])


def _followed(
    symbols: np.ndarray, table_index: np.ndarray, tables: FrequencyTables, rows: Rows
) -> np.ndarray:
    """The tables that symbols are coded with."""
    index = np.ascontiguousarray(table_index, np.uint8)
    return followed_tables(symbols, index, tables, rows, CHUNK_SYMBOLS) if rows.inertia else index


def decode_symbols(
    data: bytes,
    table_index: np.ndarray,  # [M] uint8
    tables: FrequencyTables,
    section: str = "symbols",
    rows: Rows = ALONE,
) -> np.ndarray:  # [M] int32
    """Inverse of `encode_symbols`. Raises CorruptSection, with the section's name, for bytes that it cannot
    have made.
    """
    reader = FieldReader(data, section)
    symbols = read_symbols(reader, table_index, tables, rows)
    reader.end()
    return symbols


def skip_symbols(reader: FieldReader, count: int) -> int:
    """Bytes of a stream of `count` symbols, which is read over."""
    start = reader.position
    ends, escape_size = _sizes(reader, count)
    reader.bytes(4 * int(ends[-1]) + escape_size, "words and escapes")
    return reader.position - start


def _sizes(reader: FieldReader, count: int) -> tuple[np.ndarray, int]:
    """Where each chunk's words end [chunks + 1], and bytes of escapes."""
    chunks = -(-count // CHUNK_SYMBOLS)
    ends = np.zeros(chunks + 1, np.int64)
    if count == 0:
        return ends, 0
    for i in range(chunks):
        inside = min(CHUNK_SYMBOLS, count - i * CHUNK_SYMBOLS)
        ends[i + 1] = ends[i] + reader.varint(f"words of chunk {i}", 2, _max_words(inside))
    return ends, reader.varint("bytes of escapes", 0, MAX_ESCAPE_BYTES * count)


def read_symbols(
    reader: FieldReader,
    table_index: np.ndarray,  # [M] uint8
    tables: FrequencyTables,
    rows: Rows = ALONE,
) -> np.ndarray:  # [M] int32
    """`decode_symbols` of a stream behind which others follow."""
    count, section = len(table_index), reader.section
    if count == 0:
        return np.zeros(0, np.int32)
    assert int(table_index.max()) < len(tables)
    ends, escape_size = _sizes(reader, count)
    chunks = len(ends) - 1
    words = np.frombuffer(reader.bytes(4 * int(ends[-1]), "words"), "<u4").astype(np.uint32)
    escape_data = np.frombuffer(reader.bytes(escape_size, "escapes"), np.uint8).copy()
    symbols = np.empty(count, np.int32)
    escapes = np.zeros(chunks, np.int64)
    table_index = np.ascontiguousarray(table_index, np.uint8)
    layout = (tables.lowest, tables.counts, tables.offsets, tables.cumulative, tables.lookup)
    if rows.inertia:
        table_index = table_index.copy()  # the kernel moves them
        constants = (evidence(), shift_edges())
        _decode_rows(
            words, ends, table_index, *layout, rows.width, rows.inertia, *constants, symbols, escapes
        )
    else:
        _decode_chunks(words, ends, table_index, *layout, symbols, escapes)
    if (escapes < 0).any():
        raise CorruptSection(
            f"{section}: chunk {int(np.argmax(escapes < 0))} does not end as an encoder ends it"
        )
    if not _insert_escapes(
        symbols, table_index, tables.lowest, tables.counts, escape_data, int(escapes.sum())
    ):
        raise CorruptSection(
            f"{section}: the {escape_size} bytes of escapes do not fit the {int(escapes.sum())} escapes"
        )
    return symbols


def escape_bits(
    symbols: np.ndarray,  # [M] int32
    table_index: np.ndarray,  # [M] uint8
    tables: FrequencyTables,
    rows: Rows = ALONE,
) -> tuple[float, int]:
    """Cross-entropy of the symbols under their tables, and bits of the escaped values beside it."""
    symbols = np.ascontiguousarray(symbols, np.int32)
    table_index = _followed(symbols, table_index, tables, rows)
    bits, escapes = _code_length(
        symbols, table_index, tables.lowest, tables.counts, tables.offsets, tables.costs()
    )
    if escapes == 0:
        return bits, 0
    return bits, 8 * len(_collect_escapes(symbols, table_index, tables.lowest, tables.counts, escapes))


def _max_words(symbols: int) -> int:
    """No symbol costs more than 16 bits; two states take two words each."""
    return symbols // 2 + 5


@njit(inline="always")
def _encode_one(state, position, symbol, lowest, count, offset, cumulative, words):
    """(state, position, 1 if escaped) after one symbol."""
    j = np.int64(symbol) - np.int64(lowest)
    escaped = 0
    if j < 0 or j >= count:
        j = np.int64(count)
        escaped = 1
    start = np.uint64(cumulative[offset + j])
    frequency = np.uint64(cumulative[offset + j + 1]) - start
    if state >= frequency << _FULL:
        position -= 1
        words[position] = np.uint32(state & _LOW_WORD)
        state >>= _WORD
    quotient = state // frequency
    state = (quotient << _PRECISION) + (state - quotient * frequency) + start
    return state, position, escaped


@njit
def _encode_chunk(symbols, index, lowest, counts, offsets, cumulative, words):
    """Fills `words` from the back; (first word used, number of escapes)."""
    position = len(words)
    even = _INITIAL
    odd = _INITIAL
    escapes = 0
    single = len(symbols) < SINGLE_STATE_SYMBOLS
    for i in range(len(symbols) - 1, -1, -1):
        t = index[i]
        if single or (i & 1) == 0:
            even, position, escaped = _encode_one(
                even, position, symbols[i], lowest[t], counts[t], offsets[t], cumulative, words
            )
        else:
            odd, position, escaped = _encode_one(
                odd, position, symbols[i], lowest[t], counts[t], offsets[t], cumulative, words
            )
        escapes += escaped
    if not single:
        position -= 2
        words[position] = np.uint32(odd & _LOW_WORD)
        words[position + 1] = np.uint32(odd >> _WORD)
    position -= 2
    words[position] = np.uint32(even & _LOW_WORD)
    words[position + 1] = np.uint32(even >> _WORD)
    return position, escapes


@njit(parallel=True, max_threads=rows_a_thread(1))
def _encode_chunks(symbols, index, lowest, counts, offsets, cumulative, words, first, escapes, part):
    for c in chunk_of(len(first), part):
        start = c * CHUNK_SYMBOLS
        stop = min(start + CHUNK_SYMBOLS, len(symbols))
        first[c], escapes[c] = _encode_chunk(
            symbols[start:stop], index[start:stop], lowest, counts, offsets, cumulative, words[c]
        )


@njit(inline="always")
def _decode_one(state, position, end, offset, cumulative, lookup, words):
    """(state, position, symbol's place in its table). Past the last word, position becomes end + 1 and stays
    there.
    """
    slot = state & _SLOT
    at = np.uint64(offset)
    place = at + np.uint64(lookup[slot >> _LOOKUP])
    slot32 = np.uint32(slot)
    while cumulative[place + _ONE] <= slot32:  # ends at the latest at the table's last entry, 65536
        place += _ONE
    start = np.uint64(cumulative[place])
    frequency = np.uint64(cumulative[place + _ONE]) - start
    state = frequency * (state >> _PRECISION) + slot - start
    if state < _INITIAL:
        if position < end:
            state = (state << _WORD) | np.uint64(words[np.uint64(position)])
            position += 1
        else:
            position = end + 1
    return state, position, np.int64(place - at)


@njit(inline="always")
def _first_states(words, begin, end, single):
    """(place of the next word, state of the even symbols, of the odd ones); place -1: no encoder writes these."""
    position = np.int64(begin + (2 if single else 4))
    even, odd = _INITIAL, _INITIAL
    if position <= end:
        even = (np.uint64(words[begin + 1]) << _WORD) | np.uint64(words[begin])
        if not single:
            odd = (np.uint64(words[begin + 3]) << _WORD) | np.uint64(words[begin + 2])
    else:
        position = np.int64(-1)
    if (even >> np.uint64(63)) != 0 or (odd >> np.uint64(63)) != 0 or even < _INITIAL or odd < _INITIAL:
        position = np.int64(-1)
    return position, even, odd


@njit(no_alias=True)
def _decode_chunk(words, begin, end, index, lowest, counts, offsets, cumulative, lookup, symbols):
    """Number of escapes, -1 if the words are not what an encoder writes."""
    single = len(symbols) < SINGLE_STATE_SYMBOLS
    position, even, odd = _first_states(words, begin, end, single)
    if position < 0:
        return -1
    escapes = 0
    for i in range(len(symbols)):
        t = np.uint64(index[i])
        if single or (i & 1) == 0:
            even, position, j = _decode_one(even, position, end, offsets[t], cumulative, lookup[t], words)
        else:
            odd, position, j = _decode_one(odd, position, end, offsets[t], cumulative, lookup[t], words)
        if j == counts[t]:
            escapes += 1
            symbols[i] = _ESCAPED
        else:
            symbols[i] = lowest[t] + j
    if position != end or even != _INITIAL or odd != _INITIAL:
        return -1
    return escapes


@njit(parallel=True, max_threads=rows_a_thread(1))
def _decode_chunks(words, ends, index, lowest, counts, offsets, cumulative, lookup, symbols, escapes, part):
    for c in chunk_of(len(escapes), part):
        start = c * CHUNK_SYMBOLS
        stop = min(start + CHUNK_SYMBOLS, len(symbols))
        escapes[c] = _decode_chunk(
            words, ends[c], ends[c + 1], index[start:stop], lowest, counts, offsets, cumulative, lookup,
            symbols[start:stop],
        )  # fmt: skip


@njit(no_alias=True)
def _decode_rows_chunk(
    words, begin, end, index, lowest, counts, offsets, cumulative, lookup, first, width, inertia, known, edges, symbols
):  # fmt: skip
    """Decode as `_decode_chunk` does, where tables follow their rows; `index` becomes what was used. `first`: channel
    of the first symbol.
    """
    single = len(symbols) < SINGLE_STATE_SYMBOLS
    position, even, odd = _first_states(words, begin, end, single)
    if position < 0:
        return -1
    escapes = 0
    start = np.int64(inertia) << 12
    seen, expected, shift, channel = start, start, np.int64(0), first
    for i in range(len(symbols)):
        if channel == width:
            seen, expected, shift, channel = start, start, np.int64(0), 0
        given = np.int64(index[i])
        t = np.uint64(shifted(given, shift))  # as an index: one that may be negative is asked about its sign
        index[i] = np.uint8(t)
        if single or (i & 1) == 0:
            even, position, j = _decode_one(even, position, end, offsets[t], cumulative, lookup[t], words)
        else:
            odd, position, j = _decode_one(odd, position, end, offsets[t], cumulative, lookup[t], words)
        symbol = np.int64(lowest[t]) + j
        if j == counts[t]:
            escapes += 1
            symbols[i] = _ESCAPED
            symbol = np.int64(FAR)
        else:
            symbols[i] = np.int32(symbol)
        seen, expected = seen_after(seen, expected, known, given, symbol)
        shift = shift_after(seen, expected, shift, edges)
        channel += 1
    if position != end or even != _INITIAL or odd != _INITIAL:
        return -1
    return escapes


@njit(parallel=True, max_threads=rows_a_thread(1))
def _decode_rows(
    words, ends, index, lowest, counts, offsets, cumulative, lookup, width, inertia, known, edges,
    symbols, escapes, part,
):  # fmt: skip
    for c in chunk_of(len(escapes), part):
        start = c * CHUNK_SYMBOLS
        stop = min(start + CHUNK_SYMBOLS, len(symbols))
        escapes[c] = _decode_rows_chunk(
            words, ends[c], ends[c + 1], index[start:stop], lowest, counts, offsets, cumulative, lookup,
            start % width, width, inertia, known, edges, symbols[start:stop],
        )  # fmt: skip


@njit
def _collect_escapes(symbols, index, lowest, counts, escapes):
    """Varints of 2 (s - highest - 1) for symbols above their table, 2 (lowest - 1 - s) + 1 below it, in
    order.
    """
    data = np.empty(escapes * MAX_ESCAPE_BYTES, np.uint8)
    size = 0
    for i in range(len(symbols)):
        j = np.int64(symbols[i]) - np.int64(lowest[index[i]])
        beyond = j - np.int64(counts[index[i]])
        if j >= 0 and beyond < 0:
            continue
        value = 2 * beyond if j >= 0 else -2 * j - 1
        while value >= 0x80:
            data[size] = np.uint8(value & 0x7F | 0x80)
            size += 1
            value >>= 7
        data[size] = np.uint8(value)
        size += 1
    return data[:size].copy()


@njit
def _insert_escapes(symbols, index, lowest, counts, data, escapes):
    """Replace the placeholders by the escaped values. False if the bytes are not exactly those of `escapes`
    varints.
    """
    position = 0
    if escapes > 0:
        for i in range(len(symbols)):
            if symbols[i] != _ESCAPED:
                continue
            value = np.int64(0)
            shift = 0
            while True:
                if position >= len(data) or shift >= 7 * MAX_ESCAPE_BYTES:
                    return False
                byte = np.int64(data[position])
                position += 1
                value |= (byte & 0x7F) << shift
                if byte < 0x80:
                    if byte == 0 and shift > 0:
                        return False
                    break
                shift += 7
            low = np.int64(lowest[index[i]])
            s = low - 1 - (value >> 1) if value & 1 else low + counts[index[i]] + (value >> 1)
            if s < -(1 << 31) or s >= 1 << 31:
                return False
            symbols[i] = np.int32(s)
    return position == len(data)


@njit
def _code_length(symbols, index, lowest, counts, offsets, costs):
    bits = 0.0
    escapes = 0
    for i in range(len(symbols)):
        t = index[i]
        j = np.int64(symbols[i]) - np.int64(lowest[t])
        if j < 0 or j >= counts[t]:
            j = np.int64(counts[t])
            escapes += 1
        bits += costs[offsets[t] + j]
    return bits, escapes
