"""The anchors of COSA-GS as they are trained: with a latent, masks, and the chain that says what they cost."""

import numpy as np
import torch
from torch import Tensor, nn

from compgs.codec.encoder import quantized_tensor
from compgs.codec.integer_network import FRACTION_BITS
from compgs.entropy.network import EntropyNetwork
from compgs.entropy.quantization import in_stored_steps, quantize_weights
from compgs.errors import NotEncodable
from compgs.methods.anchors.model import AnchorModel
from compgs.methods.anchors.prediction import AnchorValues
from compgs.methods.cosa.entropy import CausalChain, Chained, ContextNetwork, Noise
from compgs.methods.cosa.rounding import Rounding, integers
from compgs.methods.cosa.settings import CosaConfig
from compgs.ordering.order import canonical_order, octree_depth, octree_origin
from compgs.published.anchors import AnchorScene, Frame
from compgs.published.cosa.chain import coordinate_inputs, walk
from compgs.published.cosa.content import CosaContent, scene_of
from compgs.published.cosa.shape import GROUPS, ChainShape
from compgs.training.rate.file_size import OTHER_BYTES, gaussian_entropy

NOT_BEGUN = -1  # depth of the cube while there is no rate
BIAS_BITS = 14  # biases of the rendering networks are few: they keep more bits than the weights


