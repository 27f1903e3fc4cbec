"""Lossless coding of anchor positions (CompGS Sec. 3.4 uses G-PCC here): a context-mixed octree.

    payload = depth (1 byte), origin / 16 (three zigzag varints), arithmetic code, zeros up to N / 4 bytes

The octree is walked breadth first. For each node, the occupied ones among its eight children are coded, then
for each of these whether it holds a single anchor. A single anchor is coded bit by bit at once and leaves the
tree; it is remembered as a neighbour. All other nodes go on to the next level.

What a decision looks like is told by its neighbourhood: the 4x4x4 cells, at the scale of the children, around
a node. Each cell is empty, occupied, or unknown (its parent comes later in the walk). Two 64-bit masks hold
that: bit 16 x + 4 y + z, the node's own children being at 1 and 2 on every axis. Several contexts are made of
it, and mixed (binary_coder.py).

Nodes are Morton codes of their level (ordering/order.py): the children of node m are 8 m + c, c = 4 x + 2 y +
z. Encoder and decoder are one function, so that their contexts cannot drift apart.
"""

import os
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from compgs.codec.binary_coder import (
    CODER_FIELDS,
    WEIGHT_ONE,
    Int,
    Mixer,
    adaptive_bit,
    code_bit,
    finish_decoder,
    finish_encoder,
    is_exhausted,
    make_mixer,
    make_states,
    mixed_bit,
    start_decoder,
    start_encoder,
)
from compgs.codec.fields import FieldReader, signed_varint
from compgs.errors import CorruptSection, NotEncodable
from compgs.numerics.compiled import njit
from compgs.ordering.order import (
    ALIGNMENT_BITS,
    MAXIMUM_DEPTH,
    inv_morton_codes,
    morton_levels,
    octree_depth,
    octree_origin,
    sorted_morton,
)

__all__ = ["ANCHORS_PER_BYTE", "MAXIMUM_ANCHORS", "decode_positions", "encode_positions"]

MAXIMUM_ANCHORS = 1 << 24
ANCHORS_PER_BYTE = (
    4  # at most: the encoder pads with zeros, so that a decoder can bound its work by the file's size
)

STATE_LIMIT = 400  # decisions after which a context's probability slows down no further
DIRECT_LIMIT = 1000  # the same for the bits of single anchors, which hardly change
MIXING_RATE = 4  # in 2**-16; decides whether mixing wins: twice or half of it costs 0.05 %
INITIAL_WEIGHT = WEIGHT_ONE // 4
LATTICE_BITS = 4  # low bits per axis of a single anchor that are modelled as "on a coarser grid"

# ---- geometry of the neighbourhood, as constants. Neighbour 9 (dx + 1) + 3 (dy + 1) + dz + 1; 13: the node.

_STEPS = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
_AXIS_STEPS = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]


def _cell(x: int, y: int, z: int) -> int:
    return 16 * x + 4 * y + z


def _spread_table() -> NDArray[np.uint64]:
    """[27, 256] which of the 4x4x4 cells the children of neighbour j take, by its occupancy."""
    occupancy = np.arange(256)
    spread = np.zeros((27, 256), np.uint64)
    for j, (dx, dy, dz) in enumerate(_STEPS):
        for c in range(8):
            place = (2 * dx + (c >> 2) + 1, 2 * dy + ((c >> 1) & 1) + 1, 2 * dz + (c & 1) + 1)
            if min(place) >= 0 and max(place) < 4:
                spread[j] |= np.where((occupancy >> c) & 1, np.uint64(1 << _cell(*place)), np.uint64(0))
    return spread


