"""Network weights: arrays of integers of 6 to 16 bits (docs/bitstream.md, "Arrays of integers").

Weights of a layer are roughly Gaussian, so they go through the Gaussian tables of the latents; what is wider
than the widest table leaves some low bits uncoded. Table and number of low bits are chosen for each array by
counting bits.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compgs.codec.fields import FieldReader, signed_varint, varint
from compgs.codec.format import FIRST_WITH_ROWS, VERSION
from compgs.codec.integer_network import MAX_SHIFT, Follow, IntegerLayer, IntegerNetwork
from compgs.codec.rans import decode_symbols, encode_symbols
from compgs.codec.rows import RowContext, chain_length
from compgs.codec.tables import GAUSSIAN_COUNT, SCALES_PER_OCTAVE, SMALLEST_SCALE_OCTAVE, gaussian_tables
from compgs.errors import CorruptSection, NotEncodable

MAX_LAYERS = 8
# A network's flag, and those of a layer beside its shift.
SKIP = 1
CHAINED = 2  # not before version 5
SHIFTS, RESERVED, ADDS, RECTIFY = 0x1F, 0x20, 0x40, 0x80
MAX_LAYER_WIDTH = 1 << 16
MAX_TENSORS = 256
MAX_NAME_BYTES = 64
MAX_RANK = 4
MAX_EXPONENT = 62  # absolute value
MAX_WEIGHTS = 1 << 22  # in a section
MAX_LOW_BITS = 26


@dataclass(frozen=True)
class QuantizedTensor:
    """A network parameter as the file holds it: value = values * 2^-exponent."""

    values: np.ndarray  # int32, any shape
    exponent: int


def encode_arrays(arrays: Sequence[np.ndarray]) -> bytes:
    """Integer arrays of 32 signed bits; the decoder must know their shapes."""
    settings, highs, index, lows = [], [], [], []
    for array in arrays:
        values = array.ravel().astype(np.int64)
        table, low_bits = _cheapest(values)
        settings.append(bytes([table, low_bits]))
        high, low = _split(values, low_bits)
        highs.append(high.astype(np.int32))
        index.append(np.full(len(values), table, np.uint8))
        lows.append(((low[:, None] >> np.arange(low_bits - 1, -1, -1)) & 1).astype(np.uint8).ravel())
    stream = encode_symbols(np.concatenate(highs), np.concatenate(index), gaussian_tables())
    return b"".join([*settings, varint(len(stream)), stream, np.packbits(np.concatenate(lows)).tobytes()])


def decode_arrays(reader: FieldReader, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:  # int32
    """Inverse of `encode_arrays`; reads the section to its end."""
    sizes = [int(np.prod(shape)) for shape in shapes]
    settings = []
    for i in range(len(shapes)):
        table = reader.varint(f"table of array {i}", 0, GAUSSIAN_COUNT - 1)
        settings.append((table, reader.varint(f"low bits of array {i}", 0, MAX_LOW_BITS)))
    stream = reader.bytes(reader.varint("bytes of weights", 0, reader.remaining), "weights")
    low_count = sum(size * bits for size, (_, bits) in zip(sizes, settings, strict=True))
    packed = np.frombuffer(reader.bytes(-(-low_count // 8), "low bits"), np.uint8)
    reader.end()
    bits = np.unpackbits(packed)
    if bits[low_count:].any():
        raise CorruptSection(f"{reader.section}: the bits after the last low bit are not zero")
    index = np.repeat(np.array([table for table, _ in settings], np.uint8), sizes)
    highs = decode_symbols(stream, index, gaussian_tables(), reader.section)
    arrays = []
    at = bit_at = 0
    for shape, size, (_, low_bits) in zip(shapes, sizes, settings, strict=True):
        low = bits[bit_at : bit_at + size * low_bits].reshape(size, low_bits).astype(np.int64)
        values = _join(
            highs[at : at + size], low @ (1 << np.arange(low_bits - 1, -1, -1, dtype=np.int64)), low_bits
        )
        if size and (values.min() < -(1 << 31) or values.max() >= 1 << 31):
            raise CorruptSection(f"{reader.section}: a weight does not fit into 32 bits")
        arrays.append(values.astype(np.int32).reshape(shape))
        at += size
        bit_at += size * low_bits
    return arrays


def encode_networks(networks: Sequence[IntegerNetwork], version: int = VERSION) -> bytes:
    """The entropy networks' section. Arrays in two halves: means and scales, in the last layer, differ in
    spread.
    """
    fields, arrays = [], []
    for n, network in enumerate(networks):
        layers = network.layers
        if len(layers) > MAX_LAYERS:
            raise NotEncodable(f"network {n}: {len(layers)} layers, the format holds at most {MAX_LAYERS}")
        chain = network.rows.chain
        fields.append(varint(len(layers)) + bytes([SKIP * network.skip | CHAINED * (chain is not None)]))
        for layer in layers:
            if max(layer.weight.shape) > MAX_LAYER_WIDTH:
                raise NotEncodable(f"network {n}: a layer is wider than {MAX_LAYER_WIDTH}")
            flags = layer.shift | ADDS * layer.adds | RECTIFY * layer.rectify
            fields.append(varint(len(layer.bias)) + bytes([flags]))
            arrays += np.array_split(layer.weight, 2) + np.array_split(layer.bias, 2)
        if network.follow is not None:
            fields.append(bytes([network.follow.shift]))
            arrays.append(network.follow.weight)
        if version >= FIRST_WITH_ROWS:
            fields.append(bytes([network.rows.inertia]))
        if chain is not None:
            arrays.append(chain)
    _check_count("entropy networks", arrays)
    return b"".join(fields) + (encode_arrays(arrays) if arrays else b"")


def decode_networks(
    data: bytes,
    section: str,
    sizes: Sequence[tuple[int, int]],
    check_products: Callable[[int], None] = lambda products: None,
    follows: Sequence[bool] | None = None,
    channels: Sequence[int] | None = None,
    version: int = VERSION,
) -> list[IntegerNetwork]:
    """Inverse of `encode_networks`, given (inputs, outputs) of each network, which of their groups see neighbours
    (None: none does), and how many channels these have (None: half of the outputs). `check_products` may refuse the
    number of weights before any is decoded.
    """
    reader = FieldReader(data, section)
    plan: list[list[int]] = []  # of each network: flags of its layers
    follows = [False] * len(sizes) if follows is None else follows
    channels = [outputs // 2 for _, outputs in sizes] if channels is None else channels
    chained: list[bool] = []
    inertias: list[int] = []
    follow_shifts: list[int | None] = []
    skips = []
    shapes: list[tuple[int, ...]] = []
    for n, (inputs, outputs) in enumerate(sizes):
        widths = [inputs]
        count = reader.varint(f"layers of network {n}", 1, MAX_LAYERS)
        flags = reader.bytes(1, f"flags of network {n}")[0]
        skip = flags & SKIP
        chained.append(bool(flags & CHAINED))
        known = SKIP | CHAINED if version >= FIRST_WITH_ROWS else SKIP
        if flags & ~known or (skip and count == 1) or (chained[n] and channels[n] == 1):
            raise CorruptSection(
                f"{section}: flags of network {n} are {flags}: a skip needs several layers, a chain several "
                f"channels, and of others version {version} has none"
            )
        plan.append([])
        for i in range(count):
            out = reader.varint(f"width of layer {i} of network {n}", 1, MAX_LAYER_WIDTH)
            flags = reader.bytes(1, f"flags of layer {i} of network {n}")[0]
            place = f"{section}: layer {i} of network {n}"
            if flags & SHIFTS > MAX_SHIFT or flags & RESERVED:
                raise CorruptSection(
                    f"{place}: flags are {flags:#04x}, expected a shift up to {MAX_SHIFT} and bit 5 zero"
                )
            if flags & ADDS and (i == 0 or i == count - 1 or widths[i - 1] != out):
                raise CorruptSection(f"{place}: its outputs cannot be added to what the layer before takes")
            taken = widths[-1] + (inputs if skip and i == count - 1 else 0)
            plan[-1].append(flags)
            halves = (out - out // 2, out // 2)
            shapes += [(halves[0], taken), (halves[1], taken), (halves[0],), (halves[1],)]
            widths.append(out)
        if widths[-1] != outputs:
            raise CorruptSection(f"{section}: network {n} has {widths[-1]} outputs, expected {outputs}")
        skips.append(bool(skip))
        follow_shifts.append(None)
        if follows[n]:
            follow_shifts[-1] = reader.bytes(1, f"follow shift of network {n}")[0]
            shapes.append((outputs // 2,))
        inertias.append(0)
        if version >= FIRST_WITH_ROWS:
            inertias[-1] = reader.bytes(1, f"inertia of network {n}")[0]
        if chained[n]:
            shapes.append((chain_length(channels[n]),))
    _check_sizes(section, shapes)
    check_products(sum(shape[0] * shape[1] for shape in shapes if len(shape) == 2))
    if not sizes:
        reader.end()
        return []
    arrays = iter(decode_arrays(reader, shapes))
    networks: list[IntegerNetwork] = []
    for flags_of_layers, with_skip, follow_shift in zip(plan, skips, follow_shifts, strict=True):
        layers = []
        for flags in flags_of_layers:
            weight = np.concatenate([next(arrays), next(arrays)])
            bias = np.concatenate([next(arrays), next(arrays)]).astype(np.int64)
            layers.append(
                IntegerLayer(weight, bias, flags & SHIFTS, bool(flags & RECTIFY), bool(flags & ADDS))
            )
        try:
            follow = None if follow_shift is None else Follow(next(arrays), follow_shift)
            chain = next(arrays) if chained[len(networks)] else None
            rows = RowContext(chain, inertias[len(networks)])
            networks.append(IntegerNetwork(tuple(layers), with_skip, follow, rows))
        except ValueError as error:
            raise CorruptSection(f"{section}: {error}") from error
    return networks


def encode_heads(heads: Sequence[tuple[str, QuantizedTensor]]) -> bytes:
    """The prediction networks' section: named tensors, a name spelled from where it differs from the one
    before.
    """
    if len(heads) > MAX_TENSORS:
        raise NotEncodable(f"prediction heads: {len(heads)} tensors, the format holds at most {MAX_TENSORS}")
    fields = [varint(len(heads))]
    previous = b""
    for text, tensor in heads:
        name = text.encode()
        if not 0 < len(name) <= MAX_NAME_BYTES:
            raise NotEncodable(
                f"prediction heads: name {text!r} has {len(name)} bytes, expected 1 to {MAX_NAME_BYTES}"
            )
        if tensor.values.ndim > MAX_RANK or abs(tensor.exponent) > MAX_EXPONENT:
            raise NotEncodable(
                f"prediction heads: {text} has rank {tensor.values.ndim}, exponent {tensor.exponent}"
            )
        if max(tensor.values.shape, default=1) > MAX_LAYER_WIDTH:
            raise NotEncodable(f"prediction heads: {text} has shape {tensor.values.shape}")
        shared = _shared_prefix(previous, name)
        fields.append(varint(shared) + varint(len(name) - shared) + name[shared:])
        fields.append(varint(tensor.values.ndim) + b"".join(varint(n) for n in tensor.values.shape))
        fields.append(signed_varint(tensor.exponent))
        previous = name
    if len({name for name, _ in heads}) < len(heads):
        raise NotEncodable("prediction heads: two tensors have the same name")
    arrays = [tensor.values for _, tensor in heads]
    _check_count("prediction heads", arrays)
    return b"".join(fields) + (encode_arrays(arrays) if arrays else b"")


def decode_heads(
    data: bytes, section: str, check_products: Callable[[int], None] = lambda products: None
) -> tuple[tuple[str, QuantizedTensor], ...]:
    """Inverse of `encode_heads`. `check_products` may refuse the number of weights before any is decoded."""
    reader = FieldReader(data, section)
    names: list[str] = []
    shapes: list[tuple[int, ...]] = []
    exponents = []
    previous = b""
    for i in range(reader.varint("tensors", 0, MAX_TENSORS)):
        shared = reader.varint(f"shared name of tensor {i}", 0, len(previous))
        rest = reader.varint(f"name of tensor {i}", 0, MAX_NAME_BYTES - shared)
        name = previous[:shared] + reader.bytes(rest, f"name of tensor {i}")
        if not name or _shared_prefix(previous, name) != shared:
            raise CorruptSection(f"{section}: the name of tensor {i} is not spelled as an encoder spells it")
        rank = reader.varint(f"rank of tensor {i}", 0, MAX_RANK)
        shapes.append(tuple(reader.varint(f"shape of tensor {i}", 0, MAX_LAYER_WIDTH) for _ in range(rank)))
        exponents.append(reader.signed_varint(f"exponent of tensor {i}", -MAX_EXPONENT, MAX_EXPONENT))
        try:
            names.append(name.decode())
        except UnicodeDecodeError as error:
            raise CorruptSection(f"{section}: the name of tensor {i} is not UTF-8") from error
        previous = name
    if len(set(names)) < len(names):
        raise CorruptSection(f"{section}: two tensors have the same name")
    _check_sizes(section, shapes)
    check_products(sum(math.prod(shape) for shape in shapes))
    if not names:
        reader.end()
        return ()
    arrays = decode_arrays(reader, shapes)
    return tuple(
        (name, QuantizedTensor(array, exponent))
        for name, array, exponent in zip(names, arrays, exponents, strict=True)
    )


def encode_known_heads(tensors: Sequence[QuantizedTensor]) -> bytes:
    """The prediction networks' section of a file without names: tensors in the order that its scene gives."""
    for tensor in tensors:
        if abs(tensor.exponent) > MAX_EXPONENT:
            raise NotEncodable(f"prediction heads: exponent {tensor.exponent}")
    arrays = [tensor.values for tensor in tensors]
    _check_count("prediction heads", arrays)
    return b"".join(signed_varint(tensor.exponent) for tensor in tensors) + encode_arrays(arrays)


