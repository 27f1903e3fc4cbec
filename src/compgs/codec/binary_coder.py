"""Adaptive binary arithmetic coding with logistic mixing, in integers only.

Three layers, each usable alone, each with one function that serves both directions, so that the encoder's and
the decoder's models cannot drift apart:

    code_bit       one binary decision with a given probability  <->  bytes
    adaptive_bit   ... with a probability that a context has learned
    mixed_bit      ... with several contexts' probabilities, mixed in the logistic domain by learned weights

`bit` is what to encode; it is ignored when decoding. The decision is returned in both directions.

Conventions: all arithmetic is on 64-bit two's complement integers; `>>` is arithmetic and rounds towards
minus infinity. Nothing overflows. `p1` is the probability of a 1 in units of 2**-16. Logits are natural, in
units of 1/256.

The interval coder keeps `low <= code <= high`, 48 bits each, inclusive, without carries: bytes on which low
and high agree are settled and leave at the top. 48 bits rather than the usual 32, so that an interval that
straddles a byte boundary for long costs nothing measurable.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from compgs.numerics.compiled import njit

Int = int | np.int64  # of a numba kernel: always 64 bits

LOGIT_LIMIT = 2047  # logits are clamped to +-LOGIT_LIMIT / 256, about +-8
MINIMUM_P1 = 20  # p1 of a mixed decision stays within [MINIMUM_P1, 65536 - MINIMUM_P1]: at least 4.4e-4 bits
COUNT_BITS = 10  # of an adaptive state: how often its context was seen
EVEN_STATE = 1 << 31  # probability 1/2, never seen
WEIGHT_ONE = 1 << 16  # a mixing weight of 1.0

_EXP_MINUS_1_256 = 18374827034086858296  # floor(2**64 * exp(-1 / 256))


def _squash_table() -> NDArray[np.int32]:
    """[4096] p1 = 65536 / (1 + exp(-x / 256)) at logit x = i - 2048, by an integer recurrence.

    E_0 = 2**64, E_{k+1} = floor(E_k * C / 2**64) with C = floor(2**64 * exp(-1/256)); for x <= 0,
    p1 = floor((65536 * E_|x| + (2**64 + E_|x|) // 2) / (2**64 + E_|x|)); for x > 0, 65536 - p1(-x).
    """
    one = 1 << 64
    power, below = one, []
    for _ in range(2049):
        below.append((65536 * power + (one + power) // 2) // (one + power))
        power = power * _EXP_MINUS_1_256 >> 64
    return np.array([below[-x] if x <= 0 else 65536 - below[x] for x in range(-2048, 2048)], np.uint16)


# 16 bits an entry: the four tables share the 32 KiB nearest to a processor with what the contexts have learned.
SQUASH = _squash_table()  # [4096] logit + 2048 -> p1
# [4096] p1 >> 4 -> logit: how many entries of SQUASH lie below the middle of the sixteen p1, minus 2048.
STRETCH = np.clip(np.searchsorted(SQUASH, 16 * np.arange(4096) + 8) - 2048, -LOGIT_LIMIT, LOGIT_LIMIT).astype(
    np.int16
)
# [1024] how far (in 2**-16) a probability moves towards its n-th decision: floor(65536 / (n + 1.6)).
RATE = np.array([655360 // (10 * n + 16) for n in range(1024)], np.uint16)
# [1024] weight (in 2**-8) of the logit of a context that was seen n times: a new context knows nothing.
CONFIDENCE = np.array([256 * n // (n + 3) for n in range(1024)], np.int16)

CODER_FIELDS = 5
LOW, HIGH, CODE, POSITION, DECODING = range(CODER_FIELDS)
_MASK48 = (1 << 48) - 1
LOOKAHEAD = 6  # bytes that the decoder holds in CODE


class Mixer(NamedTuple):
    """Contexts whose predictions are mixed. The caller fills `contexts` before each decision."""

    states: NDArray[np.uint32]  # [S] adaptive states of all inputs, one input after the other
    weights: NDArray[np.int64]  # [sets, inputs + 1] in 2**-16; the last one is a bias
    refinement: NDArray[np.int32]  # [R, 33] p1 by refinement context and mixed logit
    contexts: NDArray[np.int64]  # [inputs] scratch: index into `states` of each input's context
    logits: NDArray[np.int64]  # [inputs + 1] scratch


def make_mixer(sizes: list[int], weight_sets: int, refinements: int, initial_weight: int) -> Mixer:
    """A mixer that knows nothing yet. sizes: number of contexts of each input; initial_weight in 2**-16."""
    weights = np.full((weight_sets, len(sizes) + 1), initial_weight, np.int64)
    weights[:, -1] = 0
    curve = SQUASH[np.minimum(np.arange(33) * 128, 4095)].astype(np.int32)
    return Mixer(
        states=make_states(sum(sizes)),
        weights=weights,
        refinement=np.tile(curve, (refinements, 1)),
        contexts=np.zeros(len(sizes), np.int64),
        logits=np.zeros(len(sizes) + 1, np.int64),
    )


def make_states(count: int) -> NDArray[np.uint32]:
    """[count] adaptive states that know nothing yet: probability in 22 bits, then COUNT_BITS of count."""
    return np.full(count, EVEN_STATE, np.uint32)


@njit
def start_encoder(coder: NDArray[np.int64]) -> None:
    """coder: [5] int64."""
    coder[LOW] = 0
    coder[HIGH] = _MASK48
    coder[CODE] = 0
    coder[POSITION] = 0
    coder[DECODING] = 0


@njit
def start_decoder(coder: NDArray[np.int64], data: NDArray[np.uint8]) -> None:
    """Bytes beyond the end of the data read as 0."""
    start_encoder(coder)
    coder[DECODING] = 1
    for i in range(LOOKAHEAD):
        coder[CODE] = (coder[CODE] << 8) | (np.int64(data[i]) if i < len(data) else 0)
    coder[POSITION] = LOOKAHEAD


@njit
def finish_encoder(coder: NDArray[np.int64], data: NDArray[np.uint8]) -> Int:
    """Number of bytes that the code takes; more than `len(data)`: the buffer was too short, encode again.

    One byte settles the interval: low and high differ in their top byte, so low's top byte plus one, followed
    by zeros, is within. The zeros are not written.
    """
    position = coder[POSITION]
    if position < len(data):
        data[position] = np.uint8((coder[LOW] >> 40) + 1)
    return position + 1


@njit
def finish_decoder(coder: NDArray[np.int64]) -> Int:
    """Number of bytes that the code took; -1 if it does not end as `finish_encoder` ends it."""
    if coder[CODE] != ((coder[LOW] >> 40) + 1) << 40:
        return -1
    return coder[POSITION] - LOOKAHEAD + 1


@njit
def is_exhausted(coder: NDArray[np.int64], data: NDArray[np.uint8]) -> bool:
    """Whether the decoder has read further than any valid code of this length would."""
    return coder[POSITION] > len(data) + LOOKAHEAD


@njit
def code_bit(coder: NDArray[np.int64], data: NDArray[np.uint8], p1: Int, bit: Int) -> Int:
    """One decision. 0 < p1 < 65536. Writes beyond the end of `data` are counted and dropped."""
    low = coder[LOW]
    high = coder[HIGH]
    split = low + ((high - low) >> 16) * p1  # low <= split < high: ones take [low, split]
    decoding = coder[DECODING]
    if decoding:
        bit = 1 if coder[CODE] <= split else 0
    if bit:
        high = split
    else:
        low = split + 1
    while ((low ^ high) >> 40) == 0:
        position = coder[POSITION]
        if decoding:
            coder[CODE] = ((coder[CODE] << 8) & _MASK48) | (
                np.int64(data[position]) if position < len(data) else 0
            )
        elif position < len(data):
            data[position] = np.uint8(high >> 40)
        coder[POSITION] = position + 1
        low = (low << 8) & _MASK48
        high = ((high << 8) & _MASK48) | 255
    coder[LOW] = low
    coder[HIGH] = high
    return bit


@njit
def learn(states: NDArray[np.uint32], index: Int, bit: Int, limit: Int) -> None:
    """Move a state towards a decision, by RATE at first and by RATE[limit] in the end."""
    at = np.uint64(index)
    state = np.int64(states[at])
    count = state & 1023
    p = state >> COUNT_BITS
    p += (((bit << 22) - p) * np.int64(RATE[np.uint64(count)])) >> 16
    states[at] = np.uint32((p << COUNT_BITS) | (count + (1 if count < limit else 0)))


@njit
def adaptive_bit(
    coder: NDArray[np.int64],
    data: NDArray[np.uint8],
    states: NDArray[np.uint32],
    index: Int,
    limit: Int,
    bit: Int,
) -> Int:
    """One decision with the probability that state `index` has learned. limit: at most 1023."""
    p1 = min(max(np.int64(states[index] >> 16), np.int64(MINIMUM_P1)), np.int64(65536 - MINIMUM_P1))
    bit = code_bit(coder, data, p1, bit)
    learn(states, index, bit, limit)
    return bit


@njit(inline="always")
def _squashed(logit: Int) -> Int:
    return np.int64(SQUASH[np.uint64(logit + 2048)])


@njit(no_alias=True)
def mixed_bit(
    coder: NDArray[np.int64],
    data: NDArray[np.uint8],
    mixer: Mixer,
    first: Int,
    second: Int,
    refine: Int,
    limit: Int,
    rate: Int,
    bit: Int,
) -> Int:
    """One decision with the mixture of the contexts' probabilities.

    Weight sets `first` and `second` each predict; their logits are averaged, and the result is averaged with
    what the refinement context `refine` has learned about decisions that looked like this. limit: of the
    states' counts, at most 1023; rate: of the weights, in 2**-16.
    """
    inputs = len(mixer.contexts)
    states, contexts, logits = mixer.states, mixer.contexts, mixer.logits
    weights1, weights2 = mixer.weights[first], mixer.weights[second]
    refinement = mixer.refinement[refine]
    sum1 = weights1[inputs] << 8
    sum2 = weights2[inputs] << 8
    for i in range(inputs):
        k = np.uint64(i)  # an index that may be negative is asked about its sign each time
        state = np.int64(states[np.uint64(contexts[k])])
        logit = (
            np.int64(STRETCH[np.uint64(state >> 20)]) * np.int64(CONFIDENCE[np.uint64(state & 1023)])
        ) >> 8
        logits[k] = logit
        sum1 += weights1[k] * logit
        sum2 += weights2[k] * logit
    logits[inputs] = 256
    logit1 = min(max(sum1 >> 16, -LOGIT_LIMIT), LOGIT_LIMIT)
    logit2 = min(max(sum2 >> 16, -LOGIT_LIMIT), LOGIT_LIMIT)
    logit = (logit1 + logit2) >> 1
    place = (logit + 2048) * 32
    left, right = np.uint64(place >> 12), np.uint64((place >> 12) + 1)
    share = place & 4095
    refined = (np.int64(refinement[left]) * (4096 - share) + np.int64(refinement[right]) * share) >> 12
    p1 = min(max((_squashed(logit) + refined) >> 1, MINIMUM_P1), 65536 - MINIMUM_P1)
    bit = code_bit(coder, data, p1, bit)
    target = 65535 * bit
    error1 = (target - _squashed(logit1)) * rate
    error2 = (target - _squashed(logit2)) * rate
    for i in range(inputs + 1):
        k = np.uint64(i)
        weights1[k] += (logits[k] * error1 + 32768) >> 16
        weights2[k] += (logits[k] * error2 + 32768) >> 16
    for i in range(inputs):
        learn(states, contexts[np.uint64(i)], bit, limit)
    refinement[left] += ((target - np.int64(refinement[left])) * (4096 - share)) >> 18
    refinement[right] += ((target - np.int64(refinement[right])) * share) >> 18
    return bit
