"""Prints a small .cgs file byte by byte, as docs/bitstream.md shows it.

python tools/describe_file.py tests/golden/tiny.cgs
"""

import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from compgs.codec.content import FileContent, Role
from compgs.codec.format import (
    FIRST_WITH_DILATION,
    FIRST_WITH_ROWS,
    HEADS,
    LATENTS,
    MASKS,
    METADATA,
    NETWORKS,
    POSITIONS,
    SCENE,
    TABLES,
    container_bytes,
    unpack,
    version_of,
)
from compgs.codec.integer_network import IntegerNetwork
from compgs.codec.rans import CHUNK_SYMBOLS
from compgs.codec.reader import group_names, read_latents
from compgs.codec.rows import CHAIN_BITS
from compgs.codec.sections import HEADS as HEAD_LAYOUTS
from compgs.codec.weights import ADDS, CHAINED, RECTIFY, SHIFTS, SKIP

SCENE_FIELDS = (
    ("anchors", "I"),
    ("coupled", "I"),
    ("coupled_primitives", "B"),
    ("residual_dim", "B"),
    ("heads", "B"),
    ("width", "H"),
    ("voxel_size", "d"),
    ("world_offset", "ddd"),
    ("view_distance_scale", "d"),
    ("background", "fff"),
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


def plural(count: int, thing: str) -> str:
    return f"{count} {thing}{'s' * (count != 1)}"


def header(data: bytes) -> Iterator[Row]:
    yield data[:4], "`Magic`"
    yield data[4:5], f"`Version` {data[4]}"
    yield data[5:6], "`Flags`"
    yield data[6:7], f"`Section_Count` {data[6]}"
    for i, section in enumerate(unpack(data)):
        entry = data[7 + 9 * i : 16 + 9 * i]
        yield entry, f"section {section.number}, {section.name}: {plural(len(section.data), 'byte')}, CRC32"
    yield data[container_bytes(data[6]) - 4 : container_bytes(data[6])], "`Header_CRC`"


def scene(c: Cursor, version: int) -> Iterator[Row]:
    dilation = (("angular_dilation", "f"),) if version >= FIRST_WITH_DILATION else ()
    for name, kind in (*SCENE_FIELDS, *dilation):
        raw = c.take(struct.calcsize("<" + kind))
        shown = ", ".join(f"{v:g}" for v in struct.unpack("<" + kind, raw))
        layout = f" ({HEAD_LAYOUTS[raw[0]]})" if name == "heads" else ""
        yield raw, f"`{name}` {shown}{layout}"
    raw, count = c.varint()
    yield raw, f"`groups` {count}"
    for i in range(count):
        yield from group(c, i)


def group(c: Cursor, index: int) -> Iterator[Row]:
    role = c.take(1)
    raw, channels = c.varint()
    kind = Role(role[0]).name.lower().replace("_", " ")
    yield role + raw, f"group {index}: `role` {role[0]}, {kind}; `channels` {channels}"
    raw, context = c.varint()
    seen = ["coordinates"] * (context & 1) + [f"group {i}" for i in range(index) if context >> (i + 1) & 1]
    seen += ["neighbours"] * (context >> (index + 1) & 1)
    yield raw, f"group {index}: `context` {context}: {' and '.join(seen) or 'none, so tables'}"
    raw, count = c.varint()
    steps = c.take(4 * count)
    shown = ", ".join(f"{v:g}" for v in struct.unpack(f"<{count}f", steps))
    yield raw + steps, f"group {index}: `steps` {count}" + (f": {shown}" if count else "")


def arrays(c: Cursor, names: list[str]) -> Iterator[Row]:
    """names: of the arrays; empty where the document has none."""
    for i, name in enumerate(names):
        raw = c.take(2)
        named = f", {name}" if name else ""
        yield raw, f"array {i}{named}: table {raw[0]}, {raw[1]} low bits"
    raw, size = c.varint()
    yield raw, f"`stream_bytes` {size}"
    inner = Cursor(c.take(size))
    if size:
        yield from stream(inner)
    assert inner.at == size
    low = c.rest()
    if low:
        yield low, "`low_parts`"


def stream(c: Cursor) -> Iterator[Row]:
    """A stream of few symbols: of one chunk, and so of one state."""
    raw, words = c.varint()
    yield raw, f"`words` {words}"
    raw, escapes = c.varint()
    yield raw, f"`escape_bytes` {escapes}"
    raw = c.take(8)
    yield raw, f"initial state {int.from_bytes(raw, 'little'):#x}"
    if words > 2:
        yield c.take(4 * (words - 2)), plural(words - 2, "word")
    if escapes:
        yield c.take(escapes), "`escapes`"


def tables(c: Cursor, count: int) -> Iterator[Row]:
    for i in range(count):
        raw, entries = c.varint()
        raw2, lowest = c.varint()
        yield raw + raw2, f"table {i}: {entries} entries from symbol {signed(lowest)} on"
    if count:
        yield from arrays(c, [""])


def networks(c: Cursor, names: list[str], follow: list[bool], version: int) -> Iterator[Row]:
    """follow: whether the means of each follow neighbours."""
    found: list[str] = []  # names of the arrays
    for name, follows in zip(names, follow, strict=True):
        raw, layers = c.varint()
        flags = c.take(1)
        chained = bool(flags[0] & CHAINED)
        marks = ", skip" * bool(flags[0] & SKIP) + ", chain" * chained
        yield raw + flags, f"network of the {name}: {plural(layers, 'layer')}{marks}"
        for i in range(layers):
            found += [""] * 4
            raw, outputs = c.varint()
            flags = c.take(1)
            marks = ", rectify" * bool(flags[0] & RECTIFY) + ", adds" * bool(flags[0] & ADDS)
            yield raw + flags, f"layer {i}: {outputs} outputs, shift {flags[0] & SHIFTS}{marks}"
        if follows:
            found.append(f"`follow` of the {name}")
            raw = c.take(1)
            yield raw, f"`follow_shift` {raw[0]}"
        if version >= FIRST_WITH_ROWS:
            raw = c.take(1)
            yield raw, f"`inertia` {raw[0]}"
        if chained:
            found.append(f"`chain` of the {name}")
    if found:
        yield from arrays(c, found)


def heads(c: Cursor, shapes: Mapping[str, tuple[int, ...]]) -> Iterator[Row]:
    """Without names: the scene says which tensors there are."""
    for name, shape in shapes.items():
        raw, exponent = c.varint()
        yield raw, f"`{name}`: shape {list(shape)}, exponent {signed(exponent)}"
    yield from arrays(c, [f"`{name}`" for name in shapes])


def named_heads(c: Cursor) -> Iterator[Row]:
    """Of versions before `FIRST_WITH_ROWS`."""
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
        yield from arrays(c, [""] * count)


def latents(c: Cursor, content: FileContent) -> Iterator[Row]:
    raw, level = c.varint()
    yield raw, f"`level` {level}"
    raw, anchors = c.varint()
    yield raw, f"`anchors` {anchors}"
    raw, coupled = c.varint()
    yield raw, f"`coupled` {coupled}"
    for i, part in enumerate(content.groups):
        count = part.shape.channels * (coupled if part.shape.role == Role.RESIDUAL else anchors)
        assert count <= CHUNK_SYMBOLS, "too large a file to be shown byte by byte"
        for raw, meaning in stream(c) if count else ():
            yield raw, f"group {i}: {meaning}"


def metadata(c: Cursor) -> Iterator[Row]:
    raw, count = c.varint()
    yield raw, f"{count} entr{'y' if count == 1 else 'ies'}"
    for _ in range(count):
        for what in ("key", "value"):
            raw, size = c.varint()
            text = c.take(size)
            yield raw + text, f"{what} `{text.decode()}`"


def payload(c: Cursor) -> Iterator[Row]:
    data = c.rest()
    if data:
        yield data, "payload"


def rows(data: bytes) -> Iterator[Row]:
    """(bytes, meaning) of all pieces of a file, in order."""
    content = read_latents(data)[0]
    d = content.dimensions
    version = version_of(data)
    names = [f"{name} (group {i})" for i, name in enumerate(group_names(d)) if d.groups[i].has_network]
    readers: dict[int, Callable[[Cursor], Iterable[Row]]] = {
        SCENE: lambda c: scene(c, version),
        POSITIONS: payload,
        MASKS: payload,
        TABLES: lambda c: tables(c, d.table_count),
        NETWORKS: lambda c: networks(c, names, d.networks_that_follow, version),
        HEADS: named_heads if version < FIRST_WITH_ROWS else lambda c: heads(c, d.head_shapes),
        LATENTS: lambda c: latents(c, content),
        METADATA: metadata,
    }
    yield from header(data)
    for section in unpack(data):
        c = Cursor(section.data)
        for raw, meaning in readers.get(section.number, payload)(c):
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


def values(data: bytes) -> str:
    """What the file's symbols, latents, tables and networks are."""
    content, decoded = read_latents(data)
    lines = ["| | Values |", "|---|---|"]
    lines.append(f"| coordinates | {content.coordinates.tolist()} |")
    lines.append(f"| mask | {(content.mask * 1).tolist()} |")
    for i, (part, fixed) in enumerate(zip(content.groups, decoded, strict=True)):
        lines.append(f"| group {i}, symbols | {part.symbols.tolist()} |")
        lines.append(f"| group {i}, latents times 4096 | {fixed.tolist()} |")
        if not isinstance(part.prior, IntegerNetwork):
            lines += [
                f"| group {i}, levels of table {n} | {t.levels.tolist()} |" for n, t in enumerate(part.prior)
            ]
            continue
        for n, layer in enumerate(part.prior.layers):
            lines.append(f"| group {i}, layer {n} | W {layer.weight.tolist()}, b {layer.bias.tolist()} |")
        if part.prior.follow:
            lines.append(
                f"| group {i}, follow, times 2^{part.prior.follow.shift} | {part.prior.follow.weight.tolist()} |"
            )
        context = part.prior.rows
        if context.inertia:
            lines.append(f"| group {i}, inertia | {context.inertia} |")
        if context.chain is not None:
            lines.append(f"| group {i}, chain, times 2^{CHAIN_BITS} | {context.chain.tolist()} |")
    for name, tensor in content.heads:
        lines.append(f"| {name}, times 2^{tensor.exponent} | {tensor.values.tolist()} |")
    return "\n".join(lines)


if __name__ == "__main__":
    file = Path(sys.argv[1]).read_bytes()
    print(table(file), values(file), sep="\n\n")