class CosaModel(AnchorModel):
    """Anchors with one position scale, a latent, and a mask for each coupled primitive.

    Without rate they are plain anchors; from `begin` on they are coded.
    """

    position_scales = 1
    config: CosaConfig
    origin: Tensor  # [3] int64 voxels: corner of the cube in which coordinates are -1 to 1
    depth: Tensor  # [] int64: its side is 2^depth voxels; NOT_BEGUN: there is no rate yet

    def __init__(self, config: CosaConfig, coordinates: Tensor, frame: Frame) -> None:
        super().__init__(config, coordinates, frame)
        c, m, n = config.cosa, config.model, len(coordinates)
        shape = ChainShape(m.coupled_primitives, m.reference_dim, c.latent_dim, c.context_dim)
        steps = {
            "latent": c.latent_step,
            "feature": c.feature_step,
            "position_scale": c.scale_step,
            "offset": c.offset_step,
            "size": c.scale_step,
        }
        self.chain = CausalChain(shape, steps)
        self.latents = nn.Parameter(torch.zeros(n, c.latent_dim))
        self.mask_logits = nn.Parameter(torch.full((n, m.coupled_primitives), c.mask_start))
        self.register_buffer("origin", torch.zeros(3, dtype=torch.int64))
        self.register_buffer("depth", torch.tensor(NOT_BEGUN))

    @property
    def anchor_parameters(self) -> tuple[str, ...]:
        return *super().anchor_parameters, "latents", "mask_logits"

    def grown(self, coordinates: Tensor, references: Tensor, log_scale: Tensor) -> dict[str, Tensor]:
        new = len(coordinates)
        start = self.config.cosa.mask_start
        return {
            **super().grown(coordinates, references, log_scale),
            "latents": self.latents.new_zeros(new, self.latents.shape[1]),
            "mask_logits": self.mask_logits.new_full((new, self.mask.shape[1]), start),
        }

    # the rate ------------------------------------------------------------------------------------------------------

    @property
    def begun(self) -> bool:
        """Whether there is a rate."""
        return int(self.depth) != NOT_BEGUN

    @torch.no_grad()
    def begin(self) -> None:
        """Code the anchors from now on: fix the cube of the coordinates, and start from what the values are."""
        coordinates = self.coordinates.cpu().numpy()
        origin = octree_origin(coordinates)
        self.origin.copy_(torch.from_numpy(origin))
        self.depth.fill_(octree_depth(coordinates.astype(np.int64) - origin))
        self.chain.fit(self.natural())

    def natural(self) -> dict[str, Tensor]:
        """Values of each group [N, channels], not in steps."""
        return {
            "latent": self.latents,
            "feature": self.features,
            "position_scale": self.log_scales[:, :1],
            "offset": self.offsets,
            "size": self.log_scales[:, 1:],
        }

    def places(self) -> Tensor:
        """[N, 3] float32 what the chain takes of the coordinates."""
        fixed = coordinate_inputs(self.coordinates.cpu().numpy(), self.origin.cpu().numpy(), int(self.depth))
        return torch.from_numpy(fixed.astype(np.float32) / (1 << FRACTION_BITS)).to(self.device)

    def chained(self, noise: Noise | None, *, rate: bool = True) -> Chained:
        """All anchors along the chain; without `noise`, as the decoder will have them."""
        c = self.config.cosa
        return self.chain(
            self.places(),
            self.natural(),
            noise=noise,
            network_bits=c.network_bits,
            everywhere=c.noise_everywhere,
            rate=rate,
        )

    def kept(self) -> Tensor:
        """[N, K] bool: coupled primitives that the masks leave."""
        return torch.sigmoid(self.mask_logits.detach()) > self.config.cosa.mask_threshold

    def masks(self) -> Tensor:
        """[N, K] 0 or 1, straight-through to the sigmoids of the logits."""
        soft = torch.sigmoid(self.mask_logits)
        return soft + (self.kept().to(soft.dtype) - soft).detach()

    def seen(self, chained: Chained, masks: Tensor | None) -> AnchorValues:
        """Return the values as prediction takes them."""
        v = {group: value * self.chain.step(group) for group, value in chained.values.items()}
        offsets = v["offset"].view(self.anchors, -1, 3)
        return AnchorValues(self.positions(), v["feature"], offsets, v["position_scale"], v["size"], masks)

    def total_bits(self, bits: dict[str, Tensor], masks: Tensor) -> Tensor:
        """[] of the whole scene. An anchor's own bits are shared by the primitives that it has left: they go with the
        last of them."""
        each, there = bits["offset"] * masks, masks.detach().mean()
        flags = masks.shape[1] * _binary_entropy(there)
        own = sum(cost for name, cost in bits.items() if name != "offset")
        own = own + self.config.cosa.position_bits + flags
        return (own * masks.amax(1)).sum() + each.sum()

    # the file ------------------------------------------------------------------------------------------------------

    def stored_weights(self) -> dict[str, Tensor]:
        """Return the rendering networks' weights as the file will hold them, straight-through."""
        weights = self.networks.weights()
        stored = quantize_weights(list(weights.values()), [self.weight_bits(w) for w in weights.values()])
        return dict(zip(weights, stored, strict=True))

    def weight_bits(self, weight: Tensor) -> int:
        """Return the bits of a weight or bias of the rendering networks, in the file."""
        bits = self.config.cosa.head_bits
        return bits if weight.dim() > 1 else max(BIAS_BITS, bits)

    @torch.no_grad()
    def estimated_bytes(self) -> int:
        """Estimate the bytes of the file, without writing it."""
        latents = float(self.total_bits(self.chained(None).bits, self.kept().float()))
        coded = []
        for network in self.chain.networks.children():
            assert isinstance(network, ContextNetwork | EntropyNetwork)
            for weight, bias in network.layers():
                coded += [in_stored_steps(weight, self.config.cosa.network_bits), bias * (1 << FRACTION_BITS)]
        for weight in self.networks.weights().values():
            coded.append(in_stored_steps(weight, self.weight_bits(weight)))
        return int((latents + gaussian_entropy(coded)) / 8) + OTHER_BYTES

    @torch.no_grad()
    def as_hybrid_model(self) -> AnchorScene:
        """What the file would show."""
        if not self.begun:
            return super().as_hybrid_model()
        return scene_of(self.content())

    @torch.no_grad()
    def content(self) -> CosaContent:
        """All that the file holds, as integers. Raises NotEncodable for what has diverged, or has nothing left."""
        for name, parameter in self.named_parameters():
            if not torch.isfinite(parameter).all():
                raise NotEncodable(f"{name} holds values that are not finite: the training has diverged")
        mask = self.kept().cpu().numpy()
        rows = np.flatnonzero(mask.any(1))
        if not len(rows):
            raise NotEncodable("all primitives are masked: there is nothing to encode")
        coordinates = self.coordinates.cpu().numpy()
        rows = rows[canonical_order(coordinates[rows])]
        coordinates, mask = coordinates[rows], mask[rows]
        networks = {
            name: integers(n, self.config.cosa.network_bits) for name, n in self.chain.networks.items()
        }
        steps = {group: float(np.float32(self.chain.step(group).item())) for group in GROUPS}
        y = {g: v.detach().cpu().double().numpy()[rows] / steps[g] for g, v in self.natural().items()}
        y["offset"] = y["offset"].reshape(*mask.shape, 3)[mask]
        coded = Rounding(y)
        places = coordinate_inputs(coordinates, self.origin.cpu().numpy(), int(self.depth))
        latents = walk(self.chain.shape, networks, places, mask, coded)
        corner_x, corner_y, corner_z = (int(v) for v in self.origin)
        return CosaContent(
            shape=self.chain.shape,
            frame=self.frame,
            steps=steps,
            origin=(corner_x, corner_y, corner_z),
            depth=int(self.depth),
            coordinates=coordinates,
            mask=mask,
            networks=networks,
            latents=latents,
            symbols=tuple(coded.symbols),
            tables=tuple(coded.tables),
            weights={n: quantized_tensor(w, self.weight_bits(w)) for n, w in self.networks.weights().items()},
        )


def _binary_entropy(p: Tensor) -> Tensor:
    """Bits of a flag that is set with this probability []."""
    p = p.clamp(1e-6, 1 - 1e-6)
    return -(p * p.log2() + (1 - p) * (1 - p).log2())
