"""Tempered sequential Monte Carlo for a growing history (Del Moral, Doucet and Jasra 2006).

A cloud of equally weighted particles represents the posterior of the history so far. A new
datum is brought in by degrees: the log likelihood goes from the old history to the new one
through temperatures chosen so that half of the effective sample size is kept each time;
after each, particles are resampled and moved by Metropolis-Hastings steps that leave the
tempered posterior invariant. Moves alternate between independent draws from a mixture that
follows the curvature of the target and local steps in the shape of its components. Once the
datum is in, particles exchange themselves for draws of `importance`, which also estimate the
evidence, and are moved again.

The target is any function of unconstrained coordinates: the contact model in `Belief`, a
linear-normal model with known answers in the tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpcd.belief.cloud import Cloud, CloudInfo, SamplerSettings, Target
from tpcd.belief.importance import Pool, draw_pool, exchange, mixture_of_cloud
from tpcd.belief.likelihood import Threshold
from tpcd.belief.proposals import StudentMixture
from tpcd.belief.resampling import (
    effective_sample_size,
    normalise_log_weights,
    systematic_resample,
)


def assimilate(
    cloud: Cloud,
    target: Target,
    settings: SamplerSettings,
    generator: torch.Generator,
    count: int | None = None,
) -> tuple[Cloud, CloudInfo]:
    """Bring one datum into the cloud, which then has `count` particles (None: as before).

    Raises ValueError where no particle can explain the datum at all.
    """
    cloud = replace(cloud, ancestor=torch.arange(len(cloud.positions)))
    state = _State(cloud, *target.log_likelihood(cloud.positions, None))
    tally = _Tally(evaluations=len(cloud.positions))
    temperature, smallest = 0.0, float(len(cloud.positions))
    while temperature < 1.0:
        gain = state.with_datum - state.before
        gain = torch.where(torch.isfinite(gain), gain, -torch.inf)
        advance = _next_temperature(gain, temperature, settings.kept_share) - temperature
        weights = normalise_log_weights(advance * gain)
        smallest = min(smallest, effective_sample_size(weights))
        state = state.take(systematic_resample(weights, count or len(weights), generator))
        temperature += advance
        tally.temperatures += 1
        if temperature < 1.0:
            here = state.cloud.positions
            mixture = mixture_of_cloud(target, here, temperature, settings, generator)
            moves = settings.tempering_moves
            state = _move(state, mixture, moves, temperature, target, settings, generator, tally)
    pool = draw_pool(target, state.cloud.positions, state.cloud.modes, settings, generator)
    tally.evaluations += pool.evaluations
    state = _exchange(state, pool, settings, generator)
    state = _move(state, pool.last, settings.final_moves, 1.0, target, settings, generator, tally)
    cloud = replace(state.cloud, log_likelihood=state.with_datum)
    info = CloudInfo(
        temperatures=tally.temperatures,
        moves=tally.moves,
        acceptance_independent=tally.rate("independent"),
        acceptance_local=tally.rate("local"),
        effective_sample_size=smallest,
        distinct_ancestors=int(cloud.ancestor.unique().numel()),
        evaluations=tally.evaluations,
    )
    return cloud, info


@dataclass(frozen=True)
class _State:
    cloud: Cloud
    before: Tensor
    with_datum: Tensor

    def take(self, index: Tensor) -> _State:
        cloud = self.cloud
        cloud = replace(
            cloud,
            positions=cloud.positions[index],
            log_prior=cloud.log_prior[index],
            log_likelihood=cloud.log_likelihood[index],
            ancestor=cloud.ancestor[index],
        )
        return _State(cloud, self.before[index], self.with_datum[index])


@dataclass
class _Tally:
    evaluations: int = 0
    temperatures: int = 0
    moves: int = 0
    proposed: dict[str, int] | None = None
    accepted: dict[str, int] | None = None

    def count(self, kind: str, proposed: int, accepted: int) -> None:
        self.proposed = self.proposed or {}
        self.accepted = self.accepted or {}
        self.proposed[kind] = self.proposed.get(kind, 0) + proposed
        self.accepted[kind] = self.accepted.get(kind, 0) + accepted
        self.evaluations += proposed
        self.moves += 1

    def rate(self, kind: str) -> float:
        proposed = (self.proposed or {}).get(kind, 0)
        return (self.accepted or {}).get(kind, 0) / proposed if proposed else 0.0


def _next_temperature(gain: Tensor, temperature: float, kept_share: float) -> float:
    """Largest temperature whose weights keep the share of effective samples, by bisection."""
    finite = torch.isfinite(gain)
    target = kept_share * float(finite.sum())
    if target == 0:
        raise ValueError(
            "no particle explains the new datum (every likelihood is zero or NaN); "
            "check units and frames of the data against the priors"
        )

    def enough(step: float) -> bool:
        return effective_sample_size(normalise_log_weights(step * gain)) >= target

    whole = 1.0 - temperature
    if enough(whole):
        return 1.0
    low, high = 0.0, whole
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return temperature + max(low, 1e-12)


def _exchange(
    state: _State, pool: Pool, settings: SamplerSettings, generator: torch.Generator
) -> _State:
    """Particles choose between themselves and the pool, which also knows the evidence."""
    cloud = state.cloud
    weights = cloud.log_prior + state.with_datum - pool.mixture.log_density(cloud.positions)
    leaves, index = exchange(weights, pool.log_weights, settings.pool_share, generator)
    draws, count = pool.draws, len(cloud.positions)
    cloud = replace(
        cloud,
        positions=torch.where(leaves[:, None], draws.positions[index], cloud.positions),
        log_prior=torch.where(leaves, draws.log_prior[index], cloud.log_prior),
        ancestor=torch.where(leaves, count + index, cloud.ancestor),
        modes=pool.modes,
        log_evidence=pool.log_evidence,
        log_evidence_std=pool.log_evidence_std,
    )
    return _State(
        cloud,
        torch.where(leaves, draws.before[index], state.before),
        torch.where(leaves, draws.with_datum[index], state.with_datum),
    )


def _move(
    state: _State,
    mixture: StudentMixture,
    moves: int,
    temperature: float,
    target: Target,
    settings: SamplerSettings,
    generator: torch.Generator,
    tally: _Tally,
) -> _State:
    """Metropolis-Hastings moves that leave the tempered posterior invariant."""
    share_independent = settings.independent_share
    of_here = mixture.log_densities(state.cloud.positions)
    for move in range(moves):
        here = state.cloud.positions
        # Independent moves come due at their share of all moves so far, the first one first.
        due = math.ceil((move + 1) * share_independent) - math.ceil(move * share_independent)
        independent = due > 0
        if independent:
            proposal = mixture.sample(len(here), generator)
            of_there = mixture.log_densities(proposal)
            correction = torch.logsumexp(of_here, -1) - torch.logsumexp(of_there, -1)
        else:
            # A step in the shape of a component, drawn by what it has to do with the place.
            component = torch.multinomial(of_here.softmax(-1), 1, generator=generator)
            noise = torch.randn(here.shape, generator=generator, dtype=here.dtype)
            step = mixture.stretch(component[:, 0], noise)
            proposal = here + state.cloud.step_scale * step
            of_there = mixture.log_densities(proposal)
            there, back = (
                v.log_softmax(-1).gather(1, component)[:, 0] for v in (of_here, of_there)
            )
            correction = back - there
        prior = target.log_prior(proposal)
        old = state.cloud.log_prior + state.before + temperature * (state.with_datum - state.before)
        uniform = torch.rand(len(here), generator=generator, dtype=torch.float64)
        least = uniform.log() + old - correction - prior
        least = torch.where(torch.isnan(least), torch.inf, least)
        before, with_datum = target.log_likelihood(proposal, Threshold(least, temperature))
        # Below its threshold a proposal may come back as -inf, and -inf - -inf is no number.
        accepted = before + temperature * (with_datum - before) > least
        share = float(accepted.double().mean())
        scale = state.cloud.step_scale
        if not independent:
            scale *= math.exp(share - 0.25)
        cloud = replace(
            state.cloud,
            positions=torch.where(accepted[:, None], proposal, here),
            log_prior=torch.where(accepted, prior, state.cloud.log_prior),
            step_scale=scale,
        )
        state = _State(
            cloud,
            torch.where(accepted, before, state.before),
            torch.where(accepted, with_datum, state.with_datum),
        )
        of_here = torch.where(accepted[:, None], of_there, of_here)
        tally.count("independent" if independent else "local", len(here), int(accepted.sum()))
    return state