def decode_known_heads(
    data: bytes,
    section: str,
    shapes: Mapping[str, tuple[int, ...]],
    check_products: Callable[[int], None] = lambda products: None,
) -> tuple[tuple[str, QuantizedTensor], ...]:
    """Inverse of `encode_known_heads`, given names and shapes."""
    _check_sizes(section, list(shapes.values()))
    check_products(sum(math.prod(shape) for shape in shapes.values()))
    reader = FieldReader(data, section)
    exponents = [reader.signed_varint(f"exponent of {name}", -MAX_EXPONENT, MAX_EXPONENT) for name in shapes]
    arrays = decode_arrays(reader, list(shapes.values()))
    tensors = map(QuantizedTensor, arrays, exponents)
    return tuple(zip(shapes, tensors, strict=True))


def _split(values: np.ndarray, low_bits: int) -> tuple[np.ndarray, np.ndarray]:
    """High and low part; the low part is centred, so that the high part has the values' own symmetry."""
    shifted = values + (1 << low_bits >> 1)
    return shifted >> low_bits, shifted & ((1 << low_bits) - 1)


def _join(high: np.ndarray, low: np.ndarray, low_bits: int) -> np.ndarray:
    return (high.astype(np.int64) << low_bits) + low - (1 << low_bits >> 1)


