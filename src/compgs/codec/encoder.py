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
from torch import Tensor

from compgs import __version__
from compgs.codec.content import (
    LOG_SCALES,
    CodedGroup,
    FileContent,
    Group,
    GroupShape,
    Role,
    Surroundings,
    code_group,
    scatter_existing,
    surroundings,
)
from compgs.codec.integer_network import FRACTION_BITS, Follow, IntegerLayer, IntegerNetwork
from compgs.codec.row_fitting import fitted
from compgs.codec.tables import HyperTable, hyper_tables
from compgs.codec.viewpoint_cameras import kept_viewpoints, viewpoints_from_cameras
from compgs.codec.viewpoints import Viewpoints
from compgs.codec.weights import QuantizedTensor
from compgs.codec.writer import Geometry, write_content
from compgs.entropy.contexts import Hyperprior, NoContext
from compgs.entropy.models import OwnResidualsEntropyModel
from compgs.entropy.neighbour_network import NeighbourNetwork
from compgs.entropy.network import EntropyNetwork
from compgs.entropy.quantization import weight_exponent
from compgs.errors import NotEncodable
from compgs.ordering.order import canonical_order
from compgs.outputs import check_output_file, write_bytes
from compgs.paths import as_path
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
            f"expected a trained model, as compgs.train gives it, and compgs.training.load_run of a run's folder, "
            f"found {type(model).__name__}; a decoded file is a .cgs file already: copy it"
        )
    path = as_path(path, "path")
    check_output_file(path, overwrite=overwrite)
    data, content = encoded(model, geometry)
    write_bytes(path, data)
    return EncodedFile(path, len(data), len(content.coordinates), int(content.mask.sum()))


def encoded(
    model: TrainedModel, geometry: Geometry = "octree", *, viewpoints: int | None = None
) -> tuple[bytes, FileContent]:
    """The bytes of a file, and what is in it. `viewpoints`: cameras to keep; by default as many as the model's settings
    say. Raises NotEncodable, MissingDependency.
    """
    content, coded = _coded_model(model, viewpoints)
    return write_content(content, geometry, coded=coded), content


def to_content(model: TrainedModel) -> FileContent:
    """Everything that goes into the file, as integers, in the file's order. Anchors without a coupled primitive are
    left out. Raises NotEncodable.
    """
    return _coded_model(model, None)[0]


@torch.no_grad()
def _coded_model(model: TrainedModel, viewpoints: int | None) -> tuple[FileContent, list[CodedGroup]]:
    """Each network is evaluated once, and the model stays as it is."""
    for name, parameter in model.named_parameters():
        if not torch.isfinite(parameter).all():
            raise NotEncodable(f"{name} holds values that are not finite: the training has diverged")
    kept = torch.nonzero(model.mask.any(1)).view(-1).cpu()
    if not len(kept):
        raise NotEncodable("no coupled primitive exists: there is nothing to encode")
    kept = kept[torch.from_numpy(canonical_order(model.coordinates.cpu()[kept].numpy()))]
    coordinates, mask = model.coordinates.cpu()[kept].numpy(), model.mask.cpu()[kept].numpy()
    d = model.dimensions
    # Files of scenes without one are of versions that have no room for it.
    row_context = model.row_context and model.angular_dilation is not None
    chain = _Chain(mask, surroundings(coordinates), model.weights.network, row_context)
    for code in (_code_references, _code_log_scales, _code_residuals):
        code(chain, model, kept)
    content = FileContent(
        coupled_primitives=d.coupled_primitives,
        residual_dim=d.residual_dim,
        heads_layout=d.heads,
        width=d.width,
        voxel_size=model.voxel_size,
        world_offset=model.world_offset,
        view_distance_scale=model.distance_unit,
        background=model.background,
        angular_dilation=model.angular_dilation,
        coordinates=coordinates,
        mask=mask,
        groups=tuple(chain.groups),
        heads=tuple(
            (name, quantized_tensor(tensor, model.weights.bits(name, tensor)))
            for name, tensor in model.head_tensors().items()
        ),
        viewpoints=_viewpoints(model, viewpoints, len(kept)),
        levels=chain.known.levels,
        metadata={"creator": f"compgs {__version__}"},
    )
    return content, chain.coded


def _viewpoints(model: TrainedModel, count: int | None, anchors: int) -> Viewpoints | None:
    count = kept_viewpoints(model.most_viewpoints, anchors) if count is None else count
    cameras = model.viewpoints[:count]
    return viewpoints_from_cameras(cameras, model.up, model.world_offset) if cameras else None


