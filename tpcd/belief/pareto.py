"""How heavy the tail of importance weights is, and so how far to trust them.

The largest weights of importance sampling are themselves chance. A generalised Pareto
distribution is fitted to the upper tail. Below a shape k of 0.5 the variance of the weights
is finite; above 0.7 estimates may be off (Vehtari, Simpson, Gelman, Yao and Gabry 2024).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.resampling import normalise_log_weights

_FEWEST_IN_TAIL = 5
_PRIOR_COUNT, _PRIOR_SHAPE = 10.0, 0.5
"""The shape is drawn towards 0.5 as by so many more weights."""


def tail_shape(log_weights: Float[Tensor, " n"]) -> float:
    """Shape k of the tail of the weights; infinite where too few are positive, 0 where they are
    even. Raises ValueError as `normalise_log_weights` does."""
    weights = normalise_log_weights(log_weights)
    positive = int((weights > 0).sum())
    count = math.ceil(min(positive / 5, 3 * math.sqrt(positive)))
    if count < _FEWEST_IN_TAIL:
        return math.inf
    order = weights.sort().values
    excess = order[-count:] - order[-count - 1]
    if not bool(excess[-1] > 0) or not bool(excess[count // 4] > 0):
        return 0.0
    return fit_pareto(excess)[0]


def fit_pareto(excess: Float[Tensor, " m"]) -> tuple[float, float]:
    """Shape k and scale of a generalised Pareto distribution for sorted excesses over a
    threshold (Zhang and Stephens 2009), the shape drawn a little towards 0.5."""
    m = len(excess)
    points = 30 + int(math.sqrt(m))
    index = torch.arange(1, points + 1, dtype=excess.dtype)
    quarter = excess[int(m / 4 + 0.5) - 1]
    slope = 1 / excess[-1] + (1 - (points / (index - 0.5)).sqrt()) / (3 * quarter)
    shapes = torch.log1p(-slope[:, None] * excess).mean(-1)
    likelihood = m * ((-slope / shapes).log() - shapes - 1)
    best = float(likelihood.softmax(0) @ slope)
    shape = float(torch.log1p(-best * excess).mean())
    scale = -shape / best
    return (shape * m + _PRIOR_SHAPE * _PRIOR_COUNT) / (m + _PRIOR_COUNT), scale
