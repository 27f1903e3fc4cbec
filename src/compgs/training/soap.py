"""Adam in the eigenbases of the gradients' second moments (SOAP; Vyas et al. 2024, arXiv 2409.11321).

Adam scales each number of a matrix for itself. Where inputs of a layer have much in common, directions that mix many
weights are badly scaled all the same, and are learned slowly. Of a weight W [m, n] with gradient G the moments

    L = mean of G G^T [m, m],    R = mean of G^T G [n, n]

say which directions those are; in their eigenbases Q_L, Q_R Adam's second moment is that of Q_L^T G Q_R, and its step
is turned back. The networks here have a few dozen inputs and outputs: it costs nothing beside a view.
"""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

# Of L and R: a hundred steps, a pass over the views of a small capture. 20 came out alike.
FORGETS = 0.01
# Steps between two improvements of the bases (SOAP's 10); every step came out alike.
EVERY = 10
LEFT, RIGHT = ("left", "left_basis"), ("right", "right_basis")
# What is remembered of a matrix beside Adam's moments, squares of its size along a dimension.
BASES = {**dict.fromkeys(LEFT, 0), **dict.fromkeys(RIGHT, 1)}


class Soap(torch.optim.Adam):
    """Adam; the matrices of the groups of these names by SOAP. What it remembers is in `state`, all of it tensors."""

    def __init__(
        self, groups: Iterable[dict[str, Any]], names: Iterable[str], betas: tuple[float, float], eps: float
    ) -> None:
        super().__init__(groups, lr=1e-3, betas=betas, eps=eps, fused=True)
        self.names = frozenset(names)

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """A step of all parameters that have a gradient; it is gone from the matrices afterwards."""
        assert closure is None
        matrices = [
            (parameter, group)
            for group in self.param_groups
            if group["name"] in self.names
            for parameter in group["params"]
            if parameter.dim() == 2 and parameter.grad is not None
        ]
        # All have made as many steps as the first; a GPU is waited for once, to know how many.
        done = int(self.state[matrices[0][0]].get("step", 0)) if matrices else 0
        for parameter, group in matrices:
            soap_step(parameter, parameter.grad, self.state[parameter], group, improve=done % EVERY == 0)
            parameter.grad = None
        return super().step()


@torch.no_grad()
def soap_step(
    parameter: Tensor, gradient: Tensor, state: dict[str, Tensor], group: dict[str, Any], *, improve: bool
) -> None:
    """One step of a matrix [m, n], or its first bases; `state` is changed. group: lr, betas, eps. `improve`: the bases,
    where there are any already.
    """
    (beta1, beta2), g = group["betas"], gradient
    fresh = not state
    if fresh:
        state["step"] = torch.zeros((), device=g.device)
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
    _follow(state, g, improve)
    if fresh:
        return  # in its own bases a gradient is diagonal: all else would be noise divided by its size
    state["step"] += 1
    left, right = state["left_basis"], state["right_basis"]
    m = state["exp_avg"].lerp_(g, 1 - beta1)
    turned = left.t() @ g @ right
    v = state["exp_avg_sq"].mul_(beta2).addcmul_(turned, turned, value=1 - beta2)
    # expm1: 1 - 0.999^steps would lose digits in the first steps
    correction1, correction2 = (-torch.expm1(state["step"] * math.log(beta)) for beta in (beta1, beta2))
    scaled = (left.t() @ m @ right) / correction1 / ((v / correction2).sqrt_() + group["eps"])
    parameter.add_(left @ scaled @ right.t(), alpha=-group["lr"])


@torch.no_grad()
def forget_bases(state: dict[str, Tensor]) -> None:
    """Of a parameter that is about to change its shape or its axes: moments as if it had been Adam all along. The next
    step finds bases anew.
    """
    if "left_basis" in state:
        state["exp_avg_sq"] = _squares(state["exp_avg_sq"], state["left_basis"].t(), state["right_basis"].t())
        for name in BASES:
            del state[name]


def _follow(state: dict[str, Tensor], g: Tensor, improve: bool) -> None:
    """The moments of the gradient g [m, n], and their eigenbases."""
    first = "left_basis" not in state
    for (moment, basis), square in ((LEFT, g @ g.t()), (RIGHT, g.t() @ g)):
        if first:
            state[moment] = square
            state[basis] = torch.linalg.eigh(square.nan_to_num())[1].flip(1).contiguous()
        else:
            state[moment].lerp_(square, FORGETS)
            if improve:  # one round of the QR algorithm: vectors change little, and stay in their order
                state[basis] = torch.linalg.qr(state[moment] @ state[basis])[0].contiguous()
    if first:
        state["exp_avg_sq"] = _squares(state["exp_avg_sq"], state["left_basis"], state["right_basis"])


def _squares(v: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """Second moments [m, n] after a turn by orthonormal left [m, m] and right [n, n], as if entries had nothing in
    common: more than their squares is not known.
    """
    return left.square().t() @ v @ right.square()