def _child_tables() -> tuple[NDArray[np.uint64], NDArray[np.int64], NDArray[np.int64]]:
    """Make the tables of child c: [8] its 26 surrounding cells; [8, 6] the cells at its faces, -x +x -y +y -z +z;
    [8, 7] the neighbours of the node that touch it: 3 at faces, 3 at edges (xy, xz, yz), 1 at a corner.
    """
    around, faces, touch = np.zeros(8, np.uint64), np.zeros((8, 6), np.int64), np.zeros((8, 7), np.int64)
    for c in range(8):
        x, y, z = 1 + (c >> 2), 1 + ((c >> 1) & 1), 1 + (c & 1)
        around[c] = sum(
            1 << _cell(x + dx, y + dy, z + dz) for dx, dy, dz in _STEPS if (dx, dy, dz) != (0, 0, 0)
        )
        faces[c] = [_cell(x + dx, y + dy, z + dz) for dx, dy, dz in _AXIS_STEPS]
        sx, sy, sz = 9 * (2 * x - 3), 3 * (2 * y - 3), 2 * z - 3
        touch[c] = [13 + s for s in (sx, sy, sz, sx + sy, sx + sz, sy + sz, sx + sy + sz)]
    return around, faces, touch


def _where_table() -> NDArray[np.int64]:
    """[8, 27] where neighbour j of a node that is child c of its parent is found: 8 b + place in its block, where the
    bits of b (x, y, z) say on which axes that is another block than the node's own.
    """
    where = np.zeros((8, 27), np.int64)
    for c in range(8):
        for j, (dx, dy, dz) in enumerate(_STEPS):
            x, y, z = (c >> 2) + dx, ((c >> 1) & 1) + dy, (c & 1) + dz  # -1 and 2 lie in another block
            block = (4 if x & 2 else 0) | (2 if y & 2 else 0) | (1 if z & 2 else 0)
            where[c, j] = 8 * block + (((x & 1) << 2) | ((y & 1) << 1) | (z & 1))
    return where


_SPREAD = _spread_table()
_AROUND, _FACES, _TOUCH = _child_tables()
_WHERE = _where_table()

# Dilated integers: the bits of one axis in a Morton code, x first, and a step of one along it.
_AXIS_BITS = np.array([0x4924924924924924, 0x2492492492492492, 0x1249249249249249], np.int64)
_AXIS_ONE = np.array([4, 2, 1], np.int64)


@njit
def _moved(code: Int, axis: Int, forward: bool) -> Int:
    """Morton code one step along an axis. Below 0 it wraps to 2**21 - 1, where no block can be."""
    mask = _AXIS_BITS[axis]
    along = code & mask
    along = ((along | ~mask) + _AXIS_ONE[axis]) & mask if forward else (along - _AXIS_ONE[axis]) & mask
    return (code & ~mask) | along


