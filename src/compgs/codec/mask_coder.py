"""Lossless coding of masks: which of an anchor's K coupled primitives exist.

    payload = nothing, if all of them exist; otherwise one arithmetic code of N * K flags, anchor by anchor

Each flag is predicted from three contexts, mixed (binary_coder.py): how many slots of this anchor are set
already, which of the last eight are, and what the two previous anchors have in this slot. Encoder and decoder
are one function, so that their contexts cannot drift apart.
"""

import numpy as np
from numpy.typing import NDArray

from compgs.codec import binary_coder
from compgs.codec.binary_coder import (
    CODER_FIELDS,
    WEIGHT_ONE,
    Int,
    Mixer,
    finish_decoder,
    finish_encoder,
    is_exhausted,
    make_mixer,
    start_decoder,
    start_encoder,
)
from compgs.errors import CorruptSection, NotEncodable
from compgs.numerics.compiled import njit

__all__ = ["MAXIMUM_ANCHORS", "MAXIMUM_COUPLED", "decode_masks", "encode_masks"]

MAXIMUM_ANCHORS = 1 << 24
MAXIMUM_COUPLED = 64  # slots of an anchor

STATE_LIMIT = 1000  # decisions after which a context's probability slows down no further
MIXING_RATE = 2  # in 2**-16
INITIAL_WEIGHT = 3 * WEIGHT_ONE // 8

# Three inputs are mixed in less time than it takes to hand over the mixer's arrays: a call for each flag took twice as
# long. (The octree's seven inputs gain nothing from it, and compile for twice as long.)
_mixed_bit = njit(inline="always")(binary_coder.mixed_bit.py_func)


@njit(nogil=True)
def _walk(
    coder: NDArray[np.int64],
    data: NDArray[np.uint8],
    decoding: bool,
    mask: NDArray[np.uint8],  # [N, K] 0 or 1; out when decoding
    mixer: Mixer,
) -> bool:
    """Code all flags. False: the data cannot be those of N * K flags."""
    anchors, slots = mask.shape
    at = mixer.contexts
    before_count: Int = 0  # set slots of the previous anchor
    for i in range(anchors):
        if decoding and is_exhausted(coder, data):
            return False
        before = max(i - 1, 0)  # the first anchors look at rows that are not coded yet: read as 0
        earlier = max(i - 2, 0)
        taken: Int = 0
        recent: Int = 0
        for k in range(slots):
            one = np.int64(mask[before, k]) if i > 0 else 0
            two = np.int64(mask[earlier, k]) if i > 1 else 0
            at[0] = k * 65 + taken
            at[1] = 64 * 65 + k * 256 + recent
            at[2] = 64 * (65 + 256) + ((k * 2 + one) * 2 + two) * 65 + before_count
            bit = _mixed_bit(
                coder, data, mixer, k, 64 + 2 * one + two, k, STATE_LIMIT, MIXING_RATE, np.int64(mask[i, k])
            )
            mask[i, k] = bit
            taken += bit
            recent = (2 * recent + bit) & 255
        before_count = taken
    return True


def _code_flags(data: NDArray[np.uint8], mask: NDArray[np.uint8], decoding: bool) -> int:
    """Bytes of the arithmetic code; -1: not a valid one."""
    coder = np.zeros(CODER_FIELDS, np.int64)
    if decoding:
        start_decoder(coder, data)
    else:
        start_encoder(coder)
    mixer = make_mixer([64 * 65, 64 * 256, 64 * 4 * 65], 64 + 4, 64, INITIAL_WEIGHT)
    valid = _walk(coder, data, decoding, mask, mixer)
    if decoding:
        return int(finish_decoder(coder)) if valid else -1
    return int(finish_encoder(coder, data))


def encode_masks(mask: NDArray[np.bool_]) -> bytes:
    """[N, K] -> payload. Raises NotEncodable for more than 2**24 anchors or 64 slots."""
    assert mask.ndim == 2 and mask.dtype == np.bool_
    anchors, coupled = mask.shape
    if anchors > MAXIMUM_ANCHORS or coupled > MAXIMUM_COUPLED:
        raise NotEncodable(
            f"masks: {anchors} anchors with {coupled} coupled primitives each, "
            f"at most {MAXIMUM_ANCHORS} with {MAXIMUM_COUPLED} can be coded"
        )
    if mask.all():
        return b""
    flags = mask.astype(np.uint8)
    buffer = np.empty(mask.size // 4 + 64, np.uint8)
    length = _code_flags(buffer, flags, decoding=False)
    if length > len(buffer):  # only for flags that contradict everything learned
        buffer = np.empty(length, np.uint8)
        length = _code_flags(buffer, flags, decoding=False)
    return buffer[:length].tobytes()


def decode_masks(data: bytes, anchors: int, coupled: int) -> NDArray[np.bool_]:
    """Payload -> [anchors, coupled]. Inverse of `encode_masks`.

    Raises CorruptSection for anything that it would not have written. Takes time and memory in proportion to
    anchors * coupled, which the caller has bounded.
    """
    if not (0 <= anchors <= MAXIMUM_ANCHORS and 0 <= coupled <= MAXIMUM_COUPLED):
        raise CorruptSection(
            f"masks: {anchors} anchors with {coupled} coupled primitives each, "
            f"expected at most {MAXIMUM_ANCHORS} with {MAXIMUM_COUPLED}"
        )
    if not data:
        return np.ones((anchors, coupled), np.bool_)
    mask = np.zeros((anchors, coupled), np.uint8)
    body = np.frombuffer(data, np.uint8).copy()  # writable: the kernel has one type for both directions
    if _code_flags(body, mask, decoding=True) != len(data) or mask.all():
        raise CorruptSection(f"masks: the data are not {anchors} x {coupled} flags; the file is damaged")
    return mask.view(np.bool_)
