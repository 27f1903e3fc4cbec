"""The trainable splats of plain 3DGS, how they begin, and the optimizer over them (Kerbl et al. 2023, Sec. 5 and 6)."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from compgs.config import SplatConfig
from compgs.scene.points import neighbour_distance
from compgs.scene.views import Points
from compgs.tensors.spherical_harmonics import coefficients, dc_from_color
from compgs.tensors.splats import Splats
from compgs.training.optimizers import ADAM_EPSILON, betas_for, rates_for, replace_parameter


class SplatParameters(nn.Module):
    """`Splats` with gradients."""

    def __init__(self, splats: Splats) -> None:
        super().__init__()
        self.means = nn.Parameter(splats.means)
        self.log_scales = nn.Parameter(splats.log_scales)
        self.quaternions = nn.Parameter(splats.quaternions)
        self.opacity_logits = nn.Parameter(splats.opacity_logits)
        self.dc = nn.Parameter(splats.dc)
        self.rest = nn.Parameter(splats.rest)

    def __len__(self) -> int:
        return len(self.means)

    def splats(self) -> Splats:
        """The parameters themselves, in the autograd graph."""
        return Splats(self.means, self.log_scales, self.quaternions, self.opacity_logits, self.dc, self.rest)

    @torch.no_grad()
    def trained(self) -> Splats:
        """A copy without gradients."""
        return Splats(**{name: p.detach().clone() for name, p in self.named_parameters()})


def initial_splats(points: Points, config: SplatConfig) -> Splats:
    """Every point becomes a round splat of its color, as large as the distance to its neighbours."""
    n = len(points)
    # At least what 3DGS gives splats whose neighbours are in the same place.
    spread = np.maximum(neighbour_distance(points.positions), 1e-7**0.5)
    opacity = torch.full((n,), config.initial_opacity)
    return Splats(
        means=torch.tensor(points.positions, dtype=torch.float32),
        log_scales=torch.from_numpy(np.log(spread)).float()[:, None].repeat(1, 3),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        opacity_logits=torch.logit(opacity),
        dc=dc_from_color(torch.from_numpy(points.colors / 255.0).float()),
        rest=torch.zeros(n, coefficients(config.harmonics) - 1, 3),
    )


def make_splat_optimizer(
    parameters: SplatParameters,
    config: SplatConfig,
    extent: float,  # of the scene, world units
    views: int = 1,  # of a step
) -> torch.optim.Adam:
    """One group a parameter, for `training.optimizers.set_learning_rates`: only positions slow down."""
    first, last = config.position_lr
    rates = {
        "means": (first * extent, last * extent),
        "log_scales": (config.log_scale_lr, config.log_scale_lr),
        "quaternions": (config.rotation_lr, config.rotation_lr),
        "opacity_logits": (config.opacity_lr, config.opacity_lr),
        "dc": (config.color_lr, config.color_lr),
        "rest": (config.harmonics_lr, config.harmonics_lr),
    }
    rates = {name: rates_for(views, pair) for name, pair in rates.items()}
    groups = [
        {"name": name, "params": [parameter], "lr": rates[name][0], "rates": rates[name]}
        for name, parameter in parameters.named_parameters()
        if parameter.numel() > 0
    ]
    return torch.optim.Adam(groups, lr=1e-3, betas=betas_for(views), eps=ADAM_EPSILON, fused=True)


@torch.no_grad()
def replace_splats(
    parameters: SplatParameters, optimizer: torch.optim.Adam, kept: Tensor, added: Splats
) -> None:
    """Keep some splats, [M] bool, and append others, in the parameters and in Adam's moments (zero for new ones)."""
    for name, new in vars(added).items():
        _replace_rows(parameters, getattr(parameters, name), optimizer, kept, new)


@torch.no_grad()
def replace_rows_of(
    module: nn.Module, name: str, optimizer: torch.optim.Adam, kept: Tensor, origins: Tensor
) -> None:
    """The same for a parameter or buffer of a module with a row for each splat: new rows are those of the splats that
    the new ones came from, `origins` [A] int64.
    """
    old = getattr(module, name)
    new = old.detach()[origins]
    if isinstance(old, nn.Parameter):
        _replace_rows(module, old, optimizer, kept, new)
    else:
        setattr(module, name, torch.cat([old[kept], new]))


@torch.no_grad()
def reset_opacities(parameters: SplatParameters, optimizer: torch.optim.Adam, opacity: float) -> None:
    """Opacities above `opacity` fall to it: those that the views need come back, the others are pruned."""
    highest = torch.logit(torch.tensor(opacity)).item()
    replace_parameter(
        parameters, optimizer, parameters.opacity_logits, lambda x: x.clamp_max(highest), torch.zeros_like
    )


def _replace_rows(
    module: nn.Module, old: nn.Parameter, optimizer: torch.optim.Adam, kept: Tensor, new: Tensor
) -> None:
    replace_parameter(
        module,
        optimizer,
        old,
        lambda x: torch.cat([x[kept], new]),
        lambda moment: torch.cat([moment[kept], torch.zeros_like(new)]),
    )


def of_degree(splats: Splats, degree: int) -> Splats:
    """Return splats with harmonics up to `degree`: those above it are left out, missing ones are zero."""
    count = coefficients(degree) - 1
    missing = splats.rest.new_zeros(len(splats), max(0, count - splats.rest.shape[1]), 3)
    return replace(splats, rest=torch.cat([splats.rest[:, :count], missing], 1))
