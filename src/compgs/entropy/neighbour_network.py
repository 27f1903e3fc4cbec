"""What to expect of latents from what anchors around have (docs/bitstream.md, "Neighbours")."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from compgs.entropy.network import EntropyNetwork, round_fixed, round_half_up
from compgs.entropy.quantization import quantize, quantize_weight
from compgs.ordering.neighbours import BESIDES


class NeighbourNetwork(EntropyNetwork):
    """Means and scales of latents from what neighbours have, [N, 2 + C].

    Scales depend on the first two by a linear layer, in which the means are constants. From these each mean follows its
    own channel, `follow` [C] times as far, in whole steps (`moved`): what a latent is does not depend on neighbours,
    what it costs does.
    """

    def __init__(self, channels: int) -> None:
        super().__init__(BESIDES, channels)
        nn.init.zeros_(self.weights[0])
        self.follow = nn.Parameter(torch.full((channels,), 0.3))

    def layers(self, bits: int | None = None) -> list[tuple[Tensor, Tensor]]:
        """Return the layers with the rows of the means, which are zero."""
        ((weight, bias),) = super().layers()
        weight = torch.cat([torch.zeros_like(weight[: self.channels]), weight[self.channels :]])
        return [(weight, bias) if bits is None else (quantize_weight(weight, bits), round_fixed(bias))]

    def inputs_of_last(self, x: Tensor, bits: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
        return super().inputs_of_last(x[:, :BESIDES], bits)

    def moved(self, x: Tensor, bits: int | None = None, *, whole: bool = True) -> Tensor:
        """[N, C] steps by which the means follow the neighbours; `whole` ones straight-through."""
        follow = self.follow if bits is None else quantize_weight(self.follow, bits)
        steps = x[:, BESIDES:] * follow
        return round_half_up(steps) if whole else steps

    @property
    def centre(self) -> Tensor:
        """[C] what is expected where no neighbours are known: latents lie whole steps from it."""
        return self.biases[-1].detach()[: self.channels]

    def code(
        self,
        y: Tensor,  # [N, C]
        around: Tensor | None,  # [S, 2 + C] `Neighbourhood.around`
        sample: Tensor | None,  # [S] int64: the anchors that `around` is of; None: all N
        code: Callable[..., tuple[Tensor, Tensor]],  # `code_latents` with what a whole step has in common
        *,
        rate: bool,
        noise: Callable[[Tensor], Tensor] | None,
        bits: int | None,
    ) -> tuple[Tensor, Tensor | None]:
        """y_hat [N, C], and bits [S] of which only this network learns; None if not `rate`."""
        centre = self.centre if bits is None else round_fixed(self.centre)
        if not rate:
            return quantize(y, centre), None
        assert around is not None
        moved = self.moved(around, bits, whole=noise is None)
        known = y.detach() if sample is None else y.detach().index_select(0, sample)
        return quantize(y, centre), code(known - moved, around, self)[1]

    @property
    def per_channel(self) -> tuple[nn.Parameter, ...]:
        return (self.follow,)
