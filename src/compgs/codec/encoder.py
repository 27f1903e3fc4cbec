"""A trained model becomes a file: the mirror image of decoder.py.

Training estimated bits and reconstruction values with float networks. Here the same networks, their weights rounded to
the integers that the file holds, are evaluated exactly, in the order in which the decoder will evaluate them; symbols
are whole steps from the means that the *integer* networks give.
"""

import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from compgs import __version__
from compgs.codec.content import LOG_SCALES, FileContent, Group, GroupShape, Role
from compgs.codec.integer_network import FRACTION_BITS, IntegerLayer, IntegerNetwork, evaluate
from compgs.codec.tables import HyperTable, hyper_tables
from compgs.codec.viewpoint_cameras import viewpoints_from_cameras
from compgs.codec.viewpoints import Viewpoints
from compgs.codec.weights import QuantizedTensor
from compgs.codec.writer import Geometry, write_content
from compgs.entropy.factorized import FactorizedDensity
from compgs.entropy.network import EntropyNetwork
from compgs.entropy.quantization import weight_exponent
from compgs.errors import NotEncodable
from compgs.outputs import check_output_file, write_bytes
from compgs.trained_model import TrainedModel

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
    m, entropy = model.config.model, model.entropy
    for name, parameter in model.named_parameters():
        if not torch.isfinite(parameter).all():
            raise NotEncodable(f"{name} holds values that are not finite: the training has diverged")
    kept = model.mask.any(1).cpu()
    if not kept.any():
        raise NotEncodable("no coupled primitive exists: there is nothing to encode")
    mask = model.mask.cpu()[kept].numpy()

    def rows(parameter: Tensor) -> Tensor:
        return parameter.detach().cpu()[kept].double()

    steps = entropy.covariance_step.detach().cpu().numpy().astype(np.float32)
    groups = _reference_groups(model, rows(model.references))
    references = groups[-1].latents
    scales = rows(model.log_scales) / torch.from_numpy(steps.astype(np.float64))
    shape = GroupShape(Role.LOG_SCALES, LOG_SCALES, tuple(map(float, steps)), (len(groups) - 1,))
    groups.append(_coded(shape, scales, [references], entropy.covariance_network, model.weights.network))
    if m.residuals:
        groups += _residual_groups(model, rows(model.residuals), references, first=len(groups))
    slots = (m.coupled_primitives, m.residual_dim)
    return FileContent(
        coupled_primitives=m.coupled_primitives,
        residual_dim=m.residual_dim,
        heads_layout=m.heads,
        width=m.width,
        voxel_size=model.voxel_size,
        world_offset=model.world_offset,
        view_distance_scale=model.distance_unit,
        background=model.background,
        coordinates=model.coordinates.cpu()[kept].numpy(),
        mask=mask,
        groups=tuple(
            Group(
                coded.shape,
                coded.prior,
                coded.symbols.reshape(-1, *slots) * mask[:, :, None]
                if coded.shape.role == Role.RESIDUAL
                else coded.symbols,
            )
            for coded in groups
        ),
        heads=tuple(
            (name, quantized_tensor(tensor, model.weights.bits(name, tensor)))
            for name, tensor in model.head_tensors().items()
        ),
        viewpoints=_viewpoints(model),
        metadata={"creator": f"compgs {__version__}"},
    )


def _viewpoints(model: TrainedModel) -> Viewpoints | None:
    cameras = model.viewpoints[: model.config.training.viewpoints]
    return viewpoints_from_cameras(cameras, model.up, model.world_offset) if cameras else None


@dataclass(frozen=True)
class _Coded:
    """A group before the mask: symbols and latents (Q12) [N, channels of an anchor]."""

    shape: GroupShape
    prior: IntegerNetwork | tuple[HyperTable, ...]
    symbols: np.ndarray
    latents: np.ndarray


def _reference_groups(model: TrainedModel, f: Tensor) -> list[_Coded]:
    e, entropy = model.config.entropy, model.entropy
    side = _hyperprior(entropy.reference_analysis, entropy.reference_density, f)
    shape = GroupShape(Role.REFERENCE, f.shape[1], (_float32(e.reference_step),), (0,))
    return [side, _coded(shape, f, [side.latents], entropy.reference_network, model.weights.network)]


def _residual_groups(model: TrainedModel, g: Tensor, references: np.ndarray, first: int) -> list[_Coded]:
    """`first`: number of the first of these groups in the file."""
    m, e, entropy = model.config.model, model.config.entropy, model.entropy
    assert entropy.residual_analysis is not None and entropy.residual_density is not None
    assert entropy.residual_network is not None
    side = _hyperprior(entropy.residual_analysis, entropy.residual_density, g)
    shape = GroupShape(Role.RESIDUAL, m.residual_dim, (_float32(e.residual_step),), (1, first))
    context = [references, side.latents]
    return [side, _coded(shape, g, context, entropy.residual_network, model.weights.network)]


def _hyperprior(analysis: nn.Module, density: FactorizedDensity, y: Tensor) -> _Coded:
    # In float64, so that a symbol does not depend on how many anchors are analyzed together.
    symbols = _symbols(copy.deepcopy(analysis).cpu().double()(y))
    tables = hyper_tables(density.probabilities().double().cpu().numpy(), symbols)
    return _Coded(GroupShape(Role.SIDE, symbols.shape[1]), tables, symbols, symbols * ONE)


def _coded(
    shape: GroupShape, y: Tensor, context: list[np.ndarray], network: EntropyNetwork, bits: int
) -> _Coded:
    """Symbols of y [N, C], in quantization steps, given the latents that the decoder has by then."""
    prior = integer_network(network, bits)
    mean = evaluate(prior, np.concatenate(context, 1))[:, : y.shape[1]]
    symbols = np.rint(y.numpy() - mean / ONE).astype(np.int32)
    return _Coded(shape, prior, symbols, symbols * ONE + mean)


def _float32(value: float) -> float:
    return float(np.float32(value))


def integer_network(network: EntropyNetwork, bits: int) -> IntegerNetwork:
    """The entropy network as the decoder evaluates it: integer weights, biases in fixed point."""
    layers = network.layers()
    last = len(layers) - 1
    result = []
    for i, (weight, bias) in enumerate(layers):
        exponent = weight_exponent(weight, bits)
        ends_branch = 0 < i < last and i % 2 == 0
        result.append(
            IntegerLayer(
                weight=_symbols(weight.detach().double() * 2.0**exponent, (1 << (bits - 1)) - 1),
                bias=np.rint(bias.detach().double().cpu().numpy() * ONE).astype(np.int64),
                shift=exponent,
                rectify=i < last and not ends_branch,
                adds=ends_branch,
            )
        )
    return IntegerNetwork(tuple(result), skip=last > 0)


def quantized_tensor(parameter: Tensor, bits: int) -> QuantizedTensor:
    """A prediction network's parameter as the file holds it."""
    exponent = weight_exponent(parameter, bits)
    return QuantizedTensor(
        _symbols(parameter.detach().double() * 2.0**exponent, (1 << (bits - 1)) - 1), exponent
    )


def _symbols(x: Tensor, limit: int = (1 << 31) - 1) -> np.ndarray:
    return x.round().clamp(-limit, limit).cpu().numpy().astype(np.int32)
