"""Resampling and weights of particles, in float64 and in the log domain."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor


def normalise_log_weights(log_weights: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Weights that sum to 1. Raises ValueError where every weight is zero or one is NaN."""
    largest = log_weights.double().max()
    if not bool(torch.isfinite(largest)):
        raise ValueError(
            f"the largest log weight is {float(largest)}, expected a finite number: no particle "
            "explains the data, or a likelihood is NaN"
        )
    weights = torch.exp(log_weights.double() - largest)
    return weights / weights.sum()


def effective_sample_size(weights: Float[Tensor, " m"]) -> float:
    """Kish's number 1 / sum w^2 for weights that sum to 1 (Kong, Liu and Wong 1994)."""
    return float(1.0 / (weights.double() ** 2).sum())


def systematic_resample(
    weights: Float[Tensor, " m"], count: int, generator: torch.Generator
) -> Int[Tensor, " count"]:
    """Draw `count` ancestors with one uniform number (Kitagawa 1996), least variance of all.

    Ancestor i appears floor(count w_i) or ceil(count w_i) times, never with zero weight.
    """
    cumulative = weights.double().cumsum(0)
    start = torch.rand((), generator=generator, dtype=torch.float64)
    share = (torch.arange(count, dtype=torch.float64) + start) / count
    positions = share.to(cumulative.device) * cumulative[-1]
    index = torch.searchsorted(cumulative, positions, right=True)
    last = int(torch.nonzero(weights > 0).max())
    return index.clamp(max=last)


def weighted_quantile(
    values: Float[Tensor, " m *columns"],
    weights: Float[Tensor, " m"],
    level: float,
    sample_size: float = math.inf,
) -> Float[Tensor, "*columns"]:
    """Smallest value of each column at which the weights sum up to the level.

    Where the values are worth so many independent draws, n of a distribution, a further draw lies
    below the k-th smallest of them with probability k / (n + 1) (Hyndman and Fan 1996, type 6). So
    levels move outwards the fewer they are, and at most to the ends of the values.
    """
    if math.isfinite(sample_size):
        level = (level * (sample_size + 1) - 0.5) / sample_size
    ordered, order = values.sort(dim=0)
    cumulative = weights[order].cumsum(0)
    # Above zero: values without weight are none.
    share = min(max(level, 1e-12), 1.0)
    first = (cumulative >= share * cumulative[-1]).double().argmax(0)
    return ordered.gather(0, first[None])[0]


def weighted_place(
    values: Float[Tensor, " m *columns"],
    weights: Float[Tensor, " m"],
    at: Float[Tensor, "*columns"],
    sample_size: float = math.inf,
) -> Float[Tensor, "*columns"]:
    """Probability that a further draw lies below `at`: the level whose `weighted_quantile` that is.

    0 below all values and 1 above.
    """
    column = weights.reshape(-1, *(1,) * (values.ndim - 1))
    below = (column * ((values < at).double() + 0.5 * (values == at).double())).sum(0)
    below = below / weights.sum()
    if not math.isfinite(sample_size):
        return below
    place = (sample_size * below + 0.5) / (sample_size + 1)
    # Rounded sums of weights are not exactly 0 and 1.
    outside = torch.where(below < 0.5, 0.0, 1.0).to(below.dtype)
    return torch.where((below < 1e-9) | (below > 1 - 1e-9), outside, place)