class _Chain:
    """The groups of a file one after the other, each coded given the ones before."""

    def __init__(self, mask: np.ndarray, known: Surroundings, network_bits: int, row_context: bool) -> None:
        self.mask = mask  # [N, K] bool
        self.known = known
        self.network_bits = network_bits
        self.row_context = row_context  # whether symbols say something about later ones of their row
        self.groups: list[Group] = []
        self.coded: list[CodedGroup] = []

    def add_side(self, hyperprior: Hyperprior, y: Tensor) -> int:
        """A hyperprior of the latents y [N, C]; its number."""
        # In float64, so that a symbol does not depend on how many anchors are analyzed together.
        symbols = _symbols(copy.deepcopy(hyperprior.analysis).cpu().double()(y))
        tables = hyper_tables(hyperprior.density.probabilities().double().cpu().numpy(), symbols)
        return self._add(GroupShape(Role.SIDE, symbols.shape[1]), tables, symbols.astype(np.float64))

    def add(self, shape: GroupShape, network: EntropyNetwork, y: Tensor) -> int:
        """Latents y [N, channels], in quantization steps; with RESIDUAL those of all K slots. The group's number."""
        latents = y.numpy()
        if shape.role == Role.RESIDUAL:
            latents = latents.reshape(*self.mask.shape, shape.channels)[self.mask]
        return self._add(shape, integer_network(network, self.network_bits), latents)

    def _add(self, shape: GroupShape, prior: IntegerNetwork | tuple[HyperTable, ...], y: np.ndarray) -> int:
        """`y` [N, channels] float64; with RESIDUAL [P, channels], of the coupled primitives that exist."""
        before = [group.latents for group in self.coded]

        def steps_of(rows: slice, means: np.ndarray | None, _: np.ndarray) -> np.ndarray:
            wanted = y if shape.role == Role.RESIDUAL else y[rows]
            return np.rint(wanted if means is None else wanted - means / ONE).astype(np.int32)

        def code(prior: IntegerNetwork | tuple[HyperTable, ...]) -> CodedGroup:
            return code_group(shape, prior, before, self.known, self.mask, steps_of)

        if self.row_context and isinstance(prior, IntegerNetwork):
            prior, coded = fitted(shape.role, prior, code)
        else:
            coded = code(prior)
        self.coded.append(coded)
        symbols = coded.symbols
        slots = scatter_existing(symbols, self.mask) if shape.role == Role.RESIDUAL else symbols
        self.groups.append(Group(shape, prior, slots))
        return len(self.groups) - 1


def _code_references(chain: _Chain, model: TrainedModel, kept: Tensor) -> None:
    entropy, f = model.entropy, _rows(model.references, kept)
    steps, context = (_float32(model.config.entropy.steps.reference),), entropy.reference_context
    neighbours = entropy.neighbour_network
    sides: tuple[int, ...] = ()
    if isinstance(context, Hyperprior) and neighbours is None:
        sides = (chain.add_side(context, f),)
    shape = GroupShape(
        Role.REFERENCE,
        f.shape[1],
        steps,
        sides,
        sees_coordinates=isinstance(context, NoContext),
        sees_neighbours=neighbours is not None,
    )
    chain.add(shape, neighbours or entropy.reference_network, f)


def _code_log_scales(chain: _Chain, model: TrainedModel, kept: Tensor) -> None:
    entropy = model.entropy
    steps = entropy.covariance_step.detach().cpu().numpy().astype(np.float32)
    scales = _rows(model.log_scales, kept) / torch.from_numpy(steps.astype(np.float64))
    context = (len(chain.groups) - 1,)
    shape = GroupShape(Role.LOG_SCALES, LOG_SCALES, tuple(map(float, steps)), context)
    chain.add(shape, entropy.covariance_network, scales)


def _code_residuals(chain: _Chain, model: TrainedModel, kept: Tensor) -> None:
    """Nothing where all anchors share them: they are in the section of heads."""
    entropy = model.entropy
    if not isinstance(entropy, OwnResidualsEntropyModel):
        return
    g = _rows(model.residuals, kept)
    references = next(i for i, group in enumerate(chain.groups) if group.shape.role == Role.REFERENCE)
    side = chain.add_side(entropy.residual_hyperprior, g)
    steps = (_float32(model.config.entropy.steps.residual),)
    shape = GroupShape(Role.RESIDUAL, model.dimensions.residual_dim, steps, (references, side))
    chain.add(shape, entropy.residual_network, g)


def _rows(parameter: Tensor, kept: Tensor) -> Tensor:
    """[len(kept), C] float64 on the CPU."""
    return parameter.detach().cpu()[kept].double()


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
    follow = None
    if isinstance(network, NeighbourNetwork):
        shift = weight_exponent(network.follow, bits)
        whole = _symbols(network.follow.detach().double() * 2.0**shift, (1 << (bits - 1)) - 1)
        follow = Follow(whole, shift)
    return IntegerNetwork(tuple(result), skip=last > 0, follow=follow)


def quantized_tensor(parameter: Tensor, bits: int) -> QuantizedTensor:
    """A prediction network's parameter as the file holds it."""
    exponent = weight_exponent(parameter, bits)
    return QuantizedTensor(
        _symbols(parameter.detach().double() * 2.0**exponent, (1 << (bits - 1)) - 1), exponent
    )


def _symbols(x: Tensor, limit: int = (1 << 31) - 1) -> np.ndarray:
    return x.round().clamp(-limit, limit).cpu().numpy().astype(np.int32)
