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

import numpy as np
import torch
from torch import Tensor, nn

from compgs.config import TrainingConfig
from compgs.numerics.compiled import njit, portion
from compgs.trained_model import TrainedModel
from compgs.training.soap import Soap, forget_bases

HEAD_GROUPS = ("geometry", "appearance", "translation", "covariance", "opacity", "color")
ROW_CHUNKS = 32
ADAM_EPSILON = 1e-15  # gradients of single primitives are tiny (3DGS)
BETAS = (0.9, 0.999)  # Adam's, for one view a step; of anchors the second is `training.anchor_memory`'s


def make_optimizer(model: TrainedModel, config: TrainingConfig) -> torch.optim.Adam:
    """Groups carry their name and (first, last) learning rate; `set_learning_rates` moves between them."""
    heads, entropy = model.heads, model.entropy
    of_anchors = BETAS[0], 1 - 1 / config.anchor_memory
    longer = max(1.0, config.entropy_lr_steps / config.steps)
    entropy_lr = config.entropy_lr[0] * longer, config.entropy_lr[1] * longer

    def group(name: str, parameters: Iterable[nn.Parameter], rates: tuple[float, float]) -> dict:
        rates = rates_for(config.views_per_step, rates)
        betas = betas_for(config.views_per_step, of_anchors if name in model.anchor_parameters else BETAS)
        return {"name": name, "params": list(parameters), "lr": rates[0], "rates": rates, "betas": betas}

    groups = [
        group("log_scales", [model.log_scales], config.log_scale_lr),
        group("references", [model.references], config.embedding_lr),
        group("residuals", [model.residuals], config.embedding_lr),
        group("entropy", entropy.parameters(), entropy_lr),
    ]
    head_rates = {
        "geometry": config.covariance_lr,
        "appearance": config.color_lr,
        "translation": config.translation_lr,
        "covariance": config.covariance_lr,
        "opacity": config.opacity_lr,
        "color": config.color_lr,
    }
    groups += [group(name, network.parameters(), head_rates[name]) for name, network in heads.networks()]
    if config.head_optimizer == "soap":
        return Soap(groups, HEAD_GROUPS, BETAS, ADAM_EPSILON)
    return torch.optim.Adam(groups, lr=1e-3, eps=ADAM_EPSILON, fused=True)


def parameters_of(optimizer: torch.optim.Optimizer) -> list[nn.Parameter]:
    """All that it moves."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def rates_for(views: int, rates: tuple[float, float]) -> tuple[float, float]:
    """First and last learning rate of steps of so many views, from those of steps of one."""
    return rates[0] * math.sqrt(views), rates[1] * math.sqrt(views)


def betas_for(views: int, betas: tuple[float, float] = BETAS) -> tuple[float, float]:
    """Adam's, of steps of so many views, from those of steps of one."""
    return betas[0] ** views, betas[1] ** views


def set_learning_rates(
    optimizer: torch.optim.Optimizer,
    progress: float,
    decay: Callable[[float, float, float], float],
    warm_up: float = 0.0,
) -> None:
    """From the first to the last rate of each group; `progress` in 0..1.

    In the first `warm_up` of the run the prediction heads come up to their rates from a hundredth of them: at full
    rate they would make the whole scene transparent or white, where nothing has a gradient, before the embeddings can
    tell one place from another.
    """
    rising = min(1.0, 0.01 + progress / warm_up) if warm_up > 0 else 1.0
    for group in optimizer.param_groups:
        first, last = group["rates"]
        group["lr"] = decay(first, last, progress)
        if group["name"] in HEAD_GROUPS:
            group["lr"] *= rising


def cosine_decay(first: float, last: float, progress: float) -> float:
    """Half a cosine from the first to the last rate."""
    return last + (first - last) * 0.5 * (1.0 + math.cos(math.pi * progress))


