"""A decoder in plain Python, written from docs/bitstream.md alone: slow, and independent of the package.

    python tools/plain_decoder.py FILE        prints coordinates, mask, symbols and latents as JSON

It shows that the document is complete, and the tests hold the real decoder against it.
"""

import json
import struct
import sys
import zlib
from itertools import pairwise
from pathlib import Path
from typing import Any

TABLES = Path(__file__).parent.parent / "src" / "compgs" / "codec" / "gaussian_tables.bin"


# ---- Fields


class Fields:
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, count: int) -> bytes:
        assert self.at + count <= len(self.data)
        self.at += count
        return self.data[self.at - count : self.at]

    def varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def signed(self) -> int:
        v = self.varint()
        return -(v + 1) // 2 if v % 2 else v // 2


# ---- Tables


class Table:
    def __init__(self, lowest: int, frequencies: list[int]) -> None:
        assert sum(frequencies) == 65536 and min(frequencies) >= 1
        self.lowest = lowest
        self.escape = len(frequencies) - 1
        self.starts = [sum(frequencies[:j]) for j in range(len(frequencies))]
        self.frequencies = frequencies

    def entry(self, slot: int) -> int:
        j = len(self.starts) - 1
        while self.starts[j] > slot:
            j -= 1
        return j


def gaussian_tables() -> list[Table]:
    data = TABLES.read_bytes()
    assert zlib.crc32(data) == 0xAD3B4090
    numbers = list(struct.unpack(f"<{len(data) // 2}H", data))
    tables = []
    while numbers:
        r = numbers[0]
        half, escape = numbers[1 : r + 2], numbers[r + 2]
        tables.append(Table(-r, [*half[:0:-1], *half, escape]))
        numbers = numbers[r + 3 :]
    return tables


