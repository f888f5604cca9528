"""What to do with the weights of draws: normalise, cut, and choose by them."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.resampling import normalise_log_weights

_HOPELESS = 20.0
"""A draw whose log weight is so far below the best one counts as impossible."""
TRUSTED = 5
"""So many trial draws must have a weight before it decides which draws are hopeless."""
_FEWEST_PLACES = 300.0
"""Places are chosen as if no draw had more than this share of the weight (1 / count), so that
components also go where the draws found little so far."""
_LARGEST_SHARE = 10.0
"""Of few draws that have a weight each may have so many times its even share."""


def threshold(best: float, density: Tensor, log_prior: Tensor) -> Tensor:
    """Log likelihood from which a draw is worth weighing; infinite where the prior is zero."""
    least = best - _HOPELESS + density - log_prior
    return torch.where(torch.isfinite(log_prior), least, torch.inf)


def finite(log_weights: Tensor) -> Tensor:
    """Log weights, -inf where there is none."""
    return torch.where(torch.isfinite(log_weights), log_weights, -torch.inf)


def known_weights(log_weights: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Weights that sum to 1; raises ValueError where all are zero."""
    if not bool((log_weights > -torch.inf).any()):
        raise ValueError(
            "no particle explains the new datum (every likelihood is zero or NaN); "
            "check units and frames of the data against the priors"
        )
    return normalise_log_weights(log_weights)


def truncate(weights: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Weights cut to sqrt(n) times their mean, and normalised again: a bias that vanishes with n,
    against draws in places that the mixture hardly reaches (Ionides 2008)."""
    kept = weights.clamp_max(weights.mean() * math.sqrt(len(weights)))
    return kept / kept.sum()


def cut_off(weights: Float[Tensor, " n"], count: float) -> Float[Tensor, " n"]:
    """Weights of which none is more than 1 / count of their sum, by and large.

    The cut is repeated, since each one lowers the sum. Raises ValueError where no more than
    `count` of them are above zero: they could only be made equal.
    """
    positive = int((weights > 0).sum())
    if positive <= count:
        raise ValueError(f"count is {count}, expected less than the {positive} weights above zero")
    for _ in range(30):
        weights = weights.clamp_max(1.0 / count)
        weights = weights / weights.sum()
    return weights


def evened(
    log_weights: Float[Tensor, " n"], count: float, most: float = _LARGEST_SHARE
) -> Float[Tensor, " n"]:
    """Weights that sum to 1, of which none is more than 1 / count, or, where few are above zero,
    than `most` times its even share of them. Raises ValueError where all are zero."""
    weights = known_weights(log_weights)
    return cut_off(weights, min(count, float((weights > 0).sum()) / most))


def spread_choice(log_weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices drawn by weight, none of which may take more than a small share."""
    weights = evened(log_weights, _FEWEST_PLACES)
    return torch.multinomial(weights, count, replacement=True, generator=generator)
