"""Adaptive importance sampling of a growing history.

At each datum, trial draws from a mixture are weighted by the posterior of the whole history.
The first components sit at modes and at particles of the datum before, a Newton step on; later
ones where the weight is. All trial draws are weighted under the components of all rounds and
the prior, which takes part with draws of its own (AMIS: Cornuet et al. 2012).

A trial draw that became the centre of a component has made its own density large, and its
weight too small. So the trial only shapes the mixture: what counts are new draws from it
(Marin, Pudlo and Sedki 2019), whose mean weight estimates the evidence. Where too few of them
count, they shape the mixture once more and all is drawn anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import Cloud, CloudInfo, SamplerSettings, Target
from tpcd.belief.modes import CURVATURE_COST, climb, climbing_cost, find_modes
from tpcd.belief.pareto import tail_shape
from tpcd.belief.proposals import CurvedMixture, curved_mixture
from tpcd.belief.resampling import (
    effective_sample_size,
    normalise_log_weights,
    systematic_resample,
)

_HOPELESS = 20.0
"""A draw whose log weight is so far below the best one counts as impossible."""
_LEAST_SHARE = 0.02
"""Share of the draws that each damping keeps at least."""
_FEWEST_PLACES = 300.0
"""Places are chosen as if no draw had more than this share of the weight (1 / count), so that
components also go where the draws found little so far."""


@dataclass(frozen=True)
class Pool:
    """The draws that count, from the mixture that the rounds arrived at, and their weights."""

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
        return effective_sample_size(_weights(self.log_weights))

    @property
    def log_evidence(self) -> float:
        """Log of the mean weight."""
        return float(torch.logsumexp(self.log_weights, 0)) - math.log(len(self.log_weights))

    @property
    def log_evidence_std(self) -> float:
        """Its standard error, from the variance of the weights."""
        spread = 1.0 / self.effective_sample_size - 1.0 / len(self.log_weights)
        return math.sqrt(max(spread, 0.0))


def assimilate(
    cloud: Cloud,
    target: Target,
    datum: int,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> tuple[Cloud, CloudInfo]:
    """The cloud of the history with datum 1, 2, ... as its last one, from the cloud before.

    Raises ValueError where no particle can explain the datum at all.
    """
    pool = draw_pool(cloud, target, datum, settings, generator)
    weights = truncate(_weights(pool.log_weights))
    index, counts = systematic_resample(weights, settings.particles, generator).unique(
        return_counts=True
    )
    after = Cloud(
        positions=pool.positions[index],
        weights=counts.double() / settings.particles,
        log_likelihood=pool.log_likelihood[index],
        log_evidence=pool.log_evidence,
        log_evidence_std=pool.log_evidence_std,
        modes=pool.modes,
        shares=pool.shares,
    )
    info = CloudInfo(
        rounds=settings.rounds,
        draws=len(pool.log_weights),
        effective_sample_size=pool.effective_sample_size,
        tail_shape=tail_shape(pool.log_weights),
        distinct=len(index),
        evaluations=pool.evaluations,
    )
    return after, info


def draw_pool(
    cloud: Cloud,
    target: Target,
    datum: int,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> Pool:
    """Adapt a mixture that starts at the cloud and the modes, and draw from it."""
    peaks = find_modes(target, cloud.modes, settings, generator)
    followed, evaluations = _follow(cloud, target, settings, generator)
    shares = cloud.shares
    counts = _counts(shares, settings.draws_per_place)
    mixture = CurvedMixture.joined(
        [
            curved_mixture(peaks.points, peaks.gradient, peaks.information, counts),
            curved_mixture(followed, *target.curvature(followed), counts),
        ]
    )
    evaluations += peaks.evaluations + CURVATURE_COST * len(followed)
    trial = _of_prior(target, max(1, settings.prior_draws // datum), generator)
    for left in reversed(range(settings.rounds)):
        trial, by_damping = trial.add(target, mixture, generator)
        log_weights = trial.log_weights
        weights = cut_off(_weights(log_weights), math.sqrt(len(log_weights)))
        worth = weights @ by_damping.softmax(-1).nan_to_num(0.0)
        shares = worth.clamp_min(_LEAST_SHARE) / worth.clamp_min(_LEAST_SHARE).sum()
        if left == 0:
            break
        centres = trial.positions[_spread_choice(log_weights, settings.places, generator)]
        counts = _counts(shares, settings.draws_per_place)
        mixture = curved_mixture(centres, *target.curvature(centres), counts)
        evaluations += CURVATURE_COST * len(centres)
    evaluations += len(trial.positions)
    mixture = trial.mixture
    assert mixture is not None
    for left in reversed(range(settings.attempts)):
        drawn = trial.draw(target, mixture, settings.draws, generator)
        positions, log_likelihood, log_weights = drawn
        evaluations += len(positions)
        if left == 0 or effective_sample_size(_weights(log_weights)) >= settings.wanted:
            break
        # What the draws found shapes the mixture, from which all is drawn anew.
        centres = positions[_spread_choice(log_weights, settings.places, generator)]
        counts = _counts(shares, settings.draws_per_place)
        fresh = curved_mixture(centres, *target.curvature(centres), counts)
        mixture = CurvedMixture.joined([mixture, fresh])
        evaluations += CURVATURE_COST * len(centres)
    return Pool(positions, log_likelihood, log_weights, peaks.points, shares, evaluations)


def _counts(shares: Tensor, total: int) -> Tensor:
    """Whole numbers near shares of the total, by the largest remainders."""
    whole = (shares * total).floor()
    missing = int(total - whole.sum())
    whole[(shares * total - whole).topk(missing).indices] += 1
    return whole


def _weights(log_weights: Tensor) -> Tensor:
    if not bool((log_weights > -torch.inf).any()):
        raise ValueError(
            "no particle explains the new datum (every likelihood is zero or NaN); "
            "check units and frames of the data against the priors"
        )
    return normalise_log_weights(log_weights)


def truncate(weights: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Weights of which none counts more than sqrt(n) times the mean one: a bias that vanishes
    with n, against draws in places that the mixture hardly reaches (Ionides 2008)."""
    kept = weights.clamp_max(weights.mean() * math.sqrt(len(weights)))
    return kept / kept.sum()