def exponential_decay(first: float, last: float, progress: float) -> float:
    """By the same factor in every step."""
    return first * math.exp(progress * math.log(last / first))


DECAYS = {"cosine": cosine_decay, "exponential": exponential_decay}


@torch.no_grad()
def step_rows(model: TrainedModel, optimizer: torch.optim.Adam, rows: Tensor) -> None:
    """Adam's step for the anchors in `rows` [V] int64, ascending; the step of `optimizer` then leaves anchors alone.

    What is not in view has no gradient. Dense Adam moves it all the same, by its old momentum, and lets the momentum
    decay; here both wait until the anchor is seen again (as SelectiveAdam of gsplat; Mallick et al. 2024). The bias
    corrections count all steps.
    """
    groups = {group["name"]: group for group in optimizer.param_groups}
    for name in model.anchor_parameters:
        parameter, group = getattr(model, name), groups[name]
        if parameter.grad is None:
            continue
        state = optimizer.state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        state["step"] += 1
        parts = parameter.detach(), parameter.grad, state["exp_avg"], state["exp_avg_sq"]
        if parameter.device.type == "cpu":
            (beta1, beta2), steps = group["betas"], float(state["step"])
            rate = group["lr"] * math.sqrt(1 - beta2**steps) / (1 - beta1**steps)
            epsilon = group["eps"] * math.sqrt(1 - beta2**steps)
            numbers = np.array([rate, 1 - beta1, 1 - beta2, epsilon], np.float32)
            p, g, m, v = (part.reshape(len(part), -1).numpy() for part in parts)
            _adam_rows(rows.numpy(), p, g, m, v, numbers)
        else:
            adam_rows(rows, *parts, state["step"], group)
        parameter.grad = None


def adam_rows(
    rows: Tensor,  # [V] int64
    parameter: Tensor,  # [N, C], changed
    gradient: Tensor,  # [N, C]
    first: Tensor,  # [N, C] mean of the gradient, changed
    second: Tensor,  # [N, C] mean of its square, changed
    steps: Tensor,  # [] number of this step, from 1
    group: dict,  # lr, betas, eps
) -> None:
    """Plain torch, any device and type; nothing is read back from the device."""
    beta1, beta2 = group["betas"]
    g = gradient.index_select(0, rows)
    m = first.index_select(0, rows).lerp_(g, 1 - beta1)
    v = second.index_select(0, rows).mul_(beta2).addcmul_(g, g, value=1 - beta2)
    first.index_copy_(0, rows, m)
    second.index_copy_(0, rows, v)
    # expm1: 1 - 0.999^steps would lose digits in the first steps
    correction1, correction2 = (-torch.expm1(steps * math.log(beta)) for beta in (beta1, beta2))
    denominator = (v / correction2).sqrt_().add_(group["eps"])
    parameter.index_add_(0, rows, m / correction1 / denominator, alpha=-group["lr"])


@njit(parallel=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy")
def _adam_rows(rows, parameter, gradient, first, second, numbers, share):
    """`adam_rows` on the CPU in one pass. numbers: rate and epsilon with the bias corrections in them, 1 - betas."""
    for chunk in portion(ROW_CHUNKS, share):
        rate, new1, new2, epsilon = numbers[0], numbers[1], numbers[2], numbers[3]
        for i in range(len(rows) * chunk // ROW_CHUNKS, len(rows) * (chunk + 1) // ROW_CHUNKS):
            r = rows[i]
            p, g, m, v = parameter[r], gradient[r], first[r], second[r]
            for c in range(len(p)):
                mean, square = m[c] + new1 * (g[c] - m[c]), v[c] + new2 * (g[c] * g[c] - v[c])
                m[c], v[c] = mean, square
                p[c] -= rate * mean / (np.sqrt(square) + epsilon)


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
        forget_bases(state)
        for moment in ("exp_avg", "exp_avg_sq"):
            state[moment] = (change_moment or change)(state[moment])
        optimizer.state[new] = state
