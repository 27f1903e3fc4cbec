"""Adam over the scene's parameters: one group a learning rate, log-linear decay, rows that come and go (Sec. 3.4)."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from compgs.config import TrainingConfig
from compgs.trained_model import TrainedModel

ANCHOR_PARAMETERS = ("log_scales", "references", "residuals")
HEAD_GROUPS = ("geometry", "appearance", "translation", "covariance", "opacity", "color")
ADAM_EPSILON = 1e-15  # gradients of single primitives are tiny (3DGS)


def make_optimizer(model: TrainedModel, config: TrainingConfig) -> torch.optim.Adam:
    """Groups carry their name and (first, last) learning rate; `set_learning_rates` moves between them."""
    heads, entropy = model.heads, model.entropy

    def group(name: str, parameters: Iterable[nn.Parameter], rates: tuple[float, float]) -> dict:
        return {"name": name, "params": list(parameters), "lr": rates[0], "rates": rates}

    groups = [
        group("log_scales", [model.log_scales], config.log_scale_lr),
        group("references", [model.references], config.embedding_lr),
        group("residuals", [model.residuals], config.embedding_lr),
        group("entropy", entropy.parameters(), config.entropy_lr),
    ]
    if heads.layout == "paired":
        groups.append(group("geometry", heads.geometry.parameters(), config.covariance_lr))
        groups.append(group("appearance", heads.appearance.parameters(), config.color_lr))
    else:
        groups.append(group("translation", heads.translation.parameters(), config.translation_lr))
        groups.append(group("covariance", heads.covariance.parameters(), config.covariance_lr))
        groups.append(group("opacity", heads.opacity.parameters(), config.opacity_lr))
        groups.append(group("color", heads.color.parameters(), config.color_lr))
    return torch.optim.Adam(groups, lr=1e-3, eps=ADAM_EPSILON, fused=True)


def set_learning_rates(optimizer: torch.optim.Optimizer, progress: float, warm_up: float = 0.0) -> None:
    """Log-linear from the first to the last rate of each group; `progress` in 0..1.

    In the first `warm_up` of the run the prediction heads come up to their rates from a hundredth of them: at full rate
    they would make the whole scene transparent or white, where nothing has a gradient, before the embeddings can tell
    one place from another.
    """
    rising = min(1.0, 0.01 + progress / warm_up) if warm_up > 0 else 1.0
    for group in optimizer.param_groups:
        first, last = group["rates"]
        group["lr"] = first * math.exp(progress * math.log(last / first))
        if group["name"] in HEAD_GROUPS:
            group["lr"] *= rising


@torch.no_grad()
def replace_rows(
    model: TrainedModel, optimizer: torch.optim.Adam, kept: Tensor, added: dict[str, Tensor]
) -> None:
    """Keep some anchors and append others, in the parameters and in Adam's moments (zero for new anchors).

    kept: [N] bool; added: rows by name for `coordinates`, `mask` and every anchor parameter.
    """
    model.coordinates = torch.cat([model.coordinates[kept], added["coordinates"]])
    model.mask = torch.cat([model.mask[kept], added["mask"]])
    for name in ANCHOR_PARAMETERS:
        old = getattr(model, name)
        new = nn.Parameter(torch.cat([old.detach()[kept], added[name]]))
        setattr(model, name, new)
        for group in optimizer.param_groups:
            if group["name"] == name:
                group["params"] = [new]
        state = optimizer.state.pop(old, None)
        if state:
            for moment in ("exp_avg", "exp_avg_sq"):
                state[moment] = torch.cat([state[moment][kept], torch.zeros_like(added[name])])
            optimizer.state[new] = state
