"""A decoder in plain Python, written from docs/bitstream.md alone: slow, and independent of the package.

    python tools/plain_decoder.py FILE [--prefix]        prints everything that the file holds as JSON

It shows that the document is complete, and the tests hold the real decoder against it. Names are the document's.
"""

import json
import math
import struct
import sys
import zlib
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

GAUSSIAN_TABLES = Path(__file__).parent.parent / "src" / "compgs" / "codec" / "gaussian_tables.bin"

MAGIC = b"\x93CGS"
VERSION = 5
OLDEST_VERSION = 2
FIRST_WITH_NEIGHBOURS, FIRST_WITH_DILATION, FIRST_WITH_ROWS = 3, 4, 5
OPTIONAL = 0x80
MAX_SECTIONS = 64
MAX_ANCHORS = 2**24
MAX_COUPLED_PRIMITIVES = 64
MAX_REFERENCE_DIM = 256
MAX_RESIDUAL_DIM = 64
MAX_SIDE_DIM = 64
MAX_GROUPS = 16
MAX_RANGES = 22
MAX_TABLES = 256
MAX_WIDTH = 1024
MAX_SYMBOL = 2**18
FREE_SYMBOLS, SYMBOLS_PER_BYTE = 2**20, 128
FREE_NETWORK_PRODUCTS, NETWORK_PRODUCTS_PER_BYTE = 2**28, 2**15
FREE_HEAD_PRODUCTS, HEAD_PRODUCTS_PER_BYTE = 2**30, 2**17
FREE_FLAGS, FLAGS_PER_BYTE = 2**20, 16
FREE_NODES, NODES_PER_BYTE = 2**18, 4
MAX_METADATA_BYTES = 4096
SMALLEST, LARGEST = 2.0**-64, 2.0**64
SMALLEST_DILATION, LARGEST_DILATION = 2.0**-40, 1.0
MAX_HYPER_SYMBOLS = 1024
MAX_LOWEST = 2**18
MANTISSAS = (1024, 1116, 1217, 1327, 1448, 1579, 1722, 1878)
CHUNK_SYMBOLS = 2**20
SINGLE_STATE_SYMBOLS = 2**18
MAX_ESCAPE_BYTES = 5
ACTIVATION_LIMIT = 2**23
MAX_SHIFT = 30
BIAS_LIMIT = 2**31
ACCUMULATOR_LIMIT = 2**52
MAX_LAYERS = 8
MAX_LAYER_WIDTH = 2**16
MAX_TENSORS = 256
MAX_NAME_BYTES = 64
MAX_RANK = 4
MAX_EXPONENT = 62
MAX_WEIGHTS = 2**22
MAX_LOW_BITS = 26
FOLLOW_LIMIT = 2**28
NEAREST_WEIGHT = 2**24
CHAIN_BITS = 6
CHAIN_LIMIT = 2**12
MAX_INERTIA = 63
SIZE_OFFSET, SIZE_CAP = 1229, 4
LARGEST_TABLE_SHIFT = 36

SCENE, POSITIONS, GPCC, MASKS, TABLES, NETWORKS, HEADS, LATENTS = range(1, 9)
METADATA, PADDING, VIEWPOINTS = 129, 130, 131
NAMES = {
    SCENE: "scene",
    POSITIONS: "positions",
    GPCC: "positions (G-PCC)",
    MASKS: "masks",
    TABLES: "tables",
    NETWORKS: "entropy networks",
    HEADS: "prediction heads",
    LATENTS: "latents",
    METADATA: "metadata",
    PADDING: "padding",
    VIEWPOINTS: "viewpoints",
}
SIDE, REFERENCE, LOG_SCALES, RESIDUAL = range(4)
MOST_CHANNELS = {SIDE: MAX_SIDE_DIM, REFERENCE: MAX_REFERENCE_DIM, LOG_SCALES: 6, RESIDUAL: MAX_RESIDUAL_DIM}


# ---- Errors, named after those of the document


class Refused(Exception):
    """What all of these are."""


class NotACompGSFile(Refused):
    """The first bytes are not those of a .cgs file."""


class UnsupportedVersion(Refused):
    """Another version, or a section that this one does not have."""


class TruncatedSection(Refused):
    """The file ends too early."""


class CorruptSection(Refused):
    """Something is not legal."""


class MissingDependency(Refused):
    """The file needs G-PCC: no fault of the file."""


def require(legal: bool, name: str, found: str) -> None:
    if not legal:
        raise CorruptSection(f"{name}: {found}")


# ---- Fields


class Fields:
    def __init__(self, data: bytes, name: str) -> None:
        self.data = data
        self.name = name
        self.at = 0

    def require(self, legal: bool, found: str) -> None:
        require(legal, self.name, found)

    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, count: int) -> bytes:
        self.require(count <= self.left(), f"needs {count} bytes, {self.left()} are left")
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, layout: str) -> tuple:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def number(self, layout: str, lowest: float, highest: float, what: str) -> Any:
        (value,) = self.unpack(layout)
        self.require(lowest <= value <= highest, f"{what} is {value}, expected {lowest} to {highest}")
        return value

    def varint(self, lowest: int = 0, highest: int = 2**63 - 1, what: str = "number", most: int = 9) -> int:
        value = 0
        for place in range(most):
            byte = self.take(1)[0]
            value |= (byte & 127) << 7 * place
            if byte < 128:
                self.require(byte > 0 or place == 0, f"{what} has a spelling that is too long")
                self.require(lowest <= value <= highest, f"{what} is {value}, expected {lowest} to {highest}")
                return value
        raise CorruptSection(f"{self.name}: {what} has more than {most} bytes")

    def signed(
        self, lowest: int = -(2**62), highest: int = 2**62, what: str = "number", most: int = 9
    ) -> int:
        v = self.varint(what=what, most=most)
        value = -(v + 1) // 2 if v % 2 else v // 2
        self.require(lowest <= value <= highest, f"{what} is {value}, expected {lowest} to {highest}")
        return value

    def end(self) -> None:
        self.require(self.left() == 0, f"{self.left()} bytes are left over")


# ---- Scene


@dataclass(frozen=True)
class Group:
    index: int  # among the groups
    role: int
    channels: int
    context: int
    steps: list[float]

    def slots(self, k: int) -> int:
        return k if self.role == RESIDUAL else 1

    def width(self, k: int) -> int:
        return self.slots(k) * self.channels

    def contexts(self) -> list[int]:
        """The groups whose latents its network takes."""
        return [j for j in range(self.index) if self.context >> (j + 1) & 1]

    def takes_neighbours(self) -> bool:
        return self.context >> (self.index + 1) & 1 == 1


@dataclass(frozen=True)
class Scene:
    anchors: int
    coupled: int
    coupled_primitives: int
    residual_dim: int
    heads: int
    width: int
    voxel_size: float
    world_offset: tuple[float, float, float]
    view_distance_scale: float
    background: tuple[float, float, float]
    angular_dilation: float | None
    groups: tuple[Group, ...]

    def network_size(self, group: Group) -> tuple[int, int]:
        """Inputs and outputs."""
        inputs = 3 * (group.context & 1) + sum(self.groups[j].channels for j in group.contexts())
        inputs += 2 * group.takes_neighbours()
        return inputs, 2 * group.width(self.coupled_primitives)

    def predictions(self) -> list[tuple[str, int, int, int]]:
        """Of each network of the prediction: name, inputs, outputs and blocks."""
        d = sum(group.channels for group in self.groups if group.role == REFERENCE)
        seen = d + self.residual_dim  # f, g
        viewed = d + 4 + self.residual_dim  # f, v, g
        separate = [
            ("translation", seen, 3, 1),
            ("covariance", seen, 7, 1),
            ("opacity", viewed, 1, 1),
            ("color", viewed, 3, 2),
        ]
        paired = [("geometry", seen, 10, 1), ("appearance", viewed, 4, 1)]
        shallow = [("geometry", seen, 10, 0), ("appearance", viewed, 4, 0)]
        return (separate, paired, shallow)[self.heads]


