"""A smaller file from a file, without training: fewer coupled primitives, coarser covariances.

Both work on what the file holds and leave alone what other symbols are conditioned on: references and hyperpriors keep
their symbols, so that everything that is kept decodes to what it was. Residual embeddings keep their step: most of
their symbols are 0, 1 or -1, and a coarser step either leaves those where they are or loses them all
(docs/rates.md has what it costs).
"""

import math
from dataclasses import replace

import numpy as np

from compgs.codec.content import FileContent, dequantize
from compgs.codec.integer_network import (
    BIAS_LIMIT,
    FRACTION_BITS,
    IntegerLayer,
    IntegerNetwork,
    entropy_parameters,
)
from compgs.codec.tables import SCALES_PER_OCTAVE

ROWS = ("coordinates", "mask", "reference_hyper", "reference", "covariance", "residual_hyper", "residual")


def without_coupled(content: FileContent, kept: np.ndarray) -> FileContent:
    """Some of the P coupled primitives only (kept: [P] bool, in the file's order), and the anchors that have one."""
    mask = content.mask.copy()
    mask[mask] = kept
    anchors = mask.any(1)
    content = replace(content, mask=mask, residual=content.residual * mask[:, :, None])
    return replace(content, **{name: getattr(content, name)[anchors] for name in ROWS})


def with_coarser_covariances(content: FileContent, ratio: float) -> FileContent:
    """Log scales in steps that are `ratio` times as large; nothing else is conditioned on them.

    In the new unit, means are the old ones over the ratio, and scales, counted in twelfths of an octave, are lower by
    12 log2(ratio): both go into the network's last layer. Symbols are rounded again, from the values that the file had.
    """
    step = float(np.float32(content.covariance_step * ratio))
    ratio = step / content.covariance_step
    latents = dequantize(content)
    network = rescaled(content.networks["covariance"], ratio)
    means, _ = entropy_parameters(network, latents.reference)
    symbols = np.rint((latents.covariance / ratio - means) / (1 << FRACTION_BITS)).astype(np.int32)
    return replace(
        content,
        covariance_step=step,
        covariance=symbols,
        networks={**content.networks, "covariance": network},
    )


def rescaled(network: IntegerNetwork, ratio: float) -> IntegerNetwork:
    """The network for symbols in a unit that is `ratio` times as large."""
    *first, last = network.layers
    channels = len(last.bias) // 2
    weight, bias = last.weight.astype(np.float64), last.bias.astype(np.float64)
    weight[:channels] /= ratio
    bias[:channels] /= ratio
    bias[channels:] -= SCALES_PER_OCTAVE * math.log2(ratio) * (1 << FRACTION_BITS)
    bias = bias.clip(1 - BIAS_LIMIT, BIAS_LIMIT - 1)
    layer = IntegerLayer(
        np.rint(weight).astype(np.int32), np.rint(bias).astype(np.int64), last.shift, last.rectify
    )
    return IntegerNetwork((*first, layer))
