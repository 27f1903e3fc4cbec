"""A trained model becomes a file: the mirror image of decoder.py.

Training estimated bits and reconstruction values with float networks. Here the same networks, their weights rounded to
the integers that the file holds, are evaluated exactly, in the order in which the decoder will evaluate them; symbols
are whole steps from the means that the *integer* networks give.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from compgs import __version__
from compgs.codec.content import Dimensions, FileContent
from compgs.codec.integer_network import FRACTION_BITS, IntegerLayer, IntegerNetwork, evaluate
from compgs.codec.tables import hyper_tables
from compgs.codec.weights import QuantizedTensor
from compgs.codec.writer import Geometry, write_content
from compgs.entropy.network import EntropyNetwork
from compgs.entropy.quantization import weight_exponent
from compgs.errors import NotEncodable
from compgs.outputs import check_output_file, write_bytes
from compgs.trained_model import BIAS_BITS, TrainedModel

ONE = 1 << FRACTION_BITS


@dataclass(frozen=True)
class EncodedFile:
    """What was written."""

    path: Path
    bytes: int
    anchors: int
    coupled: int


def encode(
    model: TrainedModel, path: str | Path, *, overwrite: bool = False, geometry: Geometry = "octree"
) -> EncodedFile:
    """Write a trained model to a .cgs file; the file appears whole or not at all.

    `geometry`: anchor positions by the octree coder, or as in the paper by G-PCC, where its program `tmc3` is on PATH.
    Raises NotEncodable for a model that the format cannot represent, OutputError if the file exists (unless
    `overwrite`) or cannot be written.
    """
    if not isinstance(model, TrainedModel):
        raise NotEncodable(
            f"expected a trained model, as compgs.train and load_run give it, found {type(model).__name__}; "
            "a decoded file is a .cgs file already: copy it"
        )
    path = Path(path)
    check_output_file(path, overwrite=overwrite)
    content = to_content(model)
    data = write_content(content, geometry)
    write_bytes(path, data)
    return EncodedFile(path, len(data), len(content.coordinates), int(content.mask.sum()))


@torch.no_grad()
def to_content(model: TrainedModel) -> FileContent:
    """Everything that goes into the file, as integers. Anchors without a coupled primitive are left out."""
    config = model.config
    m, e, entropy = config.model, config.entropy, model.entropy
    for name, parameter in model.named_parameters():
        if not torch.isfinite(parameter).all():
            raise NotEncodable(f"{name} holds values that are not finite: the training has diverged")
    if any(model.world_offset):
        raise NotEncodable(
            f"the model counts positions from {model.world_offset}, which this version of the file cannot hold"
        )
    kept = model.mask.any(1).cpu()
    if not kept.any():
        raise NotEncodable("no coupled primitive exists: there is nothing to encode")
    mask = model.mask.cpu()[kept].numpy()

    def rows(parameter: Tensor) -> Tensor:
        return parameter.detach().cpu().expand(model.anchors, -1)[kept].double()

    networks = {
        "reference": integer_network(entropy.reference_network, e.network_bits),
        "covariance": integer_network(entropy.covariance_network, e.network_bits),
        "residual": integer_network(entropy.residual_network, e.network_bits),
    }
    covariance_step = np.float32(entropy.covariance_step.item())
    f = rows(model.references)
    c = rows(model.log_scales) / float(covariance_step)
    g = rows(model.residuals)

    z_f = _symbols(entropy.reference_analysis.cpu().double()(f))
    q_f, f_hat = _code(f, z_f * ONE, networks["reference"])
    q_c, _ = _code(c, f_hat, networks["covariance"])
    z_g = _symbols(entropy.residual_analysis.cpu().double()(g))
    if not m.residuals:  # there is nothing to say about them
        z_g = np.zeros_like(z_g)
    q_g, _ = _code(g, np.concatenate([z_g * ONE, f_hat], 1), networks["residual"])
    entropy.float().to(model.device)

    residual = q_g.reshape(len(q_g), m.coupled_primitives, m.residual_dim) * mask[:, :, None]
    return FileContent(
        dimensions=Dimensions(
            coupled_primitives=m.coupled_primitives,
            reference_dim=model.reference_dim,
            residual_dim=m.residual_dim,
            reference_hyper_dim=e.reference_hyper_dim,
            residual_hyper_dim=e.residual_hyper_dim,
            heads=m.heads,
            width=m.width,
        ),
        voxel_size=model.voxel_size,
        view_distance_scale=model.distance_unit,
        background=model.background,
        reference_step=e.reference_step,
        residual_step=e.residual_step,
        covariance_step=float(covariance_step),
        coordinates=model.coordinates.cpu()[kept].numpy(),
        mask=mask,
        reference_hyper=z_f,
        reference=q_f,
        covariance=q_c,
        residual_hyper=z_g,
        residual=residual,
        reference_hyper_tables=hyper_tables(
            entropy.reference_density.probabilities().double().cpu().numpy(), z_f
        ),
        residual_hyper_tables=hyper_tables(
            entropy.residual_density.probabilities().double().cpu().numpy(), z_g
        ),
        networks=networks,
        heads=tuple(
            (name, quantized_tensor(p, e.head_bits if p.dim() > 1 else BIAS_BITS))
            for name, p in model.heads.named_parameters()
        ),
        metadata={"creator": f"compgs {__version__}"},
    )


def integer_network(network: EntropyNetwork, bits: int) -> IntegerNetwork:
    """The entropy network as the decoder evaluates it: integer weights, biases in fixed point."""
    layers = network.layers()
    result = []
    for i, (weight, bias) in enumerate(layers):
        exponent = weight_exponent(weight, bits)
        result.append(
            IntegerLayer(
                weight=_symbols(weight.detach().double() * 2.0**exponent, (1 << (bits - 1)) - 1),
                bias=np.rint(bias.detach().double().cpu().numpy() * ONE).astype(np.int64),
                shift=exponent,
                rectify=i < len(layers) - 1,
            )
        )
    return IntegerNetwork(tuple(result))


def quantized_tensor(parameter: Tensor, bits: int) -> QuantizedTensor:
    """A prediction network's parameter as the file holds it."""
    exponent = weight_exponent(parameter, bits)
    return QuantizedTensor(
        _symbols(parameter.detach().double() * 2.0**exponent, (1 << (bits - 1)) - 1), exponent
    )


def _symbols(x: Tensor, limit: int = (1 << 31) - 1) -> np.ndarray:
    return x.round().clamp(-limit, limit).cpu().numpy().astype(np.int32)


def _code(y: Tensor, context: np.ndarray, network: IntegerNetwork) -> tuple[np.ndarray, np.ndarray]:
    """Symbols [N, C] and reconstructed latents (fixed point) of y, given what the decoder knows by then."""
    channels = y.shape[1]
    mean = evaluate(network, context)[:, :channels]
    symbols = np.rint(y.cpu().numpy() - mean / ONE).astype(np.int32)
    return symbols, symbols * ONE + mean
