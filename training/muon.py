"""Muon: momentum whose singular values are all brought near one before it moves a matrix.

K. Jordan et al. 2024, "Muon: an optimizer for hidden layers in neural networks". The same rule as
torch.optim.Muon, which computes in bfloat16 whatever the weights are. A processor without
instructions for that format takes forty times as long for it as for single precision, so here
everything is in the precision of the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor

COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Of x, x^3 and x^5: five rounds bring singular values from 0.01 to 1 into 0.68 to 1.14."""
ROUNDS = 5
LEAST_NORM = 1e-7


class Muon(torch.optim.Optimizer):
    """Moves matrices by their orthogonalised Nesterov momentum; nothing else may be in `params`."""

    def __init__(self, params: Iterable[Tensor], lr: float, momentum: float = 0.95) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum})
        shapes = [tuple(p.shape) for group in self.param_groups for p in group["params"]]
        if any(len(shape) != 2 for shape in shapes):
            raise ValueError(f"Muon moves matrices only, got shapes {shapes}")

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:  # type: ignore[override]
        """One step of every matrix that has a gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["momentum_buffer"] = torch.zeros_like(parameter)
                buffer = state["momentum_buffer"].lerp_(parameter.grad, 1 - group["momentum"])
                ahead = parameter.grad.lerp(buffer, group["momentum"])
                rows, columns = parameter.shape
                rate = group["lr"] * max(1.0, rows / columns) ** 0.5
                parameter.add_(near_orthogonal(ahead), alpha=-rate)
        return loss


def near_orthogonal(matrix: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
    """The matrix with its singular values near one, by a Newton-Schulz iteration of fifth order."""
    a, b, c = COEFFICIENTS
    wide = matrix.mT if matrix.shape[0] > matrix.shape[1] else matrix
    wide = wide / wide.norm().clamp_min(LEAST_NORM)
    for _ in range(ROUNDS):
        gram = wide @ wide.mT
        wide = torch.addmm(wide, torch.addmm(gram, gram, gram, beta=b, alpha=c), wide, beta=a)
    return wide.mT if matrix.shape[0] > matrix.shape[1] else wide
