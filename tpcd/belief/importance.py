"""Adaptive importance sampling: give each mode of the posterior its weight.

Markov chains go from one mode to another too rarely, and along a thin bent sheet too slowly.
Draws from a mixture, whose components sit at the modes and at particles, are weighted by the
target; new components are put where the weight is, and all draws are weighted under all
components (AMIS: Cornuet et al. 2012). The mean weight estimates the evidence.

Particles then choose between themselves and a random part of the draws (iterated sampling
importance resampling: Andrieu, Lee and Vihola 2018). That leaves the target invariant for any
number of draws: where the weights are poor, most particles stay what they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.belief.cloud import SamplerSettings, Target
from tpcd.belief.likelihood import Threshold
from tpcd.belief.modes import find_modes
from tpcd.belief.proposals import StudentMixture, newton_mixture
from tpcd.belief.resampling import effective_sample_size, normalise_log_weights

_HOPELESS = 20.0
"""A draw whose log weight is so far below the best one counts as impossible."""
_FEWEST_CENTRES = 50
"""New components are spread as if no draw had more than this share of the weight (1 / count)."""
_GROUPS = 16
"""Groups of particles that look at the same part of the draws."""


@dataclass(frozen=True)
class Draws:
    """n draws from a mixture."""

    positions: Float[Tensor, "n d"]
    log_prior: Float[Tensor, " n"]
    before: Float[Tensor, " n"]
    with_datum: Float[Tensor, " n"]
    log_sum: Float[Tensor, " n"]
    """Log of the sum of the component densities."""


@dataclass(frozen=True)
class Pool:
    """The draws of all rounds, from the joint mixture of all rounds, and their weights."""

    draws: Draws
    log_weights: Float[Tensor, " n"]
    mixture: StudentMixture
    last: StudentMixture
    """The components of the last round."""
    modes: Float[Tensor, "k d"]
    """Where components climbed to, from which the next datum starts."""
    evaluations: int

    @property
    def log_evidence(self) -> float:
        """Log of the mean weight."""
        return float(torch.logsumexp(self.log_weights, 0)) - math.log(len(self.log_weights))

    @property
    def log_evidence_std(self) -> float:
        """Its standard error, from the variance of the weights."""
        effective = effective_sample_size(normalise_log_weights(self.log_weights))
        return math.sqrt(max(1.0 / effective - 1.0 / len(self.log_weights), 0.0))


def draw_pool(
    target: Target,
    cloud: Float[Tensor, "m d"],
    remembered: Float[Tensor, "k d"],
    settings: SamplerSettings,
    generator: torch.Generator,
) -> Pool:
    """Draws weighted by the target, from components that start at the cloud and the modes."""
    spread, components = cloud.std(0), settings.at_most(settings.components)
    modes, first, evaluations = find_modes(target, remembered, spread, settings, generator)
    around = mixture_of_cloud(target, cloud, 1.0, settings, generator)
    mixture = last = StudentMixture.joined([first, around])
    pool, log_weights = None, cloud.new_zeros(0)
    for _ in range(settings.importance_rounds):
        if pool is not None:
            chosen = _spread_choice(log_weights, components, generator)
            centres = pool.positions[chosen]
            last = newton_mixture(centres, *target.curvature(centres, spread, 1.0))
            sums = torch.logaddexp(pool.log_sum, last.log_sum(pool.positions))
            pool = replace(pool, log_sum=sums)
            mixture = StudentMixture.joined([mixture, last])
        component = torch.arange(len(last.mean)).repeat(settings.draws_per_component)
        new = _draw(target, last, mixture, component, log_weights, generator)
        evaluations += len(component)
        pool = new if pool is None else _join(pool, new)
        height = pool.log_prior + pool.with_datum
        height = torch.where(torch.isfinite(height), height, -torch.inf)
        log_weights = height - pool.log_sum + math.log(len(mixture.mean))
    assert pool is not None
    return Pool(pool, log_weights, mixture, last, modes, evaluations)


def mixture_of_cloud(
    target: Target,
    cloud: Float[Tensor, "m d"],
    temperature: float,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> StudentMixture:
    """Components at some of the particles, for the target with its new datum tempered."""
    count = settings.at_most(settings.components)
    centres = cloud[torch.randperm(len(cloud), generator=generator)[:count]]
    return newton_mixture(centres, *target.curvature(centres, cloud.std(0), temperature))


def exchange(
    log_weights: Float[Tensor, " m"],
    pool: Float[Tensor, " n"],
    share: float,
    generator: torch.Generator,
) -> tuple[Bool[Tensor, " m"], Int[Tensor, " m"]]:
    """Which particles leave for a draw of the pool, and which one.

    Each looks at a random share of the pool and chooses among these draws and itself in
    proportion to the weights (of the target relative to the mixture, on one scale). Some
    particles look at the same share.
    """
    leaves = torch.zeros(len(log_weights), dtype=torch.bool)
    chosen = torch.zeros(len(log_weights), dtype=torch.int64)
    group = torch.randint(_GROUPS, (len(log_weights),), generator=generator)
    for i in range(_GROUPS):
        members = torch.nonzero(group == i).flatten()
        seen = torch.rand(len(pool), generator=generator) < share
        offered = torch.where(seen, pool, -torch.inf)
        total = torch.logsumexp(offered, 0)
        if len(members) == 0 or not bool(torch.isfinite(total)):
            continue
        odds = torch.rand(len(members), generator=generator, dtype=pool.dtype)
        leaves[members] = odds.logit() < total - log_weights[members]
        chosen[members] = torch.multinomial(
            (offered - total).exp(), len(members), replacement=True, generator=generator
        )
    return leaves, chosen


def _draw(
    target: Target,
    last: StudentMixture,
    mixture: StudentMixture,
    component: Tensor,
    log_weights: Tensor,
    generator: torch.Generator,
) -> Draws:
    """One draw from each of the named components of the last round."""
    positions = last.draw(component, generator)
    log_sum, log_prior = mixture.log_sum(positions), target.log_prior(positions)
    best = float(log_weights.max()) if len(log_weights) else -torch.inf
    least = best - _HOPELESS + log_sum - math.log(len(mixture.mean)) - log_prior
    least = torch.where(torch.isfinite(log_prior), least, torch.inf)
    before, with_datum = target.log_likelihood(positions, Threshold(least))
    return Draws(positions, log_prior, before, with_datum, log_sum)


def _join(first: Draws, second: Draws) -> Draws:
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return Draws(*(torch.cat(pair) for pair in pairs))


def _spread_choice(log_weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices drawn by weight, none of which may take more than a small share."""
    weights = normalise_log_weights(log_weights)
    for _ in range(30):
        weights = weights.clamp_max(1.0 / _FEWEST_CENTRES)
        weights = weights / weights.sum()
    return torch.multinomial(weights, count, replacement=True, generator=generator)
