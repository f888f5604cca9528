"""Expected information gain of commands, from weighted particles and their outcomes.

Every particle i in turn plays the truth: its outcome y, at a few points of its noise, changes
the weights w to w' (Bayes), and the gain is the Kullback-Leibler divergence of w' from w,
averaged over particles by weight and over the noise. The points of the noise are those of
spherical cubature (McNamee and Stenger 1967; Arasaratnam and Haykin 2009): 2 k points at the
distance sqrt(k), exact up to the third degree. In a linear normal model the divergence is
quadratic in the noise, so that only the number of particles limits the answer. Nothing is
drawn at random: permuting particles, or splitting one into two of half its weight, changes
nothing. With m particles it does not exceed log m. Everything is in the log domain.

What a particle leaves open, the field along the outline, is learnt by Kalman's formulas once the
particle is given. By the chain rule of information (Cover and Thomas 2006, section 2.5) what an
outcome tells of both is what it tells of the particle, and in the mean over particles what it tells
of the field of each: half the logarithm of the ratio of the determinants of the outcome's
covariance with the field and without.

Axes: c commands, m particles, n outcomes that are looked at, k channels, j numbers of a field.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.information.outcomes import Outcomes, root_of_rest

_NUMBERS_AT_ONCE = 4_000_000
"""Pairs of outcome and particle held in memory at once."""


def expected_information_gain(
    outcomes: Outcomes, noise: Float[Tensor, "p k"] | None = None
) -> Float[Tensor, " c"]:
    """Expected information gain of each command [nat]: of the particle, between 0 and log m, and
    of its field.

    `noise` are the points of the noise, in standard deviations (None: the cubature's).
    """
    gains = []
    for part in split_commands(outcomes):
        log_likelihood, share = pair_log_likelihood(part, noise)
        posterior, log_norm = reweight(log_likelihood, part.weights)
        gains.append((share * ((posterior * log_likelihood).sum(-1) - log_norm)).sum(-1))
    return torch.cat(gains).clamp_min(0.0) + field_gain(outcomes)


def field_gain(outcomes: Outcomes) -> Float[Tensor, " c"]:
    """Information [nat] that each command is expected to bring of the particles' fields."""
    if outcomes.field is None:
        return outcomes.weights.new_zeros(len(outcomes.weights))
    share = outcomes.field_share
    # Of the noise, in units in which the covariance of the outcome is 1.
    noise = root_of_rest(share @ share.mT)
    each = -noise.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return (outcomes.weights * each).sum(-1).clamp_min(0.0)


def pair_log_likelihood(
    outcomes: Outcomes, noise: Float[Tensor, "p k"] | None = None
) -> tuple[Float[Tensor, "c n m"], Float[Tensor, "c n"]]:
    """Log likelihood of each outcome that is looked at under every particle, up to a constant
    common to all, and the probability of the outcome."""
    c, m, k = outcomes.mean.shape
    drawn, mean = outcome_points(outcomes, noise)
    # y^T P y - 2 (P mean)^T y + mean^T P mean as one matrix product over monomials of y.
    precision = torch.cholesky_inverse(outcomes.factor)
    pulled = (precision @ mean[..., None])[..., 0]
    log_det = outcomes.factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    constant = -0.5 * (pulled * mean).sum(-1) - log_det
    rows, columns = torch.triu_indices(k, k, device=mean.device)
    double = torch.where(rows == columns, -0.5, -1.0)
    monomials = torch.cat(
        (drawn[..., rows] * drawn[..., columns], drawn, torch.ones_like(drawn[..., :1])), dim=-1
    )
    coefficients = torch.cat(
        (precision[..., rows, columns] * double, pulled, constant[..., None]), dim=-1
    )
    count = drawn.shape[1] // m
    share = outcomes.weights[..., None].expand(c, m, count) / count
    return monomials @ coefficients.mT, share.flatten(1)


def outcome_points(
    outcomes: Outcomes, noise: Float[Tensor, "p k"] | None = None
) -> tuple[Float[Tensor, "c n k"], Float[Tensor, "c m k"]]:
    """The outcomes that are looked at, p of each particle in turn, and the particles' means, all
    from the mean of the command."""
    k = outcomes.mean.shape[-1]
    mean = outcomes.mean - (outcomes.weights[..., None] * outcomes.mean).sum(1, keepdim=True)
    points = cubature_points(k, mean.dtype).to(mean.device) if noise is None else noise
    drawn = mean[:, :, None] + torch.einsum("cmij,pj->cmpi", outcomes.factor, points)
    return drawn.flatten(1, 2), mean


def reweight(
    log_likelihood: Float[Tensor, "c n m"], weights: Float[Tensor, "c m"]
) -> tuple[Float[Tensor, "c n m"], Float[Tensor, "c n"]]:
    """Weights after each outcome, and the log of what they were divided by."""
    joint = log_likelihood + weights.log()[:, None]
    # As logsumexp does it, with the exponentials taken once for both.
    peak = joint.detach().amax(-1, keepdim=True)
    relative = (joint - peak).exp()
    total = relative.sum(-1, keepdim=True)
    return relative / total, (peak + total.log())[..., 0]


def cubature_points(k: int, dtype: torch.dtype = torch.float64) -> Float[Tensor, "p k"]:
    """The 2 k points of spherical cubature for a standard normal of k dimensions."""
    one = math.sqrt(k) * torch.eye(k, dtype=dtype)
    return torch.cat((one, -one))


def split_commands(outcomes: Outcomes) -> list[Outcomes]:
    """The same in parts of a few commands, small enough for memory."""
    c, m, k = outcomes.mean.shape
    size = max(1, _NUMBERS_AT_ONCE // (2 * k * m * m))
    known = {name: value for name, value in vars(outcomes).items() if value is not None}
    return [
        Outcomes(**{name: value[first : first + size] for name, value in known.items()})
        for first in range(0, c, size)
    ]