@njit
def _ones(v: np.uint64) -> Int:
    """Number of set bits."""
    v = v - ((v >> np.uint64(1)) & np.uint64(0x5555555555555555))
    v = (v & np.uint64(0x3333333333333333)) + ((v >> np.uint64(2)) & np.uint64(0x3333333333333333))
    v = (v + (v >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((v * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit
def _cell_state(filled: np.uint64, unknown: np.uint64, cell: Int) -> Int:
    """0 empty, 1 occupied, 2 unknown."""
    at = np.uint64(cell)
    return np.int64(((filled >> at) & np.uint64(1)) | (((unknown >> at) & np.uint64(1)) << np.uint64(1)))


# ---- the nodes of one level, found by place

# What is at a place: 0 no node; otherwise a kind, with the occupancy of its children where that is known.
_WAITING_BIT = 10
_SINGLE, _CODED, _WAITING = 256, 512, 1 << _WAITING_BIT


class Level(NamedTuple):
    """Nodes of the level that is being walked, in blocks of the eight children of one parent. Block 0 is empty: it
    stands for those that do not exist, so that nobody has to ask.
    """

    salt: np.uint64  # odd, different at each call: no file can be made that fills the hash table badly
    slots: NDArray[np.int32]  # [S] open-addressed hash table: block, 0 free; S is a power of two, S >= 2 N
    parents: NDArray[np.int64]  # [N + 1] Morton code of each block's parent
    places: NDArray[np.int16]  # [8 (N + 1)] what is where: place = 8 * block + child index


@njit
def _slot(level: Level, mask: Int, parent: Int) -> Int:
    """The slot that holds a parent's block, or the free one where it would be."""
    mixed = np.uint64(parent) * level.salt
    mixed = (mixed ^ (mixed >> np.uint64(32))) * level.salt
    i = np.int64(mixed >> np.uint64(33)) & mask
    while level.slots[i] != 0 and level.parents[level.slots[i]] != parent:
        i = (i + 1) & mask
    return i


@njit
def _place(level: Level, mask: Int, blocks: Int, node: Int) -> Int:
    """Place of a node, in a new block behind the `blocks` that there are if its parent has none yet."""
    i = _slot(level, mask, node >> 3)
    if level.slots[i] == 0:
        level.slots[i] = blocks + 1
        level.parents[blocks + 1] = node >> 3
        level.places[8 * blocks + 8 : 8 * blocks + 16] = 0
    return 8 * np.int64(level.slots[i]) + (node & 7)


@njit
def _start_level(
    level: Level,
    nodes: NDArray[np.int64],  # [waiting] nodes to walk
    place: NDArray[np.int32],  # [waiting] out: their places
    singles: NDArray[np.int64],  # [S] Morton codes of the single anchors so far
    height: Int,
) -> Int:
    """Enter all nodes of a level into the table. Returns the mask of the part of the table that is in use."""
    slots = 16
    while slots < 2 * (len(nodes) + len(singles)):
        slots *= 2
    level.slots[:slots] = 0
    level.places[:8] = 0
    blocks: Int = 0
    for i in range(len(nodes)):
        place[i] = _place(level, slots - 1, blocks, nodes[i])
        blocks = max(blocks, place[i] >> 3)
        level.places[place[i]] = _WAITING
    for i in range(len(singles)):
        child = singles[i] >> (3 * height)
        at = _place(level, slots - 1, blocks, child >> 3)
        blocks = max(blocks, at >> 3)
        level.places[at] = _SINGLE | (1 << (child & 7))
    return slots - 1


@njit
def _look_around(
    level: Level,
    mask: Int,
    node: Int,
    blocks: NDArray[np.int64],  # [8] scratch
) -> tuple[np.uint64, np.uint64, Int, Int]:
    """Occupied cells, unknown cells, which neighbours there are (bit j), and which of them are not single anchors."""
    # The 26 neighbours lie in eight blocks on the node's side of its parent; b: on which axes they differ.
    for b in range(8):
        parent = node >> 3
        for axis in range(3):
            if (b >> (2 - axis)) & 1:
                parent = _moved(parent, axis, (node >> (2 - axis)) & 1 == 1)
        blocks[b] = 8 * np.int64(level.slots[_slot(level, mask, parent)])
    filled = np.uint64(0)
    unknown = np.uint64(0)
    near: Int = 0
    crowded: Int = 0
    # Without a branch: what is next to a node cannot be foretold, and each wrong guess would cost as much as all this.
    for j in range(27):
        where = _WHERE[node & 7, j]
        what = np.int64(level.places[blocks[where >> 3] + (where & 7)])
        filled |= _SPREAD[j, what & 255]
        unknown |= _SPREAD[j, 255 * ((what >> _WAITING_BIT) & 1)]
        near |= np.int64(what != 0) << j
        crowded |= np.int64(what >= _CODED) << j
    others = ~(1 << 13)  # the node is no neighbour of itself
    return filled, unknown, near & others, crowded & others


# ---- single anchors


@njit
def _code_single(
    coder: NDArray[np.int64],
    data: NDArray[np.uint8],
    states: NDArray[np.uint32],  # [368]
    code: Int,  # Morton code; when decoding, only what lies above the low bits counts
    bits: Int,
    sides: NDArray[np.int64],  # [3] states of the two cells beside the anchor on each axis, 0..8
) -> Int:
    """The `bits` low bits per axis of an anchor that is alone in its node. Returns its Morton code.

    The upper bits hardly compress; the first two lean away from empty sides. The LATTICE_BITS low ones tell
    whether the anchor lies on a coarser grid, as grown anchors do: bits 1 and 0 of all axes come first, then
    3 and 2, each with the knowledge whether all were zero so far.
    """
    known = (code >> (3 * bits)) << (3 * bits)
    for b in range(bits - 1, LATTICE_BITS - 1, -1):
        for axis in range(3):
            at = 3 * b + 2 - axis
            bit = (code >> at) & 1
            if b == bits - 1:
                bit = adaptive_bit(coder, data, states, 3 * sides[axis] + axis, DIRECT_LIMIT, bit)
            elif b == bits - 2:
                context = 27 + 3 * (2 * sides[axis] + ((known >> (at + 3)) & 1)) + axis
                bit = adaptive_bit(coder, data, states, context, DIRECT_LIMIT, bit)
            else:
                bit = code_bit(coder, data, 1 << 15, bit)
            known |= bit << at
    low = min(bits, LATTICE_BITS)
    zeros: Int = 1  # all bits so far were zero
    coarse: Int = 0  # ... at the end of the first half
    for half in range(2):
        for axis in range(3):
            for b in range(min(low, 2 * half + 2) - 1, 2 * half - 1, -1):
                at = 3 * b + 2 - axis
                bit = (code >> at) & 1
                context = ((((half * 3 + axis) * 2 + (b & 1)) * 2 + zeros) * 2 + coarse) * 5 + low
                bit = adaptive_bit(coder, data, states, 128 + context, DIRECT_LIMIT, bit)
                zeros &= 1 - bit
                known |= bit << at
        coarse = zeros
    return known


# ---- the walk

CODED, WRONG_COUNT, TOO_MANY_NODES = 0, -1, -2  # what `_walk` returns; lengths of codes are positive
# Number of contexts of each mixed input; `_walk` says what they are made of. 21 levels, 8 children.
_OCCUPANCY_SIZES = [8 * 4 * 256, 729 * 8 * 5, 128 * 8 * 5, 13 * 20 * 5, 21 * 8 * 8 * 8, 64 * 256, 256 * 8 * 8]
_SINGLE_SIZES = [21 * 8 * 8, 13 * 20 * 4, 27 * 27 * 4, 256 * 8, 27 * 13 * 8]
_OCCUPANCY_BASE = np.cumsum([0, *_OCCUPANCY_SIZES[:-1]])
_SINGLE_BASE = np.cumsum([0, *_SINGLE_SIZES[:-1]])
_SECOND_SETS = 21 * 8  # where the second kind of weight sets begins


class Models(NamedTuple):
    """What the coder learns while it walks."""

    occupancy: Mixer
    single: Mixer
    direct: NDArray[np.uint32]


class Frontier(NamedTuple):
    """The nodes of one level that hold two anchors or more, in Morton order. [N / 2] each."""

    node: NDArray[np.int64]  # Morton code
    first: NDArray[np.int32]  # its first anchor in Morton order; only when encoding
    family: NDArray[np.int16]  # occupancy of its parent's children | own child index << 8


@njit(nogil=True)
def _walk(
    coder: NDArray[np.int64],
    data: NDArray[np.uint8],
    decoding: bool,
    codes: NDArray[np.int64],  # [N] ascending Morton codes; [0] when decoding
    found: NDArray[np.int64],  # [N] out: Morton codes in the order in which the anchors were found alone
    depth: int,
    models: Models,
    level: Level,
    frontier: Frontier,
    next_frontier: Frontier,
    place: NDArray[np.int32],  # [N / 2] scratch: places of the frontier's nodes
    most_nodes: int,
) -> Int:
    """Code the tree. Returns CODED, or what is wrong."""
    count = len(found)
    sides = np.zeros(3, np.int64)
    if count == 1:
        found[0] = _code_single(coder, data, models.direct, 0 if decoding else codes[0], depth, sides)
        return CODED
    blocks = np.zeros(8, np.int64)
    children_first = np.zeros(9, np.int64)
    occupancy, single = models.occupancy, models.single
    input, output = frontier, next_frontier
    input.node[0], input.first[0], input.family[0] = 0, 0, 1
    waiting = 1
    done = 0
    nodes: Int = 0
    for step in range(depth):
        nodes += waiting
        if nodes > most_nodes:
            return TOO_MANY_NODES
        height = depth - 1 - step  # bits per axis below the children
        scale = min(height, 7)
        least = 2 if height == 0 else 1  # children of a node that holds two anchors or more
        mask = _start_level(level, input.node[:waiting], place, found[:done], height)
        new = 0
        for i in range(waiting):
            node = input.node[i]
            if decoding:
                if is_exhausted(coder, data):
                    return WRONG_COUNT
            else:
                child_first = np.int64(input.first[i])
                for c in range(8):
                    children_first[c] = child_first
                    while child_first < count and codes[child_first] >> (3 * height) == 8 * node + c:
                        child_first += 1
                children_first[8] = child_first
            filled, unknown, near, crowded = _look_around(level, mask, node, blocks)
            neighbours, crowds = _ones(np.uint64(near)), _ones(np.uint64(crowded))
            faces = (near >> 4 & 1) | (near >> 22 & 1) << 1 | (near >> 10 & 1) << 2
            faces |= (near >> 16 & 1) << 3 | (near >> 12 & 1) << 4 | (near >> 14 & 1) << 5
            parents_children = np.int64(input.family[i]) & 255
            index = np.int64(input.family[i]) >> 8
            siblings = _ones(np.uint64(parents_children)) - 1
            # Whether the node's corner lies on the 16- and on the 4-voxel grid, where that can differ.
            grid = 1 if height < 3 and node & ((1 << (9 - 3 * height)) - 1) == 0 else 0
            grid |= 2 if height < 1 and node & 7 == 0 else 0
            scale_grid = 4 * scale + grid

            # Which children are occupied.
            children = 0
            taken = 0
            for c in range(8):
                bit: Int = 0
                if not decoding and children_first[c + 1] > children_first[c]:
                    bit = 1
                if taken + 8 - c <= least:
                    bit = 1  # it must be
                else:
                    prefix = (1 << c) | children
                    few = min(taken, 4)
                    occupied = min(_ones(filled & _AROUND[c]), 12)
                    open_ = min(_ones(unknown & _AROUND[c]), 19)
                    sides_state: Int = 0
                    for k in range(6):
                        sides_state = 3 * sides_state + _cell_state(filled, unknown, _FACES[c, k])
                    touching: Int = 0
                    for k in range(7):
                        touching |= (near >> _TOUCH[c, k] & 1) << k
                    at = occupancy.contexts
                    at[0] = _OCCUPANCY_BASE[0] + 256 * scale_grid + prefix
                    at[1] = _OCCUPANCY_BASE[1] + (8 * sides_state + c) * 5 + few
                    at[2] = _OCCUPANCY_BASE[2] + (8 * touching + c) * 5 + few
                    at[3] = _OCCUPANCY_BASE[3] + (20 * occupied + open_) * 5 + few
                    at[4] = _OCCUPANCY_BASE[4] + ((8 * step + siblings) * 8 + c) * 8 + taken
                    at[5] = _OCCUPANCY_BASE[5] + 256 * faces + prefix
                    at[6] = _OCCUPANCY_BASE[6] + (8 * parents_children + index) * 8 + c
                    first_set, second_set = 8 * step + c, _SECOND_SETS + 5 * occupied + few
                    refine = 8 * scale_grid + c
                    bit = mixed_bit(
                        coder, data, occupancy, first_set, second_set, refine, STATE_LIMIT, MIXING_RATE, bit
                    )
                own = _SPREAD[13, 1 << c]
                unknown &= ~own
                if bit:
                    filled |= own
                    children |= 1 << c
                    taken += 1
            level.places[place[i]] = _CODED | children

            # Which of them hold a single anchor.
            seen = 0
            shared = 0
            for c in range(8):
                if (children >> c) & 1 == 0:
                    continue
                child = 8 * node + c
                seen += 1
                alone: Int = 1
                if height > 0 and taken == 1:
                    alone = 0  # it holds all anchors of the node
                elif height > 0:
                    alone = 0 if decoding else np.int64(children_first[c + 1] - children_first[c] == 1)
                    occupied = min(_ones(filled & _AROUND[c]), 12)
                    open_ = min(_ones(unknown & _AROUND[c]), 19)
                    crowd = min(shared, 3)
                    at = single.contexts
                    at[0] = _SINGLE_BASE[0] + (8 * step + taken - 1) * 8 + 2 * crowd + np.int64(seen == taken)
                    at[1] = _SINGLE_BASE[1] + (20 * occupied + open_) * 4 + min(taken, 3)
                    at[2] = _SINGLE_BASE[2] + (27 * neighbours + crowds) * 4 + min(taken, 3)
                    at[3] = _SINGLE_BASE[3] + 8 * children + c
                    at[4] = _SINGLE_BASE[4] + (13 * crowds + occupied) * 8 + taken - 1
                    first_set, second_set = 8 * step + taken - 1, _SECOND_SETS + 20 * occupied + open_
                    alone = mixed_bit(
                        coder,
                        data,
                        single,
                        first_set,
                        second_set,
                        4 * step + crowd,
                        STATE_LIMIT,
                        MIXING_RATE,
                        alone,
                    )
                # Nodes that wait hold two anchors or more each; this bounds every array.
                left = count - done - 2 * (new + waiting - 1 - i)
                if left < (1 if alone else 2):
                    return WRONG_COUNT
                if alone:
                    anchor = child << (3 * height) if decoding else codes[children_first[c]]
                    for axis in range(3):
                        side = 3 * _cell_state(filled, unknown, _FACES[c, 2 * axis])
                        sides[axis] = side + _cell_state(filled, unknown, _FACES[c, 2 * axis + 1])
                    found[done] = _code_single(coder, data, models.direct, anchor, height, sides)
                    done += 1
                else:
                    output.node[new] = child
                    output.family[new] = children | (c << 8)
                    if not decoding:
                        output.first[new] = children_first[c]
                    new += 1
                    shared += 1
        input, output = output, input
        waiting = new
    return CODED if done == count else WRONG_COUNT


def _code_tree(
    data: NDArray[np.uint8], codes: NDArray[np.int64], count: int, depth: int, decoding: bool, most_nodes: int
) -> tuple[Int, NDArray[np.int64]]:
    """Bytes of the arithmetic code (negative: what is wrong) and the N Morton codes, in the order of the walk.

    Needs about 70 bytes an anchor, of which a decoder touches only what the data fill.
    """
    coder = np.zeros(CODER_FIELDS, np.int64)
    if decoding:
        start_decoder(coder, data)
    else:
        start_encoder(coder)
    half = count // 2 + 1
    models = Models(
        make_mixer(_OCCUPANCY_SIZES, _SECOND_SETS + 13 * 5, 8 * 4 * 8, INITIAL_WEIGHT),
        make_mixer(_SINGLE_SIZES, _SECOND_SETS + 13 * 20, 21 * 4, INITIAL_WEIGHT),
        make_states(128 + 240),
    )
    level = Level(
        salt=np.uint64(int.from_bytes(os.urandom(8), "little") | 1),
        slots=np.empty(max(16, 1 << (2 * count - 1).bit_length()), np.int32),
        parents=np.empty(count + 1, np.int64),
        places=np.empty(8 * count + 8, np.int16),
    )
    frontiers = [
        Frontier(np.empty(half, np.int64), np.empty(half, np.int32), np.empty(half, np.int16)) for _ in "ab"
    ]
    found = np.empty(count, np.int64)
    place = np.empty(half, np.int32)
    outcome = _walk(
        coder,
        data,
        decoding,
        codes,
        found,
        depth,
        models,
        level,
        frontiers[0],
        frontiers[1],
        place,
        most_nodes,
    )
    if decoding:
        return (finish_decoder(coder) if outcome == CODED else outcome), found
    assert outcome == CODED, "an octree of sorted, distinct codes is always valid"
    return finish_encoder(coder, data), found


# ---- the payload


def encode_positions(coordinates: NDArray[np.int32]) -> bytes:
    """[N, 3] voxel coordinates, in any order -> payload; the same bytes for every order. N = 0 takes none.

    Raises NotEncodable for duplicates, for more than 2**24 anchors and for more than 21 bits on an axis.
    """
    assert coordinates.ndim == 2 and coordinates.shape[1] == 3 and coordinates.dtype.kind == "i"
    count = len(coordinates)
    if count == 0:
        return b""
    if count > MAXIMUM_ANCHORS:
        raise NotEncodable(f"anchor positions: {count} anchors, at most {MAXIMUM_ANCHORS} can be coded")
    origin, codes, _ = sorted_morton(coordinates)
    depth = octree_depth(coordinates.astype(np.int64) - origin)
    buffer = np.empty(10 * count + 64, np.uint8)
    any_nodes = count * depth
    length, _ = _code_tree(buffer, codes, count, depth, False, any_nodes)
    if length > len(buffer):  # never seen; the worst case is far above the usual
        buffer = np.empty(length, np.uint8)
        length, _ = _code_tree(buffer, codes, count, depth, False, any_nodes)
    header = bytes([depth]) + b"".join(signed_varint(int(v) >> ALIGNMENT_BITS) for v in origin)
    payload = header + buffer[:length].tobytes()
    return payload.ljust(_least_bytes(count), b"\0")


def decode_positions(data: bytes, count: int, most_nodes: int | None = None) -> NDArray[np.int32]:
    """Payload of `count` anchors -> [N, 3] voxel coordinates, in canonical order (ordering/order.py).

    Inverse of `encode_positions`. Raises CorruptSection for anything that it would not have written, as far
    as that can be told, and for a walk along more than `most_nodes` nodes. Takes memory in proportion to `count`, which
    the length of the data bounds, and time in proportion to `count` and the nodes; without `most_nodes` these may be
    ten times `count`.
    """
    if not 0 <= count <= MAXIMUM_ANCHORS:
        raise CorruptSection(f"anchor positions: {count} anchors, expected 0 to {MAXIMUM_ANCHORS}")
    if len(data) < _least_bytes(count) or (count == 0 and data):
        raise CorruptSection(
            f"anchor positions: {len(data)} bytes for {count} anchors, expected "
            + (f"at least {_least_bytes(count)}" if count else "none")
        )
    if count == 0:
        return np.zeros((0, 3), np.int32)
    depth, origin, start = _read_header(data)
    if count > 8**depth:
        raise CorruptSection(f"anchor positions: {count} anchors in an octree of {depth} levels")
    body = np.frombuffer(
        data, np.uint8, offset=start
    ).copy()  # writable: the kernel has one type for both ways
    most_nodes = count * depth if most_nodes is None else most_nodes
    length, codes = _code_tree(body, np.empty(0, np.int64), count, depth, True, most_nodes)
    if length == TOO_MANY_NODES:
        raise CorruptSection(
            f"anchor positions: more than {most_nodes} nodes of the octree, the most for this file"
        )
    padded = len(data) == _least_bytes(count) and not body[max(length, 0) :].any()
    if length < 0 or length > len(body) or (length < len(body) and not padded):
        raise CorruptSection(
            f"anchor positions: the data are not those of {count} anchors; the file is damaged"
        )
    codes.sort(kind="stable")  # ascending runs: that they are is seen by this sort alone
    offsets = inv_morton_codes(codes[np.argsort(morton_levels(codes, depth), kind="stable")])
    coordinates = offsets + origin
    if octree_origin(offsets).any() or octree_depth(offsets) != depth:
        raise CorruptSection("anchor positions: the octree is larger than its anchors; the file is damaged")
    if coordinates.max() > np.iinfo(np.int32).max:
        raise CorruptSection("anchor positions: coordinates beyond 32 bits; the file is damaged")
    return coordinates.astype(np.int32)


def _least_bytes(count: int) -> int:
    return -(-count // ANCHORS_PER_BYTE)


def _read_header(data: bytes) -> tuple[int, NDArray[np.int64], int]:
    """Depth, origin [3] and the place after them."""
    reader = FieldReader(data, "anchor positions")
    (depth,) = reader.bytes(1, "depth")
    if depth > MAXIMUM_DEPTH:
        raise CorruptSection(f"anchor positions: octree of {depth} levels, at most {MAXIMUM_DEPTH} exist")
    limit = 1 << 27  # 28 bits with the sign
    origin = [reader.signed_varint(f"origin of axis {axis}", -limit, limit - 1) for axis in "xyz"]
    return depth, np.array(origin, np.int64) << ALIGNMENT_BITS, reader.position
