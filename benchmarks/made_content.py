"""Made-up but plausible file contents: for the codec's tests, golden files and benchmark."""

import numpy as np

from compgs.codec.content import Dimensions, FileContent, fixed_point, reconstruct, residual_context
from compgs.codec.integer_network import FRACTION_BITS, IntegerLayer, IntegerNetwork, entropy_parameters
from compgs.codec.tables import hyper_tables
from compgs.codec.weights import QuantizedTensor

WEIGHT_SHIFT = 10
RANDOM_ROWS = 16384


def make_content(
    anchors: int,
    seed: int = 0,
    dimensions: Dimensions | None = None,
    *,
    kept: float = 0.8,  # share of coupled primitives that exist
    hidden: int = 0,  # width of the entropy networks' hidden layer; 0: none
    symbols: bool = True,  # False: zero symbols, and networks that are sure of it
) -> FileContent:
    """Content whose symbols follow its own networks' predictions, as a trained model's do."""
    d = dimensions or Dimensions()
    rng = np.random.default_rng(seed)
    networks = {name: _network(rng, *size, hidden, symbols) for name, size in d.network_sizes().items()}

    def hyper(channels: int) -> np.ndarray:
        spread = np.linspace(0.5, 6.0, channels)
        return np.rint(rng.standard_normal((anchors, channels)) * spread * symbols).astype(np.int32)

    def draw(name: str, context: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        means, index = entropy_parameters(networks[name], context)
        drawn = np.zeros(index.shape, np.int32)
        for start in range(0, anchors if symbols else 0, RANDOM_ROWS):
            scales = np.exp2(index[start : start + RANDOM_ROWS] / np.float32(12) - np.float32(5))
            noise = rng.standard_normal(scales.shape, np.float32)
            drawn[start : start + RANDOM_ROWS] = np.rint(noise * scales)
        return drawn, means

    z_f, z_g = hyper(d.reference_hyper_dim), hyper(d.residual_hyper_dim)
    q_f, means = draw("reference", fixed_point(z_f))
    f_hat = reconstruct(q_f, means)
    q_c, _ = draw("covariance", f_hat)
    q_g, _ = draw("residual", residual_context(z_g, f_hat))
    mask = rng.random((anchors, d.coupled_primitives)) < kept
    residual = q_g.reshape(anchors, d.coupled_primitives, d.residual_dim)
    residual *= mask[:, :, None]
    flat = np.full((64, 49), 1.0 / 49)
    return FileContent(
        dimensions=d,
        voxel_size=0.015625,
        view_distance_scale=3.0,
        background=(0.0, 0.5, 1.0),
        reference_step=1.0,
        residual_step=1.0,
        covariance_step=0.0625,
        coordinates=make_coordinates(anchors, rng),
        mask=mask,
        reference_hyper=z_f,
        reference=q_f,
        covariance=q_c,
        residual_hyper=z_g,
        residual=residual,
        reference_hyper_tables=hyper_tables(flat[: d.reference_hyper_dim], z_f),
        residual_hyper_tables=hyper_tables(flat[: d.residual_hyper_dim], z_g),
        networks=networks,
        heads=_heads(rng, d),
        metadata={"creator": "made up"},
    )


def make_coordinates(anchors: int, rng: np.random.Generator) -> np.ndarray:  # [N, 3] int32
    """Distinct voxels near a few curved surfaces, in no order."""
    found = np.zeros((0, 3), np.int32)
    extent = 4.0 * np.sqrt(anchors) + 8.0
    while len(found) < anchors:
        directions = rng.standard_normal((anchors + 16, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radii = extent * rng.choice([0.2, 0.5, 1.0], len(directions)) + rng.standard_normal(len(directions))
        points = np.rint(directions * radii[:, None]).astype(np.int32)
        found = np.unique(np.concatenate([found, points]), axis=0)
    return np.ascontiguousarray(found[rng.permutation(len(found))[:anchors]])


def _network(
    rng: np.random.Generator, inputs: int, outputs: int, hidden: int, spread: bool
) -> IntegerNetwork:
    """Means within a few steps, scales between a quarter of a step and a few steps."""
    layers = []
    if hidden:
        weight = rng.standard_normal((hidden, inputs)) / np.sqrt(inputs)
        layers.append(_layer(weight, np.zeros(hidden), rectify=True))
        inputs = hidden
    channels = outputs // 2
    weight = rng.standard_normal((outputs, inputs)) / np.sqrt(inputs) * 0.3
    bias = np.concatenate([rng.uniform(-1, 1, channels), rng.uniform(36, 72, channels) * spread])
    weight[channels:] *= spread
    layers.append(_layer(weight, bias, rectify=False))
    return IntegerNetwork(tuple(layers))


def _layer(weight: np.ndarray, bias: np.ndarray, *, rectify: bool) -> IntegerLayer:
    return IntegerLayer(
        weight=np.rint(weight * (1 << WEIGHT_SHIFT)).astype(np.int32),
        bias=np.rint(bias * (1 << FRACTION_BITS)).astype(np.int64),
        shift=WEIGHT_SHIFT,
        rectify=rectify,
    )


def _heads(rng: np.random.Generator, d: Dimensions) -> tuple[tuple[str, QuantizedTensor], ...]:
    shapes = {"weight": (d.width, d.reference_dim + d.residual_dim), "bias": (d.width,)}
    return tuple(
        (f"{head}.{name}", QuantizedTensor(np.rint(rng.laplace(0, 20, shape)).astype(np.int32), 6))
        for head in ("geometry", "appearance")
        for name, shape in shapes.items()
    )
