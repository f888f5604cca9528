"""Weights whose few largest are replaced by what their own distribution expects.

The largest weights of importance sampling are themselves chance. A generalised Pareto
distribution is fitted to the upper tail and its expected order statistics take the place of
the weights found (Vehtari, Simpson, Gelman, Yao and Gabry 2024). Its shape k tells how far to
trust them: below 0.5 the variance of the weights is finite, above 0.7 estimates may be off.
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


def smooth_weights(
    log_weights: Float[Tensor, " n"],
) -> tuple[Float[Tensor, " n"], float]:
    """Weights that sum to 1, and the shape k of their tail (infinite where too few are positive).

    Raises ValueError as `normalise_log_weights` does.
    """
    weights = normalise_log_weights(log_weights)
    positive = int((weights > 0).sum())
    count = math.ceil(min(positive / 5, 3 * math.sqrt(positive)))
    if count < _FEWEST_IN_TAIL:
        return weights, math.inf
    order = weights.argsort()
    tail, threshold = order[-count:], weights[order[-count - 1]]
    excess = weights[tail] - threshold
    if not bool(excess[-1] > 0) or not bool(excess[count // 4] > 0):
        # Even weights have no tail.
        return weights, 0.0
    shape, scale = fit_pareto(excess)
    level = (torch.arange(count, dtype=weights.dtype) + 0.5) / count
    if abs(shape) < 1e-9:
        expected = -scale * torch.log1p(-level)
    else:
        expected = scale * torch.expm1(-shape * torch.log1p(-level)) / shape
    smoothed = weights.clone()
    # No weight may exceed the largest one found.
    smoothed[tail] = (threshold + expected).clamp_max(float(weights[order[-1]]))
    return smoothed / smoothed.sum(), shape


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
