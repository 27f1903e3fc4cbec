"""The trainable scene: anchors' parameters, prediction heads and entropy model in one module.

Training optimizes it, the encoder turns it into a file, `as_hybrid_model` into something that can be rendered.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor, nn

from compgs.cameras import Camera
from compgs.config import Config, Heads, ModelConfig
from compgs.devices import placed
from compgs.entropy.models import Quantized, make_entropy_model
from compgs.entropy.neighbourhood import Neighbourhood, neighbourhood
from compgs.entropy.quantization import WeightRounding
from compgs.model.constants import SHARED_RESIDUALS
from compgs.model.head_weights import HeadDimensions
from compgs.model.hybrid_model import HybridModel
from compgs.stored_weights import StoredWeights
from compgs.tensors.heads import make_heads
from compgs.tensors.linear import ReferenceLayer
from compgs.tensors.primitives import Primitives, every_slot


class OwnResiduals:
    """Each anchor has its own K residual embeddings (Sec. 3.1): a row of the parameter for each anchor."""

    anchor_parameters = ("residuals",)

    def start(self, row: Tensor, anchors: int) -> Tensor:
        """[N, K * residual_dim] of so many anchors, from the `row` [K * residual_dim] that a new anchor gets."""
        return row.repeat(anchors, 1)

    def of_anchors(self, residuals: Tensor, rows: Tensor | None, stored: StoredWeights | None) -> Tensor:
        """[V, K * residual_dim] of the anchors in `rows` [V] int64 (None: of all), before they are quantized."""
        return residuals if rows is None else residuals.index_select(0, rows)

    def head_tensors(self, residuals: Tensor) -> dict[str, Tensor]:
        """None of them is in the file's section of prediction heads: they are latents."""
        return {}


class SharedResiduals:
    """All anchors share K residual embeddings: the parameter has one row, which the file holds beside the heads."""

    anchor_parameters = ()

    def __init__(self, coupled_primitives: int, residual_dim: int, step: float) -> None:
        self.shape = coupled_primitives, residual_dim
        self.step = step

    def start(self, row: Tensor, anchors: int) -> Tensor:
        """[1, K * residual_dim]: the `row` [K * residual_dim] itself."""
        return row.repeat(1, 1)

    def of_anchors(self, residuals: Tensor, rows: Tensor | None, stored: StoredWeights | None) -> Tensor:
        """[1, K * residual_dim] for whichever anchors; with `stored` as the file will hold them, straight-through."""
        if stored is None:
            return residuals
        rounded = stored.rounded(SHARED_RESIDUALS, self.dequantized(residuals))
        return rounded.view_as(residuals) / self.step

    def head_tensors(self, residuals: Tensor) -> dict[str, Tensor]:
        """What they add to the file's section of prediction heads, by name, before it is rounded."""
        return {SHARED_RESIDUALS: self.dequantized(residuals)}

    def dequantized(self, residuals: Tensor) -> Tensor:
        """[K, residual_dim] as prediction sees them, from the parameter [1, K * residual_dim], which is in steps."""
        return (residuals * self.step).view(self.shape)


class Decisions(Protocol):
    """What training has decided that the settings leave to it (`training.plan.Plan`)."""

    @property
    def viewpoints(self) -> int: ...

    @property
    def row_context(self) -> bool: ...

    @property
    def head_bits(self) -> int: ...

    def model(self, settings: ModelConfig) -> ModelConfig: ...


@dataclass(frozen=True)
class ModelDimensions:
    """Sizes of a model. It begins with those of the settings and may outgrow them: channels that say nothing go."""

    coupled_primitives: int  # K, slots of an anchor; the mask says which exist
    reference_dim: int
    residual_dim: int
    width: int  # hidden, of the prediction networks
    heads: Heads