def hyper_tables(data: bytes, count: int, gaussian: list[Table]) -> list[Table]:
    fields = Fields(data)
    ranges = [(fields.varint(), fields.signed()) for _ in range(count)]
    (d,) = integer_arrays(fields, [sum(entries for entries, _ in ranges)], gaussian)
    tables = []
    for entries, lowest in ranges:
        part, d = d[:entries], d[entries:]
        levels = [sum(part[: j + 1]) for j in range(entries - 1)] + [part[-1]]
        mantissas = [1024, 1116, 1217, 1327, 1448, 1579, 1722, 1878]
        w = [mantissas[level % 8] << (level >> 3) for level in levels]
        f = [1 + x * (65536 - entries) // sum(w) for x in w]
        f[levels.index(max(levels))] += 65536 - sum(f)
        tables.append(Table(lowest, f))
    return tables


# ---- Streams


def stream(data: bytes, tables: list[Table]) -> list[int]:
    """One symbol for each of the tables."""
    if not tables:
        assert not data
        return []
    fields = Fields(data)
    chunks = [tables[i : i + 2**20] for i in range(0, len(tables), 2**20)]
    words = [fields.varint() for _ in chunks]
    escape_bytes = fields.varint()
    symbols: list[int | None] = []
    for chunk, count in zip(chunks, words, strict=True):
        values = list(struct.unpack(f"<{count}I", fields.take(4 * count)))
        states = []
        for _ in range(1 if len(chunk) < 2**18 else 2):
            states.append(values[0] + 2**32 * values[1])
            values = values[2:]
        for i, table in enumerate(chunk):
            k = i % len(states)
            slot = states[k] % 65536
            j = table.entry(slot)
            states[k] = table.frequencies[j] * (states[k] // 65536) + slot - table.starts[j]
            if states[k] < 2**31:
                states[k] = 2**32 * states[k] + values.pop(0)
            symbols.append(None if j == table.escape else table.lowest + j)
        assert not values and all(state == 2**31 for state in states)
    escapes = Fields(fields.take(escape_bytes))
    out = []
    for symbol, table in zip(symbols, tables, strict=True):
        if symbol is None:
            v = escapes.varint()
            symbol = table.lowest - 1 - (v - 1) // 2 if v % 2 else table.lowest + table.escape + v // 2
        out.append(symbol)
    assert escapes.at == escape_bytes and fields.at == len(data)
    return out


# ---- Arrays of integers, networks, heads


def integer_arrays(fields: Fields, sizes: list[int], gaussian: list[Table]) -> list[list[int]]:
    settings = [(fields.take(1)[0], fields.take(1)[0]) for _ in sizes]
    data = fields.take(fields.varint())
    of_element = [setting for size, setting in zip(sizes, settings, strict=True) for _ in range(size)]
    highs = stream(data, [gaussian[table] for table, _ in of_element])
    bits = "".join(f"{byte:08b}" for byte in fields.take(len(fields.data) - fields.at))
    values = []
    at = 0
    for high, (_, low_bits) in zip(highs, of_element, strict=True):
        low = int(bits[at : at + low_bits] or "0", 2)
        at += low_bits
        values.append(high * 2**low_bits + low - 2**low_bits // 2)
    assert len(bits) - at < 8 and "1" not in bits[at:]
    arrays = []
    for size in sizes:
        arrays.append(values[:size])
        values = values[size:]
    return arrays


def entropy_networks(
    data: bytes, inputs_outputs: list[tuple[int, int]], gaussian: list[Table]
) -> list[list[dict]]:
    fields = Fields(data)
    networks: list[list[dict]] = []
    sizes = []
    for inputs, outputs in inputs_outputs:
        layers = []
        for _ in range(fields.varint()):
            o, flags = fields.varint(), fields.take(1)[0]
            layers.append({"inputs": inputs, "shift": flags & 127, "rectify": flags >> 7})
            first = (o + 1) // 2
            sizes += [first * inputs, (o - first) * inputs, first, o - first]
            inputs = o
        assert inputs == outputs
        networks.append(layers)
    arrays = integer_arrays(fields, sizes, gaussian)
    for layer in (layer for layers in networks for layer in layers):
        upper, lower, b1, b2 = arrays[:4]
        arrays = arrays[4:]
        weights = upper + lower
        n = layer["inputs"]
        layer["W"] = [weights[i : i + n] for i in range(0, len(weights), n)]
        layer["b"] = b1 + b2
    return networks


def clamp(v: int, lowest: int, highest: int) -> int:
    return min(max(v, lowest), highest)


def evaluate(layers: list[dict], x: list[int]) -> list[int]:
    x = [clamp(v, -(2**23), 2**23 - 1) for v in x]
    for layer in layers:
        out = []
        for row, bias in zip(layer["W"], layer["b"], strict=True):
            y = sum(w * v for w, v in zip(row, x, strict=True))
            if layer["shift"] > 0:
                y = (y + 2 ** (layer["shift"] - 1)) >> layer["shift"]
            y += bias
            if layer["rectify"]:
                y = max(y, y >> 6)
            out.append(clamp(y, -(2**23), 2**23 - 1))
        x = out
    return x


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
    def __init__(self, data: bytes) -> None:
        self.data = data
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
        assert self.code == ((self.low >> 40) + 1) << 40
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


def positions(data: bytes, anchors: int) -> list[Cell]:
    fields = Fields(data)
    depth = fields.take(1)[0]
    origin = (16 * fields.signed(), 16 * fields.signed(), 16 * fields.signed())
    coder = ArithmeticDecoder(data[fields.at :])
    direct = [State() for _ in range(368)]
    occupancy = Mixer(7, 16384, 400, 4)
    single = Mixer(5, 16384, 400, 4)
    offsets: list[Cell] = []
    if anchors == 1:
        offsets.append(single_anchor(coder, direct, (0, 0, 0), depth, [0, 0, 0]))
    waiting: list[tuple[Cell, int, int]] = [((0, 0, 0), 1, 0)] if anchors > 1 else []
    for step in range(depth):
        height = depth - 1 - step
        exists = {node: "waiting" for node, _, _ in waiting}
        state: dict[Cell, int] = {child(node, c): UNKNOWN for node, _, _ in waiting for c in range(8)}
        for v in offsets:
            exists[(v[0] >> height + 1, v[1] >> height + 1, v[2] >> height + 1)] = "single"
            state[(v[0] >> height, v[1] >> height, v[2] >> height)] = OCCUPIED
        following: list[tuple[Cell, int, int]] = []
        for node, parents_children, index in waiting:
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
        waiting = following
    assert len(offsets) == anchors
    used = fields.at + coder.end()
    assert len(data) == max(used, -(-anchors // 4)) and not any(data[used:])
    return [moved(origin, v) for v in canonical(offsets, depth)]


def canonical(offsets: list[Cell], depth: int) -> list[Cell]:
    codes = sorted((morton(v, depth), v) for v in offsets)
    levels = [0]
    for (before, _), (code, _) in pairwise(codes):
        highest = max(d for d in range(depth) if (before ^ code) >> 3 * d & 7)
        levels.append(depth - highest)
    return [v for _, _, v in sorted((level, code, v) for level, (code, v) in zip(levels, codes, strict=True))]


# ---- Masks


def masks(data: bytes, anchors: int, slots: int) -> list[list[int]]:
    if not data:
        return [[1] * slots for _ in range(anchors)]
    coder = ArithmeticDecoder(data)
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
    assert coder.end() == len(data) and any(0 in row for row in rows[2:])
    return rows[2:]


# ---- File


def decode(data: bytes) -> dict[str, Any]:
    """Everything with one row an anchor, in canonical order; residuals by slot, None where nothing exists."""
    assert data[:6] == b"\x93CGS\x01\x00"
    count = data[6]
    end = 7 + 9 * count
    assert zlib.crc32(data[:end]) == struct.unpack_from("<I", data, end)[0]
    sections = {}
    at = end + 4
    for i in range(count):
        number, length, crc = struct.unpack_from("<BII", data, 7 + 9 * i)
        sections[number] = data[at : at + length]
        assert zlib.crc32(sections[number]) == crc
        at += length
    assert at == len(data)
    n, p, k, fd, gd, zf, zg, _, _ = struct.unpack_from("<IIBHBBBBH", sections[1])
    gaussian = gaussian_tables()
    hyper = hyper_tables(sections[4], zf + zg, gaussian)
    sizes = [(zf, 2 * fd), (fd, 12), (zg + fd, 2 * k * gd)]
    reference_network, covariance_network, residual_network = entropy_networks(sections[5], sizes, gaussian)
    coordinates = positions(sections[2], n)
    mask = masks(sections[3], n, k)
    assert sum(map(sum, mask)) == p

    def rows(values: list[int], width: int) -> list[list[int]]:
        return [values[i : i + width] for i in range(0, len(values), width)]

    def conditional(
        number: int, network: list[dict], context: list[list[int]], width: int, slots: list[list[int]]
    ):
        means, tables = [], []
        for x, row in zip(context, slots, strict=True):
            y = evaluate(network, x)
            half = len(y) // 2
            for slot in (s for s, bit in enumerate(row) if bit):
                channels = range(slot * width, (slot + 1) * width)
                means += [y[c] for c in channels]
                tables += [gaussian[clamp((y[half + c] + 2048) >> 12, 0, 127)] for c in channels]
        symbols = stream(sections[number], tables)
        latents = [(q << 12) + m for q, m in zip(symbols, means, strict=True)]
        return rows(symbols, width), rows(latents, width)

    whole = [[1]] * n
    z_f = rows(stream(sections[7], hyper[:zf] * n), zf)
    q_f, f = conditional(8, reference_network, [[v << 12 for v in z] for z in z_f], fd, whole)
    q_c, c = conditional(9, covariance_network, f, 6, whole)
    z_g = rows(stream(sections[10], hyper[zf:] * n), zg)
    context = [[v << 12 for v in z] + row for z, row in zip(z_g, f, strict=True)]
    q_g, g = conditional(11, residual_network, context, gd, mask)
    by_slot = iter(q_g)
    return {
        "coordinates": [list(v) for v in coordinates],
        "mask": mask,
        "reference_hyper": z_f,
        "reference": q_f,
        "covariance": q_c,
        "residual_hyper": z_g,
        "residual": [[next(by_slot) if bit else [0] * gd for bit in row] for row in mask],
        "reference_latents": f,
        "covariance_latents": c,
        "residual_latents": g,
    }


if __name__ == "__main__":
    print(json.dumps(decode(Path(sys.argv[1]).read_bytes())))
