"""Weighted draws from the proposal that adaptation arrived at, and what to do with weights."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import Cloud, CloudInfo, Target
from tpcd.belief.flat_rounds import FlatProposal
from tpcd.belief.pareto import tail_shape
from tpcd.belief.proposals import CurvedMixture
from tpcd.belief.resampling import effective_sample_size, systematic_resample
from tpcd.belief.weights import finite, known_weights, threshold, truncate

FLAT_SHARE = 0.8
"""Share of the draws from the mixtures in flat coordinates, where there are any."""


@dataclass(frozen=True)
class Proposal:
    """The prior, drawn from so often, a mixture that follows the curvature, and mixtures in flat
    coordinates."""

    mixture: CurvedMixture
    from_prior: int
    flat: FlatProposal | None = None

    def log_density(
        self, positions: Float[Tensor, "n d"], log_prior: Float[Tensor, " n"]
    ) -> Float[Tensor, " n"]:
        """Log density of all of them together."""
        total = float(self.mixture.counts.sum()) + self.from_prior
        prior = log_prior + math.log(self.from_prior)
        found = torch.logaddexp(self.mixture.log_sum(positions), prior) - math.log(total)
        if self.flat is None:
            return found
        flat = self.flat.log_density(positions) + math.log(FLAT_SHARE)
        return torch.logaddexp(found + math.log(1 - FLAT_SHARE), flat)

    def draw(
        self, target: Target, count: int, generator: torch.Generator
    ) -> Float[Tensor, "count d"]:
        """So many draws, shared out over prior and components."""
        in_flat = 0 if self.flat is None else round(count * FLAT_SHARE)
        flat = [] if self.flat is None else [self.flat.draw(in_flat, generator)]
        left = count - in_flat
        total = float(self.mixture.counts.sum()) + self.from_prior
        from_prior = round(left * self.from_prior / total)
        plain = target.sample(from_prior, generator)
        return torch.cat((plain, self.mixture.draw_some(left - from_prior, generator), *flat))


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
    passes: tuple[float, ...] = ()
    """Log evidence by each of the pools that were joined to this one."""

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
        """Its standard error, from the variance of the weights, or where pools were joined from
        what they differ by, if that is more: draws of one pool miss the same together."""
        spread = 1.0 / self.effective_sample_size - 1.0 / len(self.log_weights)
        if len(self.passes) > 1:
            means = (torch.tensor(self.passes, dtype=torch.float64) - max(self.passes)).exp()
            spread = max(spread, float(means.var() / means.mean() ** 2) / len(means))
        return math.sqrt(max(spread, 0.0))

    def cloud(self, particles: int, generator: torch.Generator) -> Cloud:
        """So many particles drawn by weight."""
        weights = truncate(known_weights(self.log_weights))
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

    def beside(self, other: Pool) -> Pool:
        """The draws of two pools of one target as one, each weighted by its own proposal; what the
        next one sets out from is that of the other."""
        return replace(
            other,
            positions=torch.cat((self.positions, other.positions)),
            log_likelihood=torch.cat((self.log_likelihood, other.log_likelihood)),
            log_weights=torch.cat((self.log_weights, other.log_weights)),
            evaluations=self.evaluations + other.evaluations,
            passes=(*(self.passes or (self.log_evidence,)), other.log_evidence),
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
