"""Adam over the scene's parameters: one group a learning rate, log-linear decay, rows that come and go (Sec. 3.4).

Settings are for one view a step. A step of V views is to go as far as V steps of one view each. Its gradient is the
sum of theirs, and as views mostly show different primitives, or pull at one in different directions, its root mean
square is the root of V times one view's. Adam divides by that, so the learning rates are multiplied by it; and betas
are raised to the power of V, so that the moments remember as many views as before (Zhao et al. 2024, "On Scaling Up 3D
Gaussian Splatting Training", Grendel).
"""

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Protocol

import torch
from torch import Tensor, nn

from compgs.config import TrainingConfig
from compgs.trained_model import TrainedModel
from compgs.training.structure.variants import VARIANTS

# First and last learning rate of the prediction heads, by the names of their networks (Ref.).
HEAD_RATES = {
    "geometry": (4e-3, 4e-5),
    "appearance": (8e-3, 8e-5),
    "translation": (2e-3, 2e-5),
    "covariance": (4e-3, 4e-5),
    "opacity": (2e-3, 2e-5),
    "color": (8e-3, 8e-5),
}
ADAM_EPSILON = 1e-15  # gradients of single primitives are tiny (3DGS)


def make_optimizer(model: TrainedModel, config: TrainingConfig) -> torch.optim.Adam:
    """Groups carry their name and (first, last) learning rate; `set_learning_rates` moves between them."""
    heads, entropy = model.heads, model.entropy
    longer = max(1.0, VARIANTS[model.config.control.variant].entropy_steps / config.steps)
    entropy_lr = config.entropy_lr[0] * longer, config.entropy_lr[1] * longer

    def group(name: str, parameters: Iterable[nn.Parameter], rates: tuple[float, float]) -> dict:
        rates = rates_for(config.views_per_step, rates)
        betas = betas_for(config.views_per_step)
        return {"name": name, "params": list(parameters), "lr": rates[0], "rates": rates, "betas": betas}

    groups = [
        group("log_scales", [model.log_scales], config.log_scale_lr),
        group("references", [model.references], config.embedding_lr),
        group("residuals", [model.residuals], config.embedding_lr),
        group("entropy", entropy.parameters(), entropy_lr),
    ]
    for name, network in heads.networks():
        first, last = HEAD_RATES[name]
        groups.append(group(name, network.parameters(), (config.head_lr * first, config.head_lr * last)))
    return torch.optim.Adam(groups, lr=1e-3, eps=ADAM_EPSILON, fused=True)


def parameters_of(optimizer: torch.optim.Optimizer) -> list[nn.Parameter]:
    """All that it moves."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def rates_for(views: int, rates: tuple[float, float]) -> tuple[float, float]:
    """First and last learning rate of steps of so many views, from those of steps of one."""
    return rates[0] * math.sqrt(views), rates[1] * math.sqrt(views)


def betas_for(views: int, betas: tuple[float, float] = (0.9, 0.999)) -> tuple[float, float]:
    """Adam's, of steps of so many views, from those of steps of one."""
    return betas[0] ** views, betas[1] ** views


def set_learning_rates(
    optimizer: torch.optim.Optimizer,
    progress: float,
    decay: Callable[[float, float, float], float],
    warm_up: float = 0.0,
) -> None:
    """Set each group's rate between its first and its last one, by the `progress` in 0 to 1.

    In the first `warm_up` of the run the prediction heads come up to their rates from a hundredth of them: at full
    rate they would make the whole scene transparent or white, where nothing has a gradient, before the embeddings can
    tell one place from another.
    """
    rising = min(1.0, 0.01 + progress / warm_up) if warm_up > 0 else 1.0
    for group in optimizer.param_groups:
        first, last = group["rates"]
        group["lr"] = decay(first, last, progress)
        if group["name"] in HEAD_RATES:
            group["lr"] *= rising


def cosine_decay(first: float, last: float, progress: float) -> float:
    """Half a cosine from the first to the last rate."""
    return last + (first - last) * 0.5 * (1.0 + math.cos(math.pi * progress))


def exponential_decay(first: float, last: float, progress: float) -> float:
    """Fall by the same factor in every step."""
    return first * math.exp(progress * math.log(last / first))


DECAYS = {"cosine": cosine_decay, "exponential": exponential_decay}


class AnchorRows(Protocol):
    """A module whose parameters and buffers have a row for each anchor, some of them."""

    coordinates: Tensor  # [N, 3] int32, voxels
    mask: Tensor  # [N, K] bool: coupled primitives that exist

    @property
    def anchors(self) -> int: ...

    @property
    def anchor_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that have such rows."""
        ...

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]: ...

    def get_submodule(self, target: str) -> nn.Module: ...


@torch.no_grad()
def replace_rows(
    model: AnchorRows, optimizer: torch.optim.Adam, kept: Tensor, added: dict[str, Tensor]
) -> None:
    """Keep some anchors and append others, in the parameters and in Adam's moments (zero for new anchors).

    kept: [N] bool; added: rows by name for `coordinates`, `mask` and every anchor parameter.
    """
    model.coordinates = torch.cat([model.coordinates[kept], added["coordinates"]])
    model.mask = torch.cat([model.mask[kept], added["mask"]])
    for name in model.anchor_parameters:
        rows = added[name]
        change = partial(_joined, kept=kept, rows=rows)
        change_moment = partial(_joined, kept=kept, rows=torch.zeros_like(rows))
        replace_parameter(model, optimizer, getattr(model, name), change, change_moment)


def _joined(x: Tensor, kept: Tensor, rows: Tensor) -> Tensor:
    return torch.cat([x[kept], rows])


@torch.no_grad()
def replace_parameter(
    model: nn.Module | AnchorRows,
    optimizer: torch.optim.Optimizer | None,
    old: Tensor,
    change: Callable[[Tensor], Tensor],
    change_moment: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Another shape for a parameter, by `change`, in its module and in the optimizer, Adam's moments included (these by
    `change_moment`, if given).

    It is another parameter afterwards: graphs of earlier steps remember the old one's shape.
    """
    name = next(name for name, p in model.named_parameters() if p is old)
    path, _, attribute = name.rpartition(".")
    new = nn.Parameter(change(old.detach()), requires_grad=old.requires_grad)
    setattr(model.get_submodule(path), attribute, new)
    if optimizer is None:
        return
    for group in optimizer.param_groups:
        group["params"] = [new if p is old else p for p in group["params"]]
    state = optimizer.state.pop(old, None)
    if state:
        for moment in ("exp_avg", "exp_avg_sq"):
            state[moment] = (change_moment or change)(state[moment])
        optimizer.state[new] = state
