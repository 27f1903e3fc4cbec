"""Prints a small .cgs file byte by byte, as docs/bitstream.md shows it.

python tools/describe_file.py tests/golden/tiny.cgs
"""

import struct
import sys
from collections.abc import Iterator
from pathlib import Path

from compgs.codec.format import (
    HEADS,
    HYPER_TABLES,
    MASKS,
    METADATA,
    NETWORKS,
    POSITIONS,
    SCENE,
    container_bytes,
    unpack,
)
from compgs.codec.reader import read_content

SCENE_FIELDS = (
    ("anchors", "I"),
    ("coupled", "I"),
    ("coupled_primitives", "B"),
    ("reference_dim", "H"),
    ("residual_dim", "B"),
    ("reference_hyper_dim", "B"),
    ("residual_hyper_dim", "B"),
    ("heads", "B"),
    ("width", "H"),
    ("voxel_size", "d"),
    ("view_distance_scale", "d"),
    ("background", "fff"),
    ("reference_step", "f"),
    ("residual_step", "f"),
    ("covariance_step", "f"),
)

Row = tuple[bytes, str]


class Cursor:
    """Takes pieces from the front of a payload, each with a description."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, count: int) -> bytes:
        self.at += count
        return self.data[self.at - count : self.at]

    def varint(self) -> tuple[bytes, int]:
        start = self.at
        while self.data[self.at] >= 0x80:
            self.at += 1
        self.at += 1
        raw = self.data[start : self.at]
        return raw, sum((b & 0x7F) << 7 * i for i, b in enumerate(raw))

    def rest(self) -> bytes:
        return self.take(len(self.data) - self.at)


def signed(value: int) -> int:
    return -((value + 1) >> 1) if value & 1 else value >> 1


def header(data: bytes) -> Iterator[Row]:
    yield data[:4], "`Magic`"
    yield data[4:5], f"`Version` {data[4]}"
    yield data[5:6], "`Flags`"
    yield data[6:7], f"`Section_Count` {data[6]}"
    for i, section in enumerate(unpack(data)):
        entry = data[7 + 9 * i : 16 + 9 * i]
        yield entry, f"section {section.number}, {section.name}: {len(section.data)} bytes, CRC32"
    yield data[container_bytes(data[6]) - 4 : container_bytes(data[6])], "`Header_CRC`"


def scene(c: Cursor) -> Iterator[Row]:
    for name, kind in SCENE_FIELDS:
        raw = c.take(struct.calcsize("<" + kind))
        values = struct.unpack("<" + kind, raw)
        yield raw, f"`{name}` " + ", ".join(f"{v:g}" for v in values)


def arrays(c: Cursor, count: int) -> Iterator[Row]:
    for i in range(count):
        raw = c.take(2)
        yield raw, f"array {i}: table {raw[0]}, {raw[1]} low bits"
    raw, size = c.varint()
    yield raw, f"`stream_bytes` {size}"
    inner = Cursor(c.take(size))
    yield from stream(inner)
    low = c.rest()
    if low:
        yield low, "`low_parts`"


def stream(c: Cursor) -> Iterator[Row]:
    if not c.data:
        return
    raw, words = c.varint()
    yield raw, f"`words` {words}"
    raw, escapes = c.varint()
    yield raw, f"`escape_bytes` {escapes}"
    raw = c.take(8)
    yield raw, f"initial state {int.from_bytes(raw, 'little'):#x}"
    if words > 2:
        yield c.take(4 * (words - 2)), f"{words - 2} words"
    if escapes:
        yield c.take(escapes), "`escapes`"


def hyper_tables(c: Cursor, count: int) -> Iterator[Row]:
    for i in range(count):
        raw, entries = c.varint()
        raw2, lowest = c.varint()
        yield raw + raw2, f"table {i}: {entries} entries from symbol {signed(lowest)} on"
    yield from arrays(c, 1)


def networks(c: Cursor) -> Iterator[Row]:
    total = 0
    for name in ("reference", "covariance", "residual"):
        raw, layers = c.varint()
        yield raw, f"{name} network: {layers} layer{'s' * (layers > 1)}"
        for i in range(layers):
            total += 4
            raw, outputs = c.varint()
            flags = c.take(1)
            rectify = ", rectify" if flags[0] >> 7 else ""
            yield raw + flags, f"layer {i}: {outputs} outputs, shift {flags[0] & 127}{rectify}"
    yield from arrays(c, total)


def heads(c: Cursor) -> Iterator[Row]:
    raw, count = c.varint()
    yield raw, f"`tensors` {count}"
    name = b""
    for _ in range(count):
        raw, shared = c.varint()
        raw2, rest = c.varint()
        tail = c.take(rest)
        name = name[:shared] + tail
        yield raw + raw2 + tail, f"name: {shared} bytes shared, {rest} more: `{name.decode()}`"
        raw, rank = c.varint()
        sides = []
        for _ in range(rank):
            more, side = c.varint()
            raw += more
            sides.append(side)
        more, exponent = c.varint()
        yield raw + more, f"rank {rank}, shape {sides}, exponent {signed(exponent)}"
    if count:
        yield from arrays(c, count)


def metadata(c: Cursor) -> Iterator[Row]:
    raw, count = c.varint()
    yield raw, f"{count} entr{'y' if count == 1 else 'ies'}"
    for _ in range(count):
        for what in ("key", "value"):
            raw, size = c.varint()
            text = c.take(size)
            yield raw + text, f"{what} `{text.decode()}`"


def rows(data: bytes) -> Iterator[Row]:
    """(bytes, meaning) of all pieces of a file, in order."""
    content = read_content(data)
    d = content.dimensions
    yield from header(data)
    for section in unpack(data):
        c = Cursor(section.data)
        readers = {
            SCENE: lambda c: scene(c),
            HYPER_TABLES: lambda c: hyper_tables(c, d.reference_hyper_dim + d.residual_hyper_dim),
            NETWORKS: networks,
            HEADS: heads,
            METADATA: metadata,
            POSITIONS: lambda c: [(c.rest(), "payload")],
            MASKS: lambda c: [(c.rest(), "payload")],
        }
        for raw, meaning in readers.get(section.number, stream)(c):
            yield raw, f"{section.name}: {meaning}"
        assert c.at == len(section.data), section.name


def table(data: bytes) -> str:
    lines = ["| Offset | Bytes | Meaning |", "|---|---|---|"]
    at = 0
    for raw, meaning in rows(data):
        shown = raw.hex(" ")
        lines.append(f"| {at} | `{shown}` | {meaning} |")
        at += len(raw)
    assert at == len(data)
    return "\n".join(lines)


def symbols(data: bytes) -> str:
    content = read_content(data)
    lines = ["| | Values |", "|---|---|"]
    for name in (
        "coordinates",
        "mask",
        "reference_hyper",
        "reference",
        "covariance",
        "residual_hyper",
        "residual",
    ):
        lines.append(f"| {name} | {(getattr(content, name) * 1).tolist()} |")
    for name, network in content.networks.items():
        for i, layer in enumerate(network.layers):
            lines.append(
                f"| {name} network, layer {i} | W {layer.weight.tolist()}, b {layer.bias.tolist()} |"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    file = Path(sys.argv[1]).read_bytes()
    print(table(file), symbols(file), sep="\n\n")
