"""Latents of a step: quantized before its views are drawn, and moved by distortion and rate afterwards.

anchors ──quantize──► latents ──cut──► views ──► gradients ─┐
   ▲                     │                                  │
   └───── backward ◄─────┴── bits ──► rate ──── x lambda ───┘
"""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from compgs.entropy import Quantized
from compgs.losses import rate
from compgs.trained_model import TrainedModel
from compgs.training.step.moment import Moment
from compgs.training.step.step_views import StepViews

# Anchors of a step that the neighbours' network learns from at most. It has a hundred weights; to describe the
# surroundings of all anchors in view would take a tenth of a step of Truck (docs/results/truck.md).
LEARNED_FROM = 16_384


class StepLatents:
    """Quantization, rate, and the gradients that go through both (CompGS Sec. 3.3)."""

    def __init__(self, model: TrainedModel, normalization: Literal["bits", "elements"]) -> None:
        """`normalization`: the unit of the rate, as the setting `training.rate` has it."""
        self.model = model
        self.normalization = normalization

    def quantize(self, views: StepViews, now: Moment) -> Quantized:
        """Latents of the anchors in view as the decoder will have them, and their bits (Sec. 3.3)."""
        rate = now.rate_weight > 0
        return self.model.quantized(
            views.own.rows,
            rate=rate,
            noise=None if now.hard else views.noise_of_latents(),
            stored_weights=now.stored,
            sample=self.sample_of(views) if rate else None,
        )

    def sample_of(self, views: StepViews) -> Tensor | None:
        """[S] int64 the anchors of a step that the neighbours' network learns from, evenly spread over those in view;
        None: all.
        """
        count = len(views.own.rows)
        apart = -(-count // LEARNED_FROM)
        if apart <= 1:
            return None
        first = views.views[0] % apart  # other views begin elsewhere
        return torch.arange(first, count, apart, device=views.own.rows.device)

    def rate_of(self, latents: Quantized, views: StepViews, now: Moment) -> Tensor | None:
        """R of Eq. 1, summed over this rank's views, and over the steps that it stands for; None where it is not in the
        loss.
        """
        if not latents.bits:
            return None
        channels = self.model.entropy.channels
        parts = [latents.of(views.own.part_of(number)) for number in views.own.numbers]
        rates = [rate(part.bits, channels, self.normalization) for part in parts]
        return now.rate_weight * torch.stack(rates).sum()

    def backward_latents(
        self, latents: Quantized, shown: Quantized, rate: Tensor | None, lmbda: float
    ) -> None:
        """Backpropagate D + lambda R (Eq. 1): what the views ask of the latents, and what the rate does, go through the
        entropy model to the anchors. With lambda 0 only the entropy model learns R.
        """
        if rate is not None and lmbda > 0:
            rate = lmbda * rate
        elif rate is not None:
            rate.backward(inputs=self.model.entropy.statistics(), retain_graph=True)
            rate = None
        pass_gradients_back(latents.latents(), shown.latents(), rate)

    def learn_neighbours(self, latents: Quantized, views: StepViews) -> None:
        """Backpropagate what the references cost given their neighbours, as in the file: only the neighbours' network
        learns of it.
        """
        if latents.neighbour_bits is None:
            return
        bits, numbers = latents.neighbour_bits, views.own.numbers
        if len(bits) < len(latents.references):  # of a sample
            parts = [bits] * len(numbers)
        else:
            chosen = [views.own.part_of(number) for number in numbers]
            parts = [bits if part is None else bits.index_select(0, part) for part in chosen]
        torch.stack([bits.mean() for bits in parts]).sum().backward()


def pass_gradients_back(
    tensors: Sequence[Tensor], leaves: Sequence[Tensor], loss: Tensor | None = None
) -> None:
    """Lead the gradients of `leaves`, which were cut from the `tensors`, and those of a `loss` [] on through the graph
    of these.
    """
    asked: list[tuple[Tensor, Tensor | None]]
    asked = [
        (tensor, leaf.grad) for tensor, leaf in zip(tensors, leaves, strict=True) if leaf.grad is not None
    ]
    if loss is not None:
        asked.append((loss, None))
    torch.autograd.backward([tensor for tensor, _ in asked], [gradient for _, gradient in asked])