def cut_off(weights: Float[Tensor, " n"], count: float) -> Float[Tensor, " n"]:
    """Weights of which none is more than 1 / count of their sum, by and large.

    The cut is repeated, since each one lowers the sum; n weights must be more than `count`.
    """
    for _ in range(30):
        weights = weights.clamp_max(1.0 / count)
        weights = weights / weights.sum()
    return weights


@dataclass(frozen=True)
class _Draws:
    """Draws from the prior and from the components of all rounds."""

    positions: Tensor
    log_prior: Tensor
    log_likelihood: Tensor
    log_sum: Tensor
    """Log of the sum of the densities that all of them were drawn from."""
    mixture: CurvedMixture | None
    from_prior: int

    @property
    def log_weights(self) -> Tensor:
        found = self.log_prior + self.log_likelihood - self.log_sum
        found = torch.where(torch.isfinite(found), found, -torch.inf)
        return found + math.log(len(self.positions))

    def add(
        self, target: Target, last: CurvedMixture, generator: torch.Generator
    ) -> tuple[_Draws, Tensor]:
        """With the draws of one more round, all of them under the components of all rounds, and
        the log sums of the last components by damping."""
        new = last.draw(generator)
        positions = torch.cat((self.positions, new))
        by_damping = last.log_sums(positions)
        log_prior = target.log_prior(new)
        log_sum = log_prior + math.log(self.from_prior)
        if self.mixture is not None:
            log_sum = torch.logaddexp(log_sum, self.mixture.log_sum(new))
        log_sum = torch.logaddexp(
            torch.cat((self.log_sum, log_sum)), torch.logsumexp(by_damping, -1)
        )
        best = self.log_weights.max() - math.log(len(self.positions))
        least = best - _HOPELESS + log_sum[-len(new) :] - log_prior
        least = torch.where(torch.isfinite(log_prior), least, torch.inf)
        draws = _Draws(
            positions,
            torch.cat((self.log_prior, log_prior)),
            torch.cat((self.log_likelihood, target.log_likelihood(new, least))),
            log_sum,
            last if self.mixture is None else CurvedMixture.joined([self.mixture, last]),
            self.from_prior,
        )
        return draws, by_damping

    def draw(
        self, target: Target, mixture: CurvedMixture, count: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """So many draws from prior and components together: positions, log likelihoods and log
        weights."""
        total = float(mixture.counts.sum()) + self.from_prior
        from_prior = round(count * self.from_prior / total)
        positions = torch.cat(
            (
                target.sample(from_prior, generator),
                mixture.draw_some(count - from_prior, generator),
            )
        )
        log_prior = target.log_prior(positions)
        density = torch.logaddexp(
            mixture.log_sum(positions), log_prior + math.log(self.from_prior)
        ) - math.log(total)
        least = self.log_weights.max() - _HOPELESS + density - log_prior
        least = torch.where(torch.isfinite(log_prior), least, torch.inf)
        log_likelihood = target.log_likelihood(positions, least)
        log_weights = log_prior + log_likelihood - density
        return (
            positions,
            log_likelihood,
            torch.where(torch.isfinite(log_weights), log_weights, -torch.inf),
        )


def _of_prior(target: Target, count: int, generator: torch.Generator) -> _Draws:
    positions = target.sample(count, generator)
    log_prior = target.log_prior(positions)
    log_likelihood = target.log_likelihood(positions, None)
    return _Draws(positions, log_prior, log_likelihood, log_prior + math.log(count), None, count)


def _follow(
    cloud: Cloud, target: Target, settings: SamplerSettings, generator: torch.Generator
) -> tuple[Tensor, int]:
    """Particles that explain the new datum best, a damped Newton step on, and the cost."""
    gain = target.log_likelihood(cloud.positions, None) - cloud.log_likelihood
    log_weights = torch.where(torch.isfinite(gain), gain, -torch.inf) + cloud.weights.log()
    if not bool(torch.isfinite(log_weights).any()):
        # Nobody explains it; the places then are those of the history before.
        log_weights = cloud.weights.log()
    places = cloud.positions[_spread_choice(log_weights, settings.places, generator)]
    followed, _ = climb(target, places, 1)
    return followed, len(gain) + climbing_cost(len(places), 1)


def _spread_choice(log_weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices drawn by weight, none of which may take more than a small share."""
    weights = cut_off(_weights(log_weights), _FEWEST_PLACES)
    return torch.multinomial(weights, count, replacement=True, generator=generator)