def _cheapest(values: np.ndarray) -> tuple[int, int]:
    """(Gaussian table, low bits) with the fewest bits, among those near the values' own spread."""
    if len(values) == 0:
        return 0, 0
    tables = gaussian_tables()
    # In 2^-16 bits: whole numbers, so that ties fall the same way on every machine.
    costs = np.rint(tables.costs() * 65536).astype(np.int64)
    best = (-1, 0, 0)
    spread = np.log2(max(float(np.sqrt(np.mean(values.astype(np.float64) ** 2))), 2.0**-12))
    first = min(max(0, int(np.floor(spread)) - 5), MAX_LOW_BITS - 2)
    for low_bits in sorted({0, first, first + 1, first + 2}):
        high, counts = np.unique(_split(values, low_bits)[0], return_counts=True)
        near = round(SCALES_PER_OCTAVE * (spread - low_bits - SMALLEST_SCALE_OCTAVE))
        near = min(max(near, 0), GAUSSIAN_COUNT - 1)
        nearby = np.arange(max(0, near - 24), min(GAUSSIAN_COUNT, near + 13))
        # A row for each table: a loop over them in Python would take longer than all else in writing a small file.
        symbols = tables.counts[nearby].astype(np.int64)[:, None]
        j = high - tables.lowest[nearby].astype(np.int64)[:, None]
        beyond = np.where(j < 0, -2 * j - 1, 2 * (j - symbols))
        escaped = (j < 0) | (j >= symbols)
        cost = costs[tables.offsets[nearby].astype(np.int64)[:, None] + np.where(escaped, symbols, j)]
        varint_bytes = 1 + sum((beyond >= (1 << 7 * n)).astype(np.int64) for n in range(1, 5))
        cost += np.where(escaped, varint_bytes * 8 * 65536, 0)
        totals = (cost * counts).sum(1) + low_bits * len(values) * 65536
        least = int(np.argmin(totals))  # the first of equal ones
        if best[0] < 0 or totals[least] < best[0]:
            best = (int(totals[least]), int(nearby[least]), low_bits)
    return best[1], best[2]


def _shared_prefix(a: bytes, b: bytes) -> int:
    n = 0
    while n < min(len(a), len(b)) and a[n] == b[n]:
        n += 1
    return n


def _check_count(section: str, arrays: Sequence[np.ndarray]) -> None:
    count = sum(array.size for array in arrays)
    if count > MAX_WEIGHTS:
        raise NotEncodable(f"{section}: {count} weights, the format holds at most {MAX_WEIGHTS}")


def _check_sizes(section: str, shapes: Sequence[tuple[int, ...]]) -> None:
    count = 0
    for shape in shapes:
        size = 1
        for n in shape:
            size *= n
        count += size
    if count > MAX_WEIGHTS:
        raise CorruptSection(f"{section}: {count} weights, the format holds at most {MAX_WEIGHTS}")