def read_scene(data: bytes, version: int) -> Scene:
    fields = Fields(data, NAMES[SCENE])
    anchors = fields.number("I", 1, MAX_ANCHORS, "anchors")
    (coupled,) = fields.unpack("I")
    k = fields.number("B", 1, MAX_COUPLED_PRIMITIVES, "coupled_primitives")
    fields.require(coupled <= anchors * k, f"{coupled} coupled primitives in {anchors * k} slots")
    residual_dim = fields.number("B", 1, MAX_RESIDUAL_DIM, "residual_dim")
    heads = fields.number("B", 0, 2, "heads")
    width = fields.number("H", 1, MAX_WIDTH, "width")
    voxel_size = fields.number("d", SMALLEST, LARGEST, "voxel_size")
    world_offset = tuple(fields.number("d", -LARGEST, LARGEST, "world_offset") for _ in range(3))
    view_distance_scale = fields.number("d", SMALLEST, LARGEST, "view_distance_scale")
    background = tuple(fields.number("f", -LARGEST, LARGEST, "background") for _ in range(3))
    dilation = None
    if version >= FIRST_WITH_DILATION:
        dilation = fields.number("f", SMALLEST_DILATION, LARGEST_DILATION, "angular_dilation")
    groups: list[Group] = []
    for _ in range(fields.number("B", 1, MAX_GROUPS, "groups")):
        groups.append(read_group(fields, version, groups, k))
    fields.end()
    channels = [sum(group.channels for group in groups if group.role == role) for role in range(4)]
    fields.require(1 <= channels[REFERENCE] <= MAX_REFERENCE_DIM, f"reference_dim is {channels[REFERENCE]}")
    fields.require(channels[LOG_SCALES] == 6, f"{channels[LOG_SCALES]} log scales, expected 6")
    fields.require(channels[RESIDUAL] in (0, residual_dim), f"{channels[RESIDUAL]} channels of residuals")
    numbers = (anchors, coupled, k, residual_dim, heads, width, voxel_size)
    return Scene(*numbers, world_offset, view_distance_scale, background, dilation, tuple(groups))


def read_group(fields: Fields, version: int, before: list[Group], k: int) -> Group:
    role = fields.varint(0, 3, "role")
    channels = fields.varint(1, MOST_CHANNELS[role], "channels")
    bits = len(before) + (2 if version >= FIRST_WITH_NEIGHBOURS else 1)
    context = fields.varint(0, 2**bits - 1, "context")
    count = fields.varint(0, channels, "steps")
    fields.require(count in ((0,) if role == SIDE else (1, channels)), f"{count} steps")
    steps = [fields.number("f", SMALLEST, LARGEST, "step") for _ in range(count)]
    group = Group(len(before), role, channels, context, steps)
    fields.require(all(before[j].role != RESIDUAL for j in group.contexts()), "residuals as context")
    fields.require(role != RESIDUAL or not group.takes_neighbours(), "neighbours of residuals")
    fields.require(context > 0 or group.width(k) <= MAX_TABLES, f"a group of {group.width(k)} tables")
    return group


# ---- Tables


class Table:
    def __init__(self, lowest: int, frequencies: list[int]) -> None:
        assert sum(frequencies) == 65536 and min(frequencies) >= 1
        self.lowest = lowest
        self.escape = len(frequencies) - 1
        self.starts = [0, *accumulate(frequencies[:-1])]
        self.frequencies = frequencies

    def entry(self, slot: int) -> int:
        return bisect_right(self.starts, slot) - 1

    @cached_property
    def expected_size(self) -> int:
        """E, of a Gaussian table: the expected absolute value of a symbol, Q12."""
        return sum(q * self.frequencies[q - self.lowest] for q in range(1, -self.lowest + 1)) // 8


def gaussian_tables() -> list[Table]:
    data = GAUSSIAN_TABLES.read_bytes()
    assert zlib.crc32(data) == 0xAD3B4090
    numbers = list(struct.unpack(f"<{len(data) // 2}H", data))
    tables = []
    while numbers:
        r = numbers[0]
        half, escape = numbers[1 : r + 2], numbers[r + 2]
        tables.append(Table(-r, [*half[:0:-1], *half, escape]))
        numbers = numbers[r + 3 :]
    return tables


def read_tables(data: bytes, scene: Scene, gaussian: list[Table]) -> dict[int, list[Table]]:
    """By group: the tables of an anchor's symbols."""
    fields = Fields(data, NAMES[TABLES])
    widths = {i: g.width(scene.coupled_primitives) for i, g in enumerate(scene.groups) if g.context == 0}
    heads = [
        (
            fields.varint(2, MAX_HYPER_SYMBOLS + 1, "entries"),
            fields.signed(-MAX_LOWEST, MAX_LOWEST, "lowest"),
        )
        for _ in range(sum(widths.values()))
    ]
    if not heads:
        fields.end()
        return {}
    (differences,) = integer_arrays(fields, [sum(entries for entries, _ in heads)], gaussian)
    d = iter(differences)
    tables = iter([table_of(fields, lowest, [next(d) for _ in range(m)]) for m, lowest in heads])
    return {i: [next(tables) for _ in range(width)] for i, width in widths.items()}


