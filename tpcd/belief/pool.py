"""Weighted draws from the proposal that adaptation arrived at, and what to do with weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import Cloud, CloudInfo, Target
from tpcd.belief.pareto import tail_shape
from tpcd.belief.proposals import CurvedMixture
from tpcd.belief.resampling import (
    effective_sample_size,
    normalise_log_weights,
    systematic_resample,
)

_HOPELESS = 20.0
"""A draw whose log weight is so far below the best one counts as impossible."""


@dataclass(frozen=True)
class Proposal:
    """The prior, drawn from so often, beside a mixture."""

    mixture: CurvedMixture
    from_prior: int

    def beside(self, other: Proposal) -> Proposal:
        """Both together."""
        mixture = CurvedMixture.joined([self.mixture, other.mixture])
        return Proposal(mixture, self.from_prior + other.from_prior)

    def log_density(
        self, positions: Float[Tensor, "n d"], log_prior: Float[Tensor, " n"]
    ) -> Float[Tensor, " n"]:
        """Log density of prior and mixture together."""
        total = float(self.mixture.counts.sum()) + self.from_prior
        prior = log_prior + math.log(self.from_prior)
        return torch.logaddexp(self.mixture.log_sum(positions), prior) - math.log(total)

    def draw(
        self, target: Target, count: int, generator: torch.Generator
    ) -> Float[Tensor, "count d"]:
        """So many draws, shared out over prior and components."""
        total = float(self.mixture.counts.sum()) + self.from_prior
        from_prior = round(count * self.from_prior / total)
        plain = target.sample(from_prior, generator)
        return torch.cat((plain, self.mixture.draw_some(count - from_prior, generator)))


@dataclass(frozen=True)
class Pool:
    """The draws that count, and their weights."""

    positions: Float[Tensor, "n d"]
    log_likelihood: Float[Tensor, " n"]
    log_weights: Float[Tensor, " n"]
    """Log of posterior (not normalised) over proposal density."""
    modes: Float[Tensor, "k d"]
    """Where points climbed to, from which the next datum starts."""
    shares: Float[Tensor, " t"]
    """What draws with each damping were worth."""
    evaluations: int

    @property
    def effective_sample_size(self) -> float:
        """Kish's number of the draws."""
        return effective_sample_size(known_weights(self.log_weights))

    @property
    def log_evidence(self) -> float:
        """Log of the mean weight."""
        return float(torch.logsumexp(self.log_weights, 0)) - math.log(len(self.log_weights))

    @property
    def log_evidence_std(self) -> float:
        """Its standard error, from the variance of the weights."""
        spread = 1.0 / self.effective_sample_size - 1.0 / len(self.log_weights)
        return math.sqrt(max(spread, 0.0))

    def cloud(self, particles: int, generator: torch.Generator, power: float = 1.0) -> Cloud:
        """So many particles drawn by weight, or by weights with a `power` of the likelihood."""
        log_weights = tempered(self.log_weights, self.log_likelihood, power)
        weights = truncate(known_weights(log_weights))
        index, counts = systematic_resample(weights, particles, generator).unique(
            return_counts=True
        )
        return Cloud(
            positions=self.positions[index],
            weights=counts.double() / particles,
            log_likelihood=self.log_likelihood[index],
            log_evidence=self.log_evidence,
            log_evidence_std=self.log_evidence_std,
            modes=self.modes,
            shares=self.shares,
        )

    def info(self, rounds: int, distinct: int) -> CloudInfo:
        """What the draws cost and are worth, where so many rounds shaped the mixture and so many
        of the draws are particles."""
        return CloudInfo(
            rounds=rounds,
            draws=len(self.log_weights),
            effective_sample_size=self.effective_sample_size,
            tail_shape=tail_shape(self.log_weights),
            distinct=distinct,
            evaluations=self.evaluations,
        )


def weigh(
    target: Target,
    proposal: Proposal,
    count: int,
    best: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, log likelihoods and log weights of draws from a proposal.

    `best` is the highest log weight known; draws far below it are given up on the way.
    """
    positions = proposal.draw(target, count, generator)
    log_prior = target.log_prior(positions)
    density = proposal.log_density(positions, log_prior)
    log_likelihood = target.log_likelihood(positions, threshold(best, density, log_prior))
    if not bool((log_likelihood > -torch.inf).any()):
        # A single trial draw of a weight beyond all others must not rule all draws out.
        log_likelihood = target.log_likelihood(positions, None)
    return positions, log_likelihood, finite(log_prior + log_likelihood - density)


def threshold(best: float, density: Tensor, log_prior: Tensor) -> Tensor:
    """Log likelihood from which a draw is worth weighing; infinite where the prior is zero."""
    least = best - _HOPELESS + density - log_prior
    return torch.where(torch.isfinite(log_prior), least, torch.inf)


def tempered(
    log_weights: Float[Tensor, " n"], log_likelihood: Float[Tensor, " n"], power: float
) -> Float[Tensor, " n"]:
    """Log weights with a power of the likelihood in place of the likelihood itself."""
    return finite(log_weights - (1 - power) * log_likelihood)


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
