"""Tempered sequential Monte Carlo for a growing history (Del Moral, Doucet and Jasra 2006).

A cloud of equally weighted particles represents the posterior of the history so far. A new
datum is brought in by degrees: the log likelihood goes from the old history to the new one
through temperatures chosen so that half of the effective sample size is kept each time;
after each, particles are resampled and moved by Metropolis-Hastings steps that leave the
tempered posterior invariant. Moves alternate between independent draws from a mixture
fitted to the cloud and local steps. The product of mean weights estimates the evidence, its
variance comes from the families of common ancestors (Lee and Whiteley 2018).

The target is any function of unconstrained coordinates: the contact model in `Belief`, a
linear-normal model with known answers in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpcd.belief.cloud import Cloud, CloudInfo, LogDensity, SamplerSettings
from tpcd.belief.likelihood import Threshold
from tpcd.belief.proposals import StudentMixture, fit_student_mixture
from tpcd.belief.resampling import (
    effective_sample_size,
    normalise_log_weights,
    systematic_resample,
)

LogLikelihood = Callable[[Tensor, Threshold | None], tuple[Tensor, Tensor]]
"""Coordinates (m, d) to log likelihood (m) of the history before and with the new datum; a
particle that stays below its threshold may get -inf for both."""


def assimilate(
    cloud: Cloud,
    log_prior: LogDensity,
    log_likelihood: LogLikelihood,
    settings: SamplerSettings,
    generator: torch.Generator,
    count: int | None = None,
) -> tuple[Cloud, CloudInfo]:
    """Bring one datum into the cloud, which then has `count` particles (None: as before).

    Raises ValueError where no particle can explain the datum at all.
    """
    state = _State(cloud, *log_likelihood(cloud.positions, None))
    tally = _Tally(evaluations=len(cloud.positions))
    temperature, smallest = 0.0, float(len(cloud.positions))
    mixture = cloud.mixture
    while temperature < 1.0:
        gain = state.with_datum - state.before
        gain = torch.where(torch.isfinite(gain), gain, -torch.inf)
        advance = _next_temperature(gain, temperature, settings.kept_share) - temperature
        log_weights = advance * gain
        weights = normalise_log_weights(log_weights)
        smallest = min(smallest, effective_sample_size(weights))
        state = state.weighted(log_weights, weights)
        mixture = _fit(state.cloud.positions, weights, settings, generator, mixture)
        state = state.take(systematic_resample(weights, count or len(weights), generator))
        temperature += advance
        last = temperature >= 1.0
        state, mixture = _move(
            state,
            mixture,
            temperature,
            last,
            log_prior,
            log_likelihood,
            settings,
            generator,
            tally,
        )
        tally.temperatures += 1
    cloud = replace(state.cloud, log_likelihood=state.with_datum, mixture=mixture)
    cloud = replace(cloud, log_evidence_std=_evidence_std(cloud.ancestor))
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

    def weighted(self, log_weights: Tensor, weights: Tensor) -> _State:
        mean = torch.logsumexp(log_weights, 0) - math.log(len(log_weights))
        cloud = replace(self.cloud, log_evidence=self.cloud.log_evidence + float(mean))
        return replace(self, cloud=cloud)

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


def _fit(
    positions: Tensor,
    weights: Tensor,
    settings: SamplerSettings,
    generator: torch.Generator,
    before: StudentMixture | None,
) -> StudentMixture:
    """The mixture of the cloud; from the one before it takes a few rounds only."""
    rounds = 30 if before is None else 6
    if len(positions) > settings.particles:
        chosen = systematic_resample(weights, settings.particles, generator)
        positions = positions[chosen]
        weights = torch.full_like(weights[chosen], 1.0 / len(chosen))
    return fit_student_mixture(
        positions, weights, settings.components, generator, rounds, start=before
    )


def _move(
    state: _State,
    mixture: StudentMixture,
    temperature: float,
    last: bool,
    log_prior: LogDensity,
    log_likelihood: LogLikelihood,
    settings: SamplerSettings,
    generator: torch.Generator,
    tally: _Tally,
) -> tuple[_State, StudentMixture]:
    """Metropolis-Hastings moves that leave the tempered posterior invariant."""
    even = torch.full_like(state.before, 1.0 / len(state.before))
    spread = torch.linalg.cholesky(_covariance(state.cloud.positions))
    share_independent = settings.independent_share
    for move in range(settings.final_moves if last else settings.tempering_moves):
        if move > 0 and move % settings.moves_per_fit == 0:
            mixture = _fit(state.cloud.positions, even, settings, generator, mixture)
        # Independent moves come due at their share of all moves so far, the first one first.
        due = math.ceil((move + 1) * share_independent) - math.ceil(move * share_independent)
        independent = due > 0
        here = state.cloud.positions
        if independent:
            proposal = mixture.sample(len(here), generator)
            correction = mixture.log_density(here) - mixture.log_density(proposal)
        else:
            noise = torch.randn(here.shape, generator=generator, dtype=here.dtype)
            proposal = here + state.cloud.step_scale * noise @ spread.T
            correction = torch.zeros_like(state.before)
        prior = log_prior(proposal)
        old = state.cloud.log_prior + state.before + temperature * (state.with_datum - state.before)
        uniform = torch.rand(len(here), generator=generator, dtype=torch.float64)
        least = uniform.log() + old - correction - prior
        least = torch.where(torch.isnan(least), torch.inf, least)
        before, with_datum = log_likelihood(proposal, Threshold(least, temperature))
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
        tally.count("independent" if independent else "local", len(here), int(accepted.sum()))
    return state, mixture


def _covariance(positions: Tensor) -> Tensor:
    """Covariance of the cloud, kept away from singular."""
    covariance = torch.cov(positions.T)
    return covariance + 1e-6 * torch.diag(covariance.diagonal().clamp_min(1e-12))


def _evidence_std(ancestor: Tensor) -> float:
    """Standard error of the log evidence from the sizes of the families (Lee and Whiteley)."""
    count = len(ancestor)
    family = torch.bincount(ancestor, minlength=count).double() / count
    return math.sqrt(max(float((family**2).sum()) - 1.0 / count, 0.0))