def table_of(fields: Fields, lowest: int, d: list[int]) -> Table:
    levels = [*accumulate(d[:-1]), d[-1]]
    fields.require(min(levels) >= 0 and max(levels) <= 127, "a level is not in 0 ... 127")
    w = [MANTISSAS[level % 8] << (level >> 3) for level in levels]
    f = [1 + x * (65536 - len(w)) // sum(w) for x in w]
    f[levels.index(max(levels))] += 65536 - sum(f)
    return Table(lowest, f)


# ---- Streams


class Known:
    """The tables of a stream's symbols, all known beforehand."""

    def __init__(self, tables: list[Table]) -> None:
        self.tables = tables

    def __len__(self) -> int:
        return len(self.tables)

    def begin_chunk(self) -> None:
        pass

    def table(self, i: int) -> Table:
        """Of symbol i of the stream; they are asked for in order."""
        return self.tables[i]

    def decoded(self, i: int, table: Table, entry: int) -> None:
        pass


class Inert(Known):
    """Gaussian tables that move with the sizes of the symbols before them in their row (inertia)."""

    # M(d), d = -LARGEST_TABLE_SHIFT ... LARGEST_TABLE_SHIFT
    BOUNDS = tuple(
        math.floor(2 ** (15 + (2 * d - 1) / 24)) for d in range(-LARGEST_TABLE_SHIFT, LARGEST_TABLE_SHIFT + 1)
    )

    def __init__(self, places: list[int], gaussian: list[Table], channels: int, inertia: int) -> None:
        """places: of the tables that the network gives, among the Gaussian ones; channels: symbols of a row."""
        super().__init__([gaussian[t] for t in places])
        self.places, self.gaussian, self.channels, self.inertia = places, gaussian, channels, inertia

    def begin_chunk(self) -> None:
        self.seen = self.expected = 4096 * self.inertia
        self.shift = 0

    def table(self, i: int) -> Table:
        if i % self.channels == 0:
            self.begin_chunk()  # a row begins as a chunk does
        return self.gaussian[clamp(self.places[i] + self.shift, 0, len(self.gaussian) - 1)]

    def decoded(self, i: int, table: Table, entry: int) -> None:
        e = self.tables[i].expected_size
        most = SIZE_CAP * e
        size = most if entry == table.escape else min(4096 * abs(table.lowest + entry), most)
        self.seen += 4096 * size // (e + SIZE_OFFSET)
        self.expected += 4096 * e // (e + SIZE_OFFSET)
        # 32768 seen >= expected M(d)
        at = bisect_right(self.BOUNDS, 32768 * self.seen // self.expected) - 1
        self.shift = max(at, 0) - LARGEST_TABLE_SHIFT


def read_stream(fields: Fields, tables: Known) -> list[int]:
    """One symbol for each of the tables."""
    count = len(tables)
    if not count:
        return []
    chunks = [range(i, min(i + CHUNK_SYMBOLS, count)) for i in range(0, count, CHUNK_SYMBOLS)]
    words = [fields.varint(2, len(chunk) // 2 + 5, "words") for chunk in chunks]
    escape_bytes = fields.varint(0, MAX_ESCAPE_BYTES * count, "escape_bytes")
    entries: list[tuple[Table, int]] = []
    for chunk, size in zip(chunks, words, strict=True):
        entries += chunk_entries(fields, chunk, tables, iter(fields.unpack(f"{size}I")))
    escapes = Fields(fields.take(escape_bytes), fields.name)
    symbols = [escaped(escapes, table) if j == table.escape else table.lowest + j for table, j in entries]
    escapes.end()
    return symbols


def chunk_entries(
    fields: Fields, chunk: range, tables: Known, words: Iterator[int]
) -> list[tuple[Table, int]]:
    """Of each symbol, its table and its entry there."""

    def word() -> int:
        value = next(words, None)
        fields.require(value is not None, "a chunk has too few words")
        return value or 0

    states = []
    for _ in range(1 if len(chunk) < SINGLE_STATE_SYMBOLS else 2):
        low = word()
        states.append(low + 2**32 * word())
    fields.require(all(2**31 <= state < 2**63 for state in states), "a state is out of range")
    entries = []
    tables.begin_chunk()
    for i in chunk:
        k = (i - chunk.start) % len(states)
        slot = states[k] % 65536
        table = tables.table(i)
        j = table.entry(slot)
        states[k] = table.frequencies[j] * (states[k] // 65536) + slot - table.starts[j]
        if states[k] < 2**31:
            states[k] = 2**32 * states[k] + word()
        tables.decoded(i, table, j)
        entries.append((table, j))
    fields.require(next(words, None) is None, "a chunk has too many words")
    fields.require(all(state == 2**31 for state in states), "a state does not end where it began")
    return entries


def escaped(escapes: Fields, table: Table) -> int:
    v = escapes.varint(most=MAX_ESCAPE_BYTES)
    symbol = table.lowest - 1 - (v - 1) // 2 if v % 2 else table.lowest + table.escape + v // 2
    escapes.require(-(2**31) <= symbol < 2**31, f"symbol {symbol} has more than 32 bits")
    return symbol


# ---- Arrays of integers, networks, heads


def integer_arrays(fields: Fields, sizes: list[int], gaussian: list[Table]) -> list[list[int]]:
    settings = [
        (fields.number("B", 0, len(gaussian) - 1, "table"), fields.number("B", 0, MAX_LOW_BITS, "low_bits"))
        for _ in sizes
    ]
    stream_bytes = fields.varint(0, what="stream_bytes")
    stream = Fields(fields.take(stream_bytes), fields.name)
    of_element = [setting for size, setting in zip(sizes, settings, strict=True) for _ in range(size)]
    highs = read_stream(stream, Known([gaussian[table] for table, _ in of_element]))
    stream.end()
    needed = sum(low_bits for _, low_bits in of_element)
    fields.require(fields.left() == -(-needed // 8), f"{fields.left()} bytes for {needed} low bits")
    bits = "".join(f"{byte:08b}" for byte in fields.take(fields.left()))
    fields.require("1" not in bits[needed:], "bits behind the last low part")
    values = []
    at = 0
    for high, (_, low_bits) in zip(highs, of_element, strict=True):
        low = int(bits[at : at + low_bits] or "0", 2)
        at += low_bits
        values.append(high * 2**low_bits + low - 2**low_bits // 2)
    fields.require(all(-(2**31) <= v < 2**31 for v in values), "an element has more than 32 bits")
    rest = iter(values)
    return [[next(rest) for _ in range(size)] for size in sizes]


@dataclass(frozen=True)
class Layer:
    inputs: int
    outputs: int
    shift: int
    adds: bool
    rectify: bool


@dataclass(frozen=True)
class NetworkHead:
    """What the file says of a network before its numbers."""

    layers: list[Layer]
    skip: bool
    has_chain: bool
    follow_shift: int
    inertia: int


@dataclass(frozen=True)
class Network:
    head: NetworkHead
    weights: list[list[list[int]]]  # of each layer [outputs][inputs]
    biases: list[list[int]]
    follow: list[int]  # of each channel; empty unless the group takes neighbours
    chain: list[list[int]]  # of each channel, for those before it; empty unless there is one


def read_networks(
    data: bytes, version: int, scene: Scene, anchors: int, n: int, gaussian: list[Table]
) -> dict[int, Network]:
    """By group. n: the length of the file, which pays for the products with the anchors."""
    fields = Fields(data, NAMES[NETWORKS])
    heads = {i: read_network_head(fields, version, scene, g) for i, g in enumerate(scene.groups) if g.context}
    if not heads:
        fields.end()
        return {}
    layers = [layer for head in heads.values() for layer in head.layers]
    products = anchors * sum(layer.inputs * layer.outputs for layer in layers)
    allowed = FREE_NETWORK_PRODUCTS + NETWORK_PRODUCTS_PER_BYTE * n
    fields.require(products <= allowed, f"{products} products, expected up to {allowed}")
    sizes = []
    for i, head in heads.items():
        for layer in head.layers:
            upper = (layer.outputs + 1) // 2
            lower = layer.outputs - upper
            sizes += [upper * layer.inputs, lower * layer.inputs, upper, lower]
        channels = scene.groups[i].channels
        if scene.groups[i].takes_neighbours():
            sizes.append(channels)
        if head.has_chain:
            sizes.append(channels * (channels - 1) // 2)
    fields.require(sum(sizes) <= MAX_WEIGHTS, f"{sum(sizes)} elements, expected up to {MAX_WEIGHTS}")
    arrays = iter(integer_arrays(fields, sizes, gaussian))
    networks = {}
    for i, head in heads.items():
        parameters = [read_parameters(fields, layer, arrays) for layer in head.layers]
        weights, biases = map(list, zip(*parameters, strict=True))
        follow = next(arrays) if scene.groups[i].takes_neighbours() else []
        fields.require(all(abs(v) < FOLLOW_LIMIT for v in follow), "an element of follow")
        chain = next(arrays) if head.has_chain else []
        fields.require(all(abs(v) < CHAIN_LIMIT for v in chain), "an element of chain")
        # Row c of a triangle has c numbers.
        triangle = [chain[c * (c - 1) // 2 :][:c] for c in range(scene.groups[i].channels)]
        networks[i] = Network(head, weights, biases, follow, triangle if head.has_chain else [])
    return networks


def read_network_head(fields: Fields, version: int, scene: Scene, group: Group) -> NetworkHead:
    inputs, outputs = scene.network_size(group)
    count = fields.varint(1, MAX_LAYERS, "layers")
    (flags,) = fields.unpack("B")
    legal = int(count > 1) + 2 * int(version >= FIRST_WITH_ROWS and group.channels > 1)
    fields.require(flags & ~legal == 0, f"flags of a network are {flags}, expected no bits but {legal}")
    skip, has_chain = bool(flags & 1), bool(flags & 2)
    layers: list[Layer] = []
    for i in range(count):
        width = fields.varint(1, MAX_LAYER_WIDTH, "width")
        flags = fields.number("B", 0, 255, "flags")
        last = i == count - 1
        taken = inputs if i == 0 else layers[-1].outputs + inputs * (last and skip)
        layer = Layer(taken, width, flags & 31, bool(flags & 64), bool(flags & 128))
        fields.require(not flags & 32 and layer.shift <= MAX_SHIFT, f"flags of a layer are {flags}")
        if layer.adds:
            fields.require(i > 0 and not last, "the first or last layer adds")
            fields.require(width == layers[-1].inputs, f"{width} outputs are added to {layers[-1].inputs}")
        fields.require(not last or width == outputs, f"the last layer has {width} outputs, not {outputs}")
        layers.append(layer)
    follow_shift = fields.number("B", 0, MAX_SHIFT, "follow_shift") if group.takes_neighbours() else 0
    inertia = fields.number("B", 0, MAX_INERTIA, "inertia") if version >= FIRST_WITH_ROWS else 0
    return NetworkHead(layers, skip, has_chain, follow_shift, inertia)


def read_parameters(
    fields: Fields, layer: Layer, arrays: Iterator[list[int]]
) -> tuple[list[list[int]], list[int]]:
    weights = next(arrays) + next(arrays)
    biases = next(arrays) + next(arrays)
    largest = max(map(abs, weights))
    fields.require(layer.inputs * largest * ACTIVATION_LIMIT < ACCUMULATOR_LIMIT, f"a weight of {largest}")
    fields.require(all(abs(b) < BIAS_LIMIT for b in biases), "a bias of 2^31")
    return rows(weights, layer.inputs), biases


def clamp(v: int, lowest: int, highest: int) -> int:
    return min(max(v, lowest), highest)


def activation(v: int) -> int:
    return clamp(v, -ACTIVATION_LIMIT, ACTIVATION_LIMIT - 1)


def evaluate(network: Network, inputs: list[int]) -> list[int]:
    x = inputs = [activation(v) for v in inputs]
    before: list[int] = []  # what the layer before took
    for i, layer in enumerate(network.head.layers):
        if network.head.skip and i == len(network.head.layers) - 1:
            x = x + inputs
        out = []
        for o, (row, bias) in enumerate(zip(network.weights[i], network.biases[i], strict=True)):
            y = sum(w * v for w, v in zip(row, x, strict=True))
            if layer.shift > 0:
                y = (y + 2 ** (layer.shift - 1)) >> layer.shift
            y += bias
            if layer.rectify:
                y = max(y, y >> 6)
            y = activation(y)
            out.append(activation(y + before[o]) if layer.adds else y)
        before, x = x, out
    return x


Tensors = dict[str, dict[str, Any]]  # by name: shape, exponent, values


def read_heads(
    data: bytes, version: int, scene: Scene, coupled: int, n: int, gaussian: list[Table]
) -> Tensors:
    """coupled: primitives that the heads are for; n: the length of the file, which pays for the products."""
    fields = Fields(data, NAMES[HEADS])
    tensors = tensors_of_scene(fields, scene) if version >= FIRST_WITH_ROWS else named_tensors(fields)
    if not tensors:
        fields.end()
        return {}
    sizes = [math.prod(tensor["shape"]) for tensor in tensors.values()]
    fields.require(sum(sizes) <= MAX_WEIGHTS, f"{sum(sizes)} elements, expected up to {MAX_WEIGHTS}")
    allowed = FREE_HEAD_PRODUCTS + HEAD_PRODUCTS_PER_BYTE * n
    fields.require(
        coupled * sum(sizes) <= allowed, f"{coupled * sum(sizes)} products, expected up to {allowed}"
    )
    for tensor, values in zip(tensors.values(), integer_arrays(fields, sizes, gaussian), strict=True):
        tensor["values"] = values
    return tensors


def tensors_of_scene(fields: Fields, scene: Scene) -> Tensors:
    """The scene says which there are; the file has their exponents."""
    shapes: dict[str, list[int]] = {}
    for network, inputs, outputs, blocks in scene.predictions():
        own = {
            "input_weight": [inputs, scene.width],
            "input_bias": [scene.width],
            "output_weight": [scene.width, outputs],
            "output_bias": [outputs],
            "skip_weight": [inputs, outputs],
        }
        for b in range(blocks):
            for i in (1, 2):
                own[f"blocks.{b}.weight{i}"] = [scene.width, scene.width]
                own[f"blocks.{b}.bias{i}"] = [scene.width]
        shapes |= {f"{network}.{name}": shape for name, shape in own.items()}
    if all(group.role != RESIDUAL for group in scene.groups):
        shapes["residuals"] = [scene.coupled_primitives, scene.residual_dim]
    return {name: {"shape": shape, "exponent": read_exponent(fields)} for name, shape in shapes.items()}


def named_tensors(fields: Fields) -> Tensors:
    """Of versions 2 to 4."""
    tensors: Tensors = {}
    name = b""
    for _ in range(fields.varint(0, MAX_TENSORS, "tensors")):
        name = read_name(fields, name)
        sides = [fields.varint(0, MAX_LAYER_WIDTH, "side") for _ in range(fields.varint(0, MAX_RANK, "rank"))]
        exponent = read_exponent(fields)
        fields.require(name.decode() not in tensors, f"{name.decode()} twice")
        tensors[name.decode()] = {"shape": sides, "exponent": exponent}
    return tensors


def read_exponent(fields: Fields) -> int:
    return fields.signed(-MAX_EXPONENT, MAX_EXPONENT, "exponent")


def read_name(fields: Fields, before: bytes) -> bytes:
    shared = fields.varint(0, len(before), "shared")
    rest = fields.take(fields.varint(0, MAX_NAME_BYTES, "rest"))
    name = before[:shared] + rest
    fields.require(1 <= len(name) <= MAX_NAME_BYTES, f"a name of {len(name)} bytes")
    fields.require(
        before[shared : shared + 1] != rest[:1] or not rest, f"a name shares more than {shared} bytes"
    )
    text(fields, name)
    return name


def text(fields: Fields, data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise CorruptSection(f"{fields.name}: {data!r} is not UTF-8") from None


# ---- Arithmetic code


def _squash() -> list[int]:
    e = [2**64]
    for _ in range(2048):
        e.append(18374827034086858296 * e[-1] >> 64)
    below = [(65536 * v + (2**64 + v) // 2) // (2**64 + v) for v in e]
    return [below[-x] if x <= 0 else 65536 - below[x] for x in range(-2048, 2048)]


SQUASH = _squash()


def _stretch() -> list[int]:
    out = []
    below = 0
    for i in range(4096):
        while below < 4096 and SQUASH[below] < 16 * i + 8:
            below += 1
        out.append(clamp(below - 2048, -2047, 2047))
    return out


STRETCH = _stretch()


class State:
    def __init__(self) -> None:
        self.p = 2**21
        self.n = 0

    def learn(self, bit: int, limit: int) -> None:
        self.p += ((2**22 * bit - self.p) * (655360 // (10 * self.n + 16))) >> 16
        if self.n < limit:
            self.n += 1


class ArithmeticDecoder:
    def __init__(self, data: bytes, name: str) -> None:
        self.data = data
        self.name = name
        self.low, self.high = 0, 2**48 - 1
        self.code = int.from_bytes(data[:6].ljust(6, b"\0"), "big")
        self.rounds = 0

    def decide(self, p1: int) -> int:
        split = self.low + ((self.high - self.low) >> 16) * p1
        bit = int(self.code <= split)
        if bit:
            self.high = split
        else:
            self.low = split + 1
        while self.low >> 40 == self.high >> 40:
            at = 6 + self.rounds
            self.rounds += 1
            following = self.data[at] if at < len(self.data) else 0
            self.low = (self.low << 8) % 2**48
            self.high = (self.high << 8) % 2**48 + 255
            self.code = (self.code << 8) % 2**48 + following
        return bit

    def decide_by(self, state: State, limit: int) -> int:
        bit = self.decide(clamp(state.p >> 6, 20, 65516))
        state.learn(bit, limit)
        return bit

    def end(self) -> int:
        """Bytes that the code took."""
        require(self.code == ((self.low >> 40) + 1) << 40, self.name, "the code does not end as it should")
        require(self.rounds + 1 <= len(self.data), self.name, "the code ends early")
        return self.rounds + 1


class Mixer:
    def __init__(self, inputs: int, initial_weight: int, limit: int, rate: int) -> None:
        self.inputs, self.initial, self.limit, self.rate = inputs, initial_weight, limit, rate
        self.states: dict[tuple[int, int], State] = {}
        self.weights: dict[int, list[int]] = {}
        self.refinements: dict[int, list[int]] = {}

    def decide(self, coder: ArithmeticDecoder, contexts: list[int], a: int, b: int, refinement: int) -> int:
        assert len(contexts) == self.inputs and a != b
        states = [self.states.setdefault((k, c), State()) for k, c in enumerate(contexts)]
        sets = [self.weights.setdefault(s, [self.initial] * self.inputs + [0]) for s in (a, b)]
        r = self.refinements.setdefault(refinement, [SQUASH[min(128 * i, 4095)] for i in range(33)])
        stretched = [(STRETCH[s.p >> 10] * (256 * s.n // (s.n + 3))) >> 8 for s in states] + [256]
        logits = [
            clamp(sum(w * v for w, v in zip(ws, stretched, strict=True)) >> 16, -2047, 2047) for ws in sets
        ]
        logit = (logits[0] + logits[1]) >> 1
        place = 32 * (logit + 2048)
        i, s = place >> 12, place % 4096
        refined = (r[i] * (4096 - s) + r[i + 1] * s) >> 12
        bit = coder.decide(clamp((SQUASH[logit + 2048] + refined) >> 1, 20, 65516))
        for weights, own in zip(sets, logits, strict=True):
            e = (65535 * bit - SQUASH[own + 2048]) * self.rate
            for k in range(self.inputs + 1):
                weights[k] += (stretched[k] * e + 32768) >> 16
        for state in states:
            state.learn(bit, self.limit)
        r[i] += ((65535 * bit - r[i]) * (4096 - s)) >> 18
        r[i + 1] += ((65535 * bit - r[i + 1]) * s) >> 18
        return bit


# ---- Positions

Cell = tuple[int, int, int]
EMPTY, OCCUPIED, UNKNOWN = range(3)
AXES = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
FACES = [tuple(sign * v for v in axis) for axis in AXES for sign in (-1, 1)]
AROUND = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)]


def moved(a: Cell, b: Any) -> Cell:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def child(node: Cell, c: int) -> Cell:
    return (2 * node[0] + (c >> 2), 2 * node[1] + (c >> 1 & 1), 2 * node[2] + (c & 1))


def morton(offset: Cell, bits: int) -> int:
    return sum((offset[axis] >> b & 1) << (3 * b + 2 - axis) for axis in range(3) for b in range(bits))


def cells(state: dict[Cell, int], own: Cell, kind: int) -> int:
    """How many of the 26 cells around a child are of a kind; all lie in the 4 x 4 x 4 around its node."""
    return sum(state.get(moved(own, d), EMPTY) == kind for d in AROUND)


def single_anchor(
    coder: ArithmeticDecoder, states: list[State], node: Cell, bits: int, sides: list[int]
) -> Cell:
    v = [n << bits for n in node]

    def decide(axis: int, b: int, state: State | None) -> int:
        bit = coder.decide(32768) if state is None else coder.decide_by(state, 1000)
        v[axis] |= bit << b
        return bit

    for b in range(bits - 1, 3, -1):
        for axis in range(3):
            if b == bits - 1:
                decide(axis, b, states[3 * sides[axis] + axis])
            elif b == bits - 2:
                decide(axis, b, states[27 + 3 * (2 * sides[axis] + (v[axis] >> (b + 1) & 1)) + axis])
            else:
                decide(axis, b, None)
    low, zeros, coarse = min(bits, 4), 1, 0
    for half in range(2):
        for axis in range(3):
            for b in range(min(low, 2 * half + 2) - 1, 2 * half - 1, -1):
                context = 128 + ((((half * 3 + axis) * 2 + b % 2) * 2 + zeros) * 2 + coarse) * 5 + low
                if decide(axis, b, states[context]):
                    zeros = 0
        coarse = zeros
    return (v[0], v[1], v[2])


@dataclass(frozen=True)
class Positions:
    """Of all anchors, in canonical order."""

    depth: int
    coordinates: list[Cell]
    offsets: list[Cell]
    levels: list[int]

    def context(self, i: int) -> list[int]:
        """What a network takes of an anchor's coordinates."""
        return [((2 * o + 1 << 12) >> self.depth) - 4096 for o in self.offsets[i]]


def read_positions(data: bytes, anchors: int, most_nodes: int) -> Positions:
    fields = Fields(data, NAMES[POSITIONS])
    fields.require(4 * len(data) >= anchors, f"{len(data)} bytes for {anchors} anchors")
    depth = fields.number("B", 0, 21, "depth")
    fields.require(anchors <= 8**depth, f"{anchors} anchors in {8**depth} voxels")
    x, y, z = (16 * fields.signed(what="origin", most=4) for _ in range(3))
    coder = ArithmeticDecoder(data[fields.at :], fields.name)
    offsets = walk(coder, depth, anchors, most_nodes)
    used = fields.at + coder.end()
    fields.require(len(data) == max(used, -(-anchors // 4)), f"{len(data) - used} bytes are left over")
    fields.require(not any(data[used:]), "the bytes left over are not zero")
    lowest = [min(v[axis] for v in offsets) for axis in range(3)]
    largest = max(max(v) for v in offsets)
    fields.require(max(lowest) < 16, f"the smallest offsets are {lowest}, expected below 16")
    fields.require(largest.bit_length() == depth, f"depth is {depth}, expected {largest.bit_length()}")
    coordinates = [moved((x, y, z), v) for v in offsets]
    fields.require(
        all(-(2**31) <= c < 2**31 for v in coordinates for c in v), "a coordinate has over 32 bits"
    )
    order = canonical(offsets, depth)
    offsets = [v for _, v in order]
    return Positions(depth, [moved((x, y, z), v) for v in offsets], offsets, [level for level, _ in order])


def walk(coder: ArithmeticDecoder, depth: int, anchors: int, most_nodes: int) -> list[Cell]:
    """Offsets, in the order of the code."""
    nodes = 0
    direct = [State() for _ in range(368)]
    occupancy = Mixer(7, 16384, 400, 4)
    single = Mixer(5, 16384, 400, 4)
    offsets: list[Cell] = []
    if anchors == 1:
        offsets.append(single_anchor(coder, direct, (0, 0, 0), depth, [0, 0, 0]))
    waiting: list[tuple[Cell, int, int]] = [((0, 0, 0), 1, 0)] if anchors > 1 else []
    for step in range(depth):
        height = depth - 1 - step
        nodes += len(waiting)
        require(nodes <= most_nodes, coder.name, f"{nodes} nodes or more, expected up to {most_nodes}")
        exists = {node: "waiting" for node, _, _ in waiting}
        state: dict[Cell, int] = {child(node, c): UNKNOWN for node, _, _ in waiting for c in range(8)}
        for v in offsets:
            exists[(v[0] >> height + 1, v[1] >> height + 1, v[2] >> height + 1)] = "single"
            state[(v[0] >> height, v[1] >> height, v[2] >> height)] = OCCUPIED
        following: list[tuple[Cell, int, int]] = []
        for place, (node, parents_children, index) in enumerate(waiting):
            near = [moved(node, d) in exists for d in AROUND]
            neighbours = sum(near)
            crowds = sum(exists.get(moved(node, d)) == "waiting" for d in AROUND)
            face_nodes = sum((moved(node, d) in exists) << k for k, d in enumerate(FACES))
            siblings = parents_children.bit_count() - 1
            code = morton(node, depth)
            grid = int(height < 3 and code % 2 ** max(9 - 3 * height, 0) == 0)
            grid += 2 * int(height == 0 and code % 8 == 0)
            scale_grid = 4 * min(height, 7) + grid
            children = taken = 0
            for c in range(8):
                own = child(node, c)
                bit = 1
                if taken + 8 - c > (2 if height == 0 else 1):
                    side = [(1 if c >> (2 - axis) & 1 else -1) for axis in range(3)]
                    x, y, z = ((side[0], 0, 0), (0, side[1], 0), (0, 0, side[2]))
                    xy, xz, yz = moved(x, y), moved(x, z), moved(y, z)
                    seven = [x, y, z, xy, xz, yz, moved(xy, z)]
                    touching = sum((moved(node, d) in exists) << k for k, d in enumerate(seven))
                    face_states = 0
                    for d in FACES:
                        face_states = 3 * face_states + state.get(moved(own, d), EMPTY)
                    few, prefix = min(taken, 4), 2**c + children
                    occupied, open_ = (
                        min(cells(state, own, OCCUPIED), 12),
                        min(cells(state, own, UNKNOWN), 19),
                    )
                    bit = occupancy.decide(
                        coder,
                        [
                            256 * scale_grid + prefix,
                            (8 * face_states + c) * 5 + few,
                            (8 * touching + c) * 5 + few,
                            (20 * occupied + open_) * 5 + few,
                            ((8 * step + siblings) * 8 + c) * 8 + taken,
                            256 * face_nodes + prefix,
                            (8 * parents_children + index) * 8 + c,
                        ],
                        8 * step + c,
                        168 + 5 * occupied + few,
                        8 * scale_grid + c,
                    )
                state[own] = OCCUPIED if bit else EMPTY
                children |= bit << c
                taken += bit
            shared = 0
            for c in (c for c in range(8) if children >> c & 1):
                own = child(node, c)
                last = int(children >> c == 1)
                alone = int(height == 0)
                if height > 0 and taken > 1:
                    occupied, open_ = (
                        min(cells(state, own, OCCUPIED), 12),
                        min(cells(state, own, UNKNOWN), 19),
                    )
                    crowd = min(shared, 3)
                    alone = single.decide(
                        coder,
                        [
                            (8 * step + taken - 1) * 8 + 2 * crowd + last,
                            (20 * occupied + open_) * 4 + min(taken, 3),
                            (27 * neighbours + crowds) * 4 + min(taken, 3),
                            8 * children + c,
                            (13 * crowds + occupied) * 8 + taken - 1,
                        ],
                        8 * step + taken - 1,
                        168 + 20 * occupied + open_,
                        4 * step + crowd,
                    )
                if alone:
                    faces = [state.get(moved(own, d), EMPTY) for d in FACES]
                    sides = [3 * faces[2 * axis] + faces[2 * axis + 1] for axis in range(3)]
                    offsets.append(single_anchor(coder, direct, own, height, sides))
                else:
                    following.append((own, children, c))
                    shared += 1
            found = len(offsets) + 2 * (len(waiting) - place - 1 + len(following))
            require(found <= anchors, coder.name, f"{found} or more anchors turn up, expected {anchors}")
        waiting = following
    require(len(offsets) == anchors, coder.name, f"{len(offsets)} anchors turn up, expected {anchors}")
    return offsets


def canonical(offsets: list[Cell], depth: int) -> list[tuple[int, Cell]]:
    """Level and offset of each."""
    codes = sorted((morton(v, depth), v) for v in offsets)
    levels = [0]
    for (before, _), (code, _) in pairwise(codes):
        highest = max(d for d in range(depth) if (before ^ code) >> 3 * d & 7)
        levels.append(depth - highest)
    order = sorted((level, code, v) for level, (code, v) in zip(levels, codes, strict=True))
    return [(level, v) for level, _, v in order]


# ---- Masks


def read_masks(data: bytes, anchors: int, slots: int) -> list[list[int]]:
    if not data:
        return [[1] * slots for _ in range(anchors)]
    coder = ArithmeticDecoder(data, NAMES[MASKS])
    mixer = Mixer(3, 24576, 1000, 2)
    rows = [[0] * slots, [0] * slots]
    for _ in range(anchors):
        row: list[int] = []
        for k in range(slots):
            one, two = rows[-1][k], rows[-2][k]
            recent = sum(bit << i for i, bit in enumerate(reversed(row[-8:])))
            third = (4 * k + 2 * one + two) * 65 + sum(rows[-1])
            contexts = [65 * k + sum(row), 256 * k + recent, third]
            row.append(mixer.decide(coder, contexts, k, 64 + 2 * one + two, k))
        rows.append(row)
    require(coder.end() == len(data), coder.name, "bytes are left over")
    require(any(0 in row for row in rows[2:]), coder.name, "every flag is 1, which takes no bytes")
    return rows[2:]


# ---- Latents


def rows(values: list, width: int) -> list[list]:
    return [values[i : i + width] for i in range(0, len(values), width)]


@dataclass(frozen=True)
class RangeHead:
    level: int
    anchors: int
    coupled: int


def read_range_heads(sections: list[Fields]) -> list[RangeHead]:
    return [RangeHead(fields.varint(), fields.varint(1), fields.varint()) for fields in sections]


def check_ranges(heads: list[RangeHead], whole: bool, positions: Positions, mask: list[list[int]]) -> None:
    """whole: the last of them is the last one of the file."""
    name = NAMES[LATENTS]
    begin, before = 0, -1
    for head in heads:
        require(before < head.level <= positions.depth, name, f"level {head.level} after {before}")
        end = sum(level <= head.level for level in positions.levels)
        require(head.anchors == end - begin, name, f"{head.anchors} anchors, expected {end - begin}")
        coupled = sum(map(sum, mask[begin:end]))
        require(head.coupled == coupled, name, f"{head.coupled} coupled primitives, expected {coupled}")
        begin, before = end, head.level
    require(not whole or before == positions.depth, name, f"the last level is {before}")


@dataclass(frozen=True)
class Model:
    """Where each group's tables come from."""

    scene: Scene
    tables: dict[int, list[Table]]
    networks: dict[int, Network]
    gaussian: list[Table]


@dataclass(frozen=True)
class Decoded:
    """Of one group: a row an anchor, or a row a coupled primitive that exists."""

    symbols: list[list[int]]
    latents: list[list[int]]


def read_group_symbols(
    fields: Fields,
    model: Model,
    i: int,
    existing: list[list[int]],
    inputs: list[list[int]],
    around: list[list[int]],
) -> Decoded:
    """existing: of each anchor, the slots that have symbols. inputs: of each anchor, what the network takes. around:
    of each anchor, what its means follow; nothing unless the group takes neighbours.
    """
    group = model.scene.groups[i]
    network = model.networks.get(i)
    means: list[int] = []
    places: list[int] = []  # of each symbol's table, among the Gaussian ones or the group's own
    for slots, x, near in zip(existing, inputs, around, strict=True):
        channels = [slot * group.channels + c for slot in slots for c in range(group.channels)]
        if network:
            y = evaluate(network, x)
            mean, scales = y[: len(y) // 2], y[len(y) // 2 :]
            if group.takes_neighbours():
                mean = followed(network, mean, near)
            means += [mean[c] for c in channels]
            places += [clamp((scales[c] + 2048) >> 12, 0, 127) for c in channels]
        else:
            means += [0] * len(channels)
            places += channels
    if network and network.head.inertia:
        tables: Known = Inert(places, model.gaussian, group.channels, network.head.inertia)
    else:
        choice = model.gaussian if network else model.tables[i]
        tables = Known([choice[place] for place in places])
    symbols = steps = read_stream(fields, tables)
    if network and network.chain:
        steps = [q for row in rows(symbols, group.channels) for q in chained(network.chain, row)]
    for name, values in (("symbol", symbols), ("step", steps)):
        fields.require(all(abs(v) <= MAX_SYMBOL for v in values), f"a {name} beyond {MAX_SYMBOL}")
    latents = [(q << 12) + mean for q, mean in zip(steps, means, strict=True)]
    return Decoded(rows(symbols, group.channels), rows(latents, group.channels))


def chained(chain: list[list[int]], row: list[int]) -> list[int]:
    """The steps that a row's symbols give."""
    steps: list[int] = []
    for s, factors in zip(row, chain, strict=True):
        total = sum(f * q for f, q in zip(factors, steps, strict=True))
        steps.append(s + ((total + 2 ** (CHAIN_BITS - 1)) >> CHAIN_BITS))
    return steps


@dataclass(frozen=True)
class Earlier:
    """The anchors of the ranges before one."""

    shift: int  # from an offset to its node
    offsets: list[Cell]
    ranges: list[list[Decoded]]

    def node(self, offset: Cell) -> Cell:
        return (offset[0] >> self.shift, offset[1] >> self.shift, offset[2] >> self.shift)


def followed(network: Network, outputs: list[int], around: list[int]) -> list[int]:
    """An anchor's means."""
    s = network.head.follow_shift
    half = 2 ** (s - 1) if s > 0 else 0
    means = []
    for output, b, f, v in zip(outputs, network.biases[-1], network.follow, around, strict=False):
        moved = output - b + ((f * v + half) >> s)
        means.append(activation(b + (((moved + 2048) >> 12) << 12)))
    return means


def neighbours_have(
    earlier: Earlier | None, offsets: list[Cell], group: Group, means: list[int]
) -> list[list[int]]:
    """Of each anchor of a range: known, activity, and around of each channel. means: of the channels."""
    if earlier is None:
        return [[0] * (2 + group.channels) for _ in offsets]
    latents = [row for decoded in earlier.ranges for row in decoded[group.index].latents]
    d = [[activation(x - b) for x, b in zip(row, means, strict=True)] for row in latents]
    a = [sum(map(abs, row)) // group.channels for row in d]
    at_node = {earlier.node(offset): j for j, offset in enumerate(earlier.offsets)}
    have = []
    for offset in offsets:
        nodes = [moved(earlier.node(offset), step) for step in [(0, 0, 0), *AROUND]]
        near = [at_node[node] for node in nodes if node in at_node]
        w = [1 + NEAREST_WEIGHT // distance(offset, earlier.offsets[j]) for j in near]
        columns = zip(*([a[j], *d[j]] for j in near), strict=True)
        average = [sum(v * x for v, x in zip(w, column, strict=True)) // sum(w) for column in columns]
        have.append([4096, *average])
    return have


def distance(a: Cell, b: Cell) -> int:
    return sum(abs(p - q) for p, q in zip(a, b, strict=True))


def read_range(
    fields: Fields,
    model: Model,
    positions: Positions,
    begin: int,
    mask: list[list[int]],
    earlier: Earlier | None,
) -> list[Decoded]:
    """begin: the range's first anchor; mask: of its anchors; earlier: None for the first range."""
    anchors = range(begin, begin + len(mask))
    places = [positions.context(i) for i in anchors]
    offsets = [positions.offsets[i] for i in anchors]
    decoded: list[Decoded] = []
    for i, group in enumerate(model.scene.groups):
        existing = [
            [slot for slot, bit in enumerate(row) if bit] if group.role == RESIDUAL else [0] for row in mask
        ]
        sources = [places] if group.context & 1 else []
        sources += [decoded[j].latents for j in group.contexts()]
        around: list[list[int]] = [[] for _ in mask]
        if group.takes_neighbours():
            means = model.networks[i].biases[-1][: group.channels]
            have = neighbours_have(earlier, offsets, group, means)
            sources.append([row[:2] for row in have])
            around = [row[2:] for row in have]
        inputs = [[v for source in sources for v in source[a]] for a in range(len(mask))]
        decoded.append(read_group_symbols(fields, model, i, existing, inputs, around))
    fields.end()
    return decoded


# ---- Viewpoints, metadata, padding


def read_viewpoints(data: bytes) -> dict[str, Any]:
    fields = Fields(data, NAMES[VIEWPOINTS])
    up = fields.unpack("3b")
    fields.require(any(up) and min(up) >= -127, f"up is {up}")
    centre = fields.unpack("3f")
    fields.require(all(map(math.isfinite, centre)), f"centre is {centre}")
    radius = positive(fields, "radius")
    lenses = []
    for _ in range(fields.number("B", 1, 16, "lenses")):
        size = [fields.number("H", 1, 65535, "size of a lens") for _ in range(2)]
        lenses.append([*size, positive(fields, "focal length"), positive(fields, "focal length")])
    views = []
    for _ in range(fields.number("B", 1, 255, "views")):
        lens = lenses[fields.number("B", 0, len(lenses) - 1, "lens")]
        position = [fields.number("h", -32767, 32767, "position") for _ in range(3)]
        center = [c + radius * p / 32767 for c, p in zip(centre, position, strict=True)]
        rotation = read_rotation(fields)
        views.append({"lens": lens, "center": center, "rotation": rotation})
    fields.end()
    return {"up": [v / 127 for v in up], "views": views}


def positive(fields: Fields, what: str) -> float:
    (value,) = fields.unpack("f")
    fields.require(0 < value < math.inf, f"{what} is {value}")
    return value


def read_rotation(fields: Fields) -> list[float]:
    bits = int.from_bytes(fields.take(6), "little")
    fields.require(bits >> 47 == 0, "bit 47 of a rotation is not 0")
    largest = bits & 3
    numbers = [(bits >> 2 + 15 * i) & 0x7FFF for i in range(3)]
    numbers = [v - 2**15 if v >= 2**14 else v for v in numbers]
    squares = sum(v * v for v in numbers)
    fields.require(min(numbers) >= -16383, f"a rotation has {numbers}, expected -16383 or more")
    fields.require(squares <= 3 * 2**27, f"a rotation has {numbers}: the fourth is not the largest")
    rotation = [v / (16383 * math.sqrt(2)) for v in numbers]
    rotation.insert(largest, math.sqrt(1 - squares / (2 * 16383**2)))
    return rotation


def read_metadata(data: bytes) -> dict[str, str]:
    fields = Fields(data, NAMES[METADATA])
    fields.require(len(data) <= MAX_METADATA_BYTES, f"{len(data)} bytes, expected up to {MAX_METADATA_BYTES}")
    metadata: dict[str, str] = {}
    before = None
    for _ in range(fields.varint()):
        key = fields.take(fields.varint())
        fields.require(before is None or before < key, f"{key!r} after {before!r}")
        metadata[text(fields, key)] = text(fields, fields.take(fields.varint()))
        before = key
    fields.end()
    return metadata


# ---- File


@dataclass(frozen=True)
class File:
    version: int
    sections: dict[int, bytes]  # but for the latents
    latents: list[bytes]  # those that are there
    whole: bool  # all of them are


def check_head(data: bytes) -> list[tuple[int, int, int]]:
    """Number, length and checksum of each section: rows 1 to 9 of what a decoder must refuse."""
    if data[:4] != MAGIC[: len(data)]:
        raise NotACompGSFile("the first bytes are not those of a .cgs file")
    if len(data) < 7:
        raise TruncatedSection(f"the header ends after {len(data)} bytes")
    if not OLDEST_VERSION <= data[4] <= VERSION:
        raise UnsupportedVersion(f"version {data[4]}, expected {OLDEST_VERSION} to {VERSION}")
    count = data[6]
    end = 7 + 9 * count
    if len(data) < end + 4:
        raise TruncatedSection(f"the header has {end + 4} bytes, the file {len(data)}")
    require(zlib.crc32(data[:end]) == struct.unpack_from("<I", data, end)[0], "header", "the checksum")
    require(data[5] == 0, "header", f"flags are {data[5]}")
    require(count <= MAX_SECTIONS, "header", f"{count} sections, expected up to {MAX_SECTIONS}")
    table = [struct.unpack_from("<BII", data, 7 + 9 * i) for i in range(count)]
    check_numbers([number for number, _, _ in table])
    return table


def check_numbers(numbers: list[int]) -> None:
    required = [number for number in numbers if number < OPTIONAL]
    unknown = [number for number in required if number not in NAMES]
    if unknown:
        raise UnsupportedVersion(f"section {unknown[0]} is of a later version")
    require(required == sorted(required), "header", f"sections {required} do not ascend")
    once = [number for number in numbers if number != LATENTS]
    require(len(set(once)) == len(once), "header", "a section is there twice")
    needed = {SCENE, MASKS, TABLES, NETWORKS, HEADS, LATENTS}
    require(needed <= set(required), "header", f"sections {sorted(needed - set(required))} are missing")
    require((POSITIONS in required) != (GPCC in required), "header", "not exactly one section of positions")
    ranges = required.count(LATENTS)
    require(ranges <= MAX_RANGES, "header", f"{ranges} sections of latents, expected up to {MAX_RANGES}")


def read_file(data: bytes, prefix: bool) -> File:
    table = check_head(data)
    at = 11 + 9 * len(table)
    sections: dict[int, bytes] = {}
    latents: list[bytes] = []
    for number, length, checksum in table:
        name = NAMES.get(number, f"section {number}")
        if at + length > len(data):
            if prefix and latents:
                break
            raise TruncatedSection(f"{name}: {length} bytes are promised, {len(data) - at} are there")
        payload = data[at : at + length]
        require(zlib.crc32(payload) == checksum, name, "the checksum does not match")
        if number == LATENTS:
            latents.append(payload)
        else:
            sections[number] = payload
        at += length
    else:
        require(at == len(data), "file", f"{len(data) - at} bytes after the last section")
    whole = len(latents) == sum(number == LATENTS for number, _, _ in table)
    return File(data[4], sections, latents, whole)


def decode(data: bytes, prefix: bool = False) -> dict[str, Any]:
    """Everything that a file holds; rows of anchors are in canonical order.

    prefix: the file may end early; of the anchors, those of the ranges that are there.

    Of each group: `symbols` of its streams, a row an anchor, with role 3 a row a slot of an anchor and zeros where
    nothing exists; `latents` in Q12, a row an anchor, with role 3 a row a coupled primitive that exists.
    """
    file = read_file(data, prefix)
    sections = file.sections
    scene = read_scene(sections[SCENE], file.version)
    ranges = [Fields(payload, NAMES[LATENTS]) for payload in file.latents]
    heads = read_range_heads(ranges)
    anchors = sum(head.anchors for head in heads) if prefix else scene.anchors
    coupled = sum(head.coupled for head in heads) if prefix else scene.coupled
    check_symbols(scene, anchors, len(data))
    check_flags(scene, len(data))
    model = read_model(file, scene, anchors, len(data))
    tensors = read_heads(sections[HEADS], file.version, scene, coupled, len(data), model.gaussian)
    if GPCC in sections:
        raise MissingDependency("positions (G-PCC): this decoder has no G-PCC")
    positions = read_positions(sections[POSITIONS], scene.anchors, FREE_NODES + NODES_PER_BYTE * len(data))
    mask = read_masks(sections[MASKS], scene.anchors, scene.coupled_primitives)
    found = sum(map(sum, mask))
    require(found == scene.coupled, "masks", f"{found} coupled primitives, expected {scene.coupled}")
    check_ranges(heads, file.whole, positions, mask)
    decoded: list[list[Decoded]] = []
    earlier = None
    begin = 0
    for fields, head in zip(ranges, heads, strict=True):
        end = begin + head.anchors
        decoded.append(read_range(fields, model, positions, begin, mask[begin:end], earlier))
        earlier = Earlier(positions.depth - head.level, positions.offsets[:end], decoded)
        begin = end
    require(not any(sections.get(PADDING, b"")), "padding", "a byte is not zero")
    numbers = asdict(scene)
    numbers.pop("groups")
    return {
        "scene": numbers,
        "coordinates": [list(v) for v in positions.coordinates[:begin]],
        "mask": mask[:begin],
        "groups": [
            group_arrays(group, [parts[i] for parts in decoded], mask[:begin])
            for i, group in enumerate(scene.groups)
        ],
        "heads": tensors,
        "viewpoints": read_viewpoints(sections[VIEWPOINTS]) if VIEWPOINTS in sections else None,
        "metadata": read_metadata(sections[METADATA]) if METADATA in sections else {},
    }


def check_symbols(scene: Scene, anchors: int, n: int) -> None:
    """n: length of the file."""
    width = sum(group.width(scene.coupled_primitives) for group in scene.groups)
    allowed = FREE_SYMBOLS + SYMBOLS_PER_BYTE * n
    require(anchors * width <= allowed, "scene", f"{anchors * width} symbols, expected up to {allowed}")


def check_flags(scene: Scene, n: int) -> None:
    flags, allowed = scene.anchors * scene.coupled_primitives, FREE_FLAGS + FLAGS_PER_BYTE * n
    require(flags <= allowed, "scene", f"{flags} flags of masks, expected up to {allowed}")


def read_model(file: File, scene: Scene, anchors: int, n: int) -> Model:
    gaussian = gaussian_tables()
    tables = read_tables(file.sections[TABLES], scene, gaussian)
    networks = read_networks(file.sections[NETWORKS], file.version, scene, anchors, n, gaussian)
    return Model(scene, tables, networks, gaussian)


def group_arrays(group: Group, parts: list[Decoded], mask: list[list[int]]) -> dict[str, Any]:
    symbols = [row for part in parts for row in part.symbols]
    latents = [row for part in parts for row in part.latents]
    if group.role == RESIDUAL:
        existing = iter(symbols)
        symbols = [[next(existing) if bit else [0] * group.channels for bit in row] for row in mask]
    return asdict(group) | {"symbols": symbols, "latents": latents}


if __name__ == "__main__":
    print(json.dumps(decode(Path(sys.argv[1]).read_bytes(), "--prefix" in sys.argv[2:])))