class TrainedModel(nn.Module):
    """N anchors on a voxel grid with K coupled primitives each.

    An anchor is at coordinates * voxel_size + world_offset in the world. Everything here and in training lives in the
    local frame, without the offset: single precision holds it also far from the world's origin.

    Embeddings are kept in units of their quantization step, so that a learning rate is a number of steps; log scales
    in natural units relative to the voxel size, because their steps are learned: in steps, all primitives would change
    their size whenever a step does. All else (entropy models, files) sees latents in steps: log scales pass from one to
    the other in `quantized` and `primitives`.
    """

    coordinates: Tensor  # [N, 3] int32, voxels
    mask: Tensor  # [N, K] bool: coupled primitives that exist

    def __init__(
        self,
        config: Config,
        coordinates: Tensor,  # [N, 3] int32
        voxel_size: float,  # world units
        distance_unit: float,  # world units, of the view embedding
        background: tuple[float, float, float],
        world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0),  # world units, float64
        plan: Decisions | None = None,  # what training has decided; None: all is as the settings say
        reference_dim: int | None = None,  # channels that are left; None: all of them
    ) -> None:
        super().__init__()
        m = config.model if plan is None else plan.model(config.model)
        if reference_dim is not None:
            m = replace(m, reference_dim=reference_dim)
        n = len(coordinates)
        self.config = config
        self.voxel_size = voxel_size
        self.distance_unit = distance_unit
        self.background = background
        self.world_offset = world_offset
        self.angular_dilation: float | None = None  # float32, of what is drawn (`RasterSettings`)
        # Cameras of the world that stand for all that the scene was trained on, the first for them best; its sky.
        self.viewpoints: tuple[Camera, ...] = ()
        self.up: tuple[float, float, float] = (0.0, -1.0, 0.0)
        self.plan = plan
        # Cameras that a file keeps at most, and whether symbols say something about later ones of their row.
        self.most_viewpoints = config.training.viewpoints if plan is None else plan.viewpoints
        self.row_context = m.row_context
        # Of the prediction networks' weights in the file; training may decide for fewer than the settings say.
        self.head_bits = config.entropy.head_bits if plan is None else plan.head_bits
        self.heads = make_heads(m.heads, HeadDimensions(m.reference_dim, m.residual_dim, m.width))
        self.entropy = make_entropy_model(m, config.entropy)
        self._neighbourhood: tuple[Tensor, Neighbourhood] | None = None  # of the coordinates as they were
        self._weights_rest = False
        self._rounding: WeightRounding | None = None  # of the heads' weights, while they rest
        self.register_buffer("coordinates", coordinates.to(torch.int32))
        self.register_buffer("mask", torch.ones(n, m.coupled_primitives, dtype=torch.bool))
        self.log_scales = nn.Parameter(torch.zeros(n, 6))
        self.references = nn.Parameter(torch.zeros(n, m.reference_dim))
        self.residual_kind: OwnResiduals | SharedResiduals = (
            OwnResiduals()
            if m.residuals
            else SharedResiduals(m.coupled_primitives, m.residual_dim, config.entropy.steps.residual)
        )
        # [N, K * residual_dim] steps, or [1, K * residual_dim] where all anchors share them
        self.residuals = nn.Parameter(self.residual_kind.start(self.entropy.starting_residuals(), n))

    def __repr__(self) -> str:
        return f"TrainedModel({self.anchors:,} anchors, {int(self.mask.sum()):,} coupled primitives)"

    @property
    def anchors(self) -> int:
        return len(self.coordinates)

    @property
    def reference_dim(self) -> int:
        """Channels of the references now: those that came to say nothing are gone."""
        return self.references.shape[1]

    @property
    def own_residuals(self) -> bool:
        """Whether each anchor has its own residual embeddings."""
        return isinstance(self.residual_kind, OwnResiduals)

    @property
    def dimensions(self) -> ModelDimensions:
        """Return the sizes as they are now."""
        m = self.config.model
        return ModelDimensions(
            self.mask.shape[1],
            self.reference_dim,
            m.residual_dim,
            self.heads.dimensions.width,
            self.heads.layout,
        )

    @property
    def device(self) -> torch.device:
        return self.log_scales.device

    def slots(self, rows: Tensor) -> Tensor:
        """[V * K] int64: where the coupled primitives of the anchors in `rows` [V] stand among those of all."""
        k = self.dimensions.coupled_primitives
        return (rows[:, None] * k + torch.arange(k, device=rows.device)).view(-1)

    def positions(self, rows: Tensor | None = None) -> Tensor:
        """[N, 3] float32 world units in the local frame, of the given anchors or all."""
        coordinates = self.coordinates if rows is None else self.coordinates[rows]
        return coordinates.to(torch.float32) * self.voxel_size

    @property
    def anchor_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that have a row for each anchor."""
        return ("log_scales", "references", *self.residual_kind.anchor_parameters)

    def grown(self, coordinates: Tensor, references: Tensor, log_scale: Tensor) -> dict[str, Tensor]:
        """Rows of new anchors by name: at coordinates [A, 3] int32, with references [A, reference_dim] and the
        logarithm [A] of their sizes in voxels.
        """
        new = len(coordinates)
        return {
            "coordinates": coordinates,
            "references": references,
            "log_scales": log_scale[:, None].repeat(1, 6),
            "residuals": self.entropy.starting_residuals().repeat(new, 1),
            "mask": self.mask.new_ones(new, self.mask.shape[1]),
        }

    def readers(self) -> Iterator[ReferenceLayer]:
        """The layers that take the references."""
        yield from self.heads.readers(self.config.entropy.steps.reference)
        yield from self.entropy.readers()

    def shared_residuals(self) -> Tensor:
        """[K, residual_dim] residual embeddings, where all anchors share them."""
        assert isinstance(self.residual_kind, SharedResiduals)
        return self.residual_kind.dequantized(self.residuals)

    @property
    def weights(self) -> StoredWeights:
        """How exactly the file will hold the networks' weights."""
        return StoredWeights(self.config.entropy.network_bits, self.head_bits)

    def head_tensors(self) -> dict[str, Tensor]:
        """What the file's section of prediction heads holds, by name, before it is rounded."""
        return {**dict(self.heads.named_parameters()), **self.residual_kind.head_tensors(self.residuals)}

    def quantized(
        self,
        rows: Tensor | None = None,  # [V] int64: anchors to look at; default all
        *,
        rate: bool = False,
        noise: Callable[[Tensor], Tensor] | None = None,
        stored_weights: bool = True,
        mask: Tensor
        | None = None,  # [V, K] bool: coupled primitives of these anchors whose bits count; default all
        sample: Tensor
        | None = None,  # [S] int64: of these anchors, those whose `neighbour_bits` count; default all
    ) -> Quantized:
        """Quantized latents (in steps) and their bits; see EntropyModel.forward."""

        def chosen(parameter: Tensor) -> Tensor:
            return parameter if rows is None else parameter.index_select(0, rows)

        e = self.config.entropy
        stored = self.weights if stored_weights else None
        beside = rows if sample is None else sample if rows is None else rows.index_select(0, sample)
        references = chosen(self.references)
        covariances = chosen(self.log_scales) / self.entropy.covariance_step
        residuals = self.residual_kind.of_anchors(self.residuals, rows, stored)
        latents = self.entropy(
            references,
            covariances,
            residuals,
            rate=rate,
            noise=noise,
            network_bits=stored.network if stored else None,
            mask=mask,
            around=self.around(beside, decoded=noise is None) if rate else None,
            sample=sample,
        )
        if e.quantized:
            return latents
        residuals = residuals.expand(len(references), -1)
        return Quantized(references, covariances, residuals, latents.bits, latents.neighbour_bits)

    @torch.no_grad()
    def around(self, rows: Tensor | None = None, *, decoded: bool = True) -> Tensor | None:
        """[V, 2 + reference_dim] what neighbours of the anchors in `rows` [V] int64 (None: of all) have as `decoded`,
        or before it is rounded; None if the references do not see them.
        """
        if self.entropy.context_of_references != "neighbours":
            return None
        found = self._neighbourhood
        if found is None or found[0] is not self.coordinates:
            found = self._neighbourhood = (self.coordinates, neighbourhood(self.coordinates))
        assert self.entropy.neighbour_network is not None
        centre = self.entropy.neighbour_network.centre
        references = (self.references - centre).round() + centre if decoded else self.references
        return found[1].around(references, centre, rows)

    def primitives(self, latents: Quantized, rows: Tensor | None = None) -> Primitives:
        """Dequantize: all K coupled primitives of the given anchors, as prediction sees them."""
        steps, d = self.config.entropy.steps, self.dimensions
        n = len(latents.references)
        return Primitives(
            positions=self.positions(rows),
            log_scales=latents.covariances * self.entropy.covariance_step,
            references=latents.references * steps.reference,
            residuals=(latents.residuals * steps.residual).reshape(-1, d.residual_dim),
            anchor_index=every_slot(n, d.coupled_primitives, self.device),
            voxel_size=self.voxel_size,
        )

    def stored_head_weights(self) -> dict[str, Tensor]:
        """The heads' parameters as the file will hold them, by name, straight-through."""
        weights = dict(self.heads.named_parameters())
        rounding = self._rounding
        if rounding is None:
            bits = [self.weights.bits(name, weight) for name, weight in weights.items()]
            rounding = WeightRounding.of(list(weights.values()), bits)
            if self._weights_rest:
                self._rounding = rounding
        return dict(zip(weights, rounding.applied(list(weights.values())), strict=True))

    @contextmanager
    def weights_at_rest(self) -> Iterator[None]:
        """Inside, nobody changes the heads' weights: what rounding adds to them is found once."""
        self._weights_rest = True
        try:
            yield
        finally:
            self._weights_rest, self._rounding = False, None

    @torch.no_grad()
    def as_hybrid_model(self, *, stored_weights: bool = True) -> HybridModel:
        """What a decoder would render, without going through a file, on the device of this model."""
        primitives = self.primitives(self.quantized(stored_weights=stored_weights))
        kept = self.mask.view(-1)
        heads = copy.deepcopy(self.heads)
        if stored_weights:
            for name, value in self.stored_head_weights().items():
                heads.get_parameter(name).copy_(value)
        chosen = replace(
            primitives,
            residuals=primitives.residuals[kept],
            anchor_index=primitives.anchor_index[kept],
        )
        model = HybridModel(
            chosen.arrays(),
            heads.weights(),
            self.distance_unit,
            self.background,
            world_offset=self.world_offset,
            viewpoints=self.viewpoints[: self.most_viewpoints],
            up=self.up,
            angular_dilation=self.angular_dilation,
        )
        return placed(model, self.device)

    @torch.no_grad()
    def bits_of_anchors(self, mask: Tensor | None = None, *, in_file: bool = True) -> dict[str, Tensor]:
        """Bits [n] of each stream of the file for the anchors that have one of the coupled primitives of `mask` [N, K]
        bool (default: of those that exist), by the model's own probabilities; weights and positions not included.
        Not `in_file`: as training pays for them.
        """
        mask = self.mask if mask is None else mask
        coded = torch.nonzero(mask.any(1)).view(-1)
        latents = self.quantized(coded, rate=True, mask=mask.index_select(0, coded))
        return latents.bits_in_file if in_file else latents.bits

    def estimated_bits(self, mask: Tensor | None = None) -> dict[str, float]:
        """Sums of `bits_of_anchors`; a GPU is waited for once beside them."""
        bits = self.bits_of_anchors(mask)
        sums = torch.stack([b.sum(dtype=torch.float64) for b in bits.values()]).tolist()
        return dict(zip(bits, sums, strict=True))
