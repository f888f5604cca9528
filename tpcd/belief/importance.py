"""Adaptive importance sampling of a growing history.

At each datum, trial draws from a mixture are weighted by the posterior of the whole history.
The first components sit at modes and at particles of the datum before, a Newton step on; later
ones where the weight is. All trial draws are weighted under the components of all rounds and
the prior, which takes part with draws of its own (AMIS: Cornuet et al. 2012).

A trial draw that became the centre of a component has made its own density large, and its
weight too small. So the trial only shapes the mixture: what counts are new draws from it
(Marin, Pudlo and Sedki 2019), whose mean weight estimates the evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpcd.belief.cloud import Cloud, CloudInfo, Counted, Target
from tpcd.belief.flat_rounds import adapt_flat, begin
from tpcd.belief.flat_start import flat_starts
from tpcd.belief.modes import Climbers, climb, find_modes, set_out
from tpcd.belief.pool import Pool, Proposal, weigh
from tpcd.belief.proposals import CurvedMixture, curved_mixture
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.weights import (
    TRUSTED,
    evened,
    finite,
    known_weights,
    spread_choice,
    threshold,
)
from tpcd.threads import torch_in_one_thread

_LEAST_SHARE = 0.02
"""Share of the draws that each damping keeps at least."""
_EVEN = 2.0
"""Of few draws that have a weight each counts so many times its even share at most."""


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
    settings = settings.at(datum)
    pool = draw_pool(cloud, target, datum, settings, generator)
    after = pool.cloud(settings.particles, generator)
    return after, pool.info(settings.rounds, len(after.weights))


@torch_in_one_thread
def draw_pool(
    cloud: Cloud,
    target: Target,
    datum: int,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> Pool:
    """Adapt a mixture that starts at the cloud and the modes, and draw from it."""
    adapted = adapt(cloud, target, datum, settings, generator)
    return adapted.pool(target, settings.draws, generator)


def adapt(
    cloud: Cloud,
    target: Target,
    datum: int,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> Adapted:
    """A proposal that starts at the cloud and the modes, and goes to where the weight is."""
    exact = Counted(target)
    log_likelihood, contact = exact.log_likelihood_and_contact(cloud.positions)
    brought_on = known_weights(_brought_on(cloud, log_likelihood))
    target = exact.rough() if settings.rough else exact
    begun = None
    if settings.flat_rounds:
        coordinates = target.coordinates(cloud.positions, brought_on, contact)
        begun = flat_starts(target, coordinates, settings, generator)
    fresh = None if begun is None else begun.points
    peaks = find_modes(target, cloud.modes, settings, generator, fresh)
    shares = cloud.shares
    counts = _counts(shares, settings.draws_per_place)
    followers = _follow(cloud, log_likelihood, brought_on.log(), target, settings, generator)
    mixture = CurvedMixture.joined(
        [
            curved_mixture(each.points, each.gradient, each.information, counts)
            for each in (peaks, followers)
        ]
    )
    trial = _of_prior(target, max(1, settings.prior_draws // datum), generator)
    for left in reversed(range(settings.rounds)):
        trial, by_damping = trial.add(target, mixture, generator)
        log_weights = trial.log_weights
        weights = evened(log_weights, math.sqrt(len(log_weights)), _EVEN)
        worth = weights @ by_damping.softmax(-1).nan_to_num(0.0)
        shares = worth.clamp_min(_LEAST_SHARE) / worth.clamp_min(_LEAST_SHARE).sum()
        if left == 0:
            break
        centres = trial.positions[spread_choice(log_weights, settings.places, generator)]
        counts = _counts(shares, settings.draws_per_place)
        mixture = curved_mixture(centres, *target.curvature(centres), counts)
    assert trial.mixture is not None
    proposal = Proposal(trial.mixture, trial.from_prior)
    if begun is not None:
        places = torch.cat((trial.positions, cloud.positions))
        flat = begin(begun, places, torch.cat((weights, brought_on)).log())
        flat = adapt_flat(target, flat, settings, generator)
        proposal = replace(proposal, flat=flat)
    # Not the very best: the weight of a draw in a place that the mixture hardly reaches is chance.
    best = trial.log_weights.topk(min(TRUSTED, len(trial.positions)))
    worth = best.values
    if settings.rough:
        # What is rough may be too high, and would rule out what is right.
        known = exact.log_likelihood(trial.positions[best.indices], None)
        worth = torch.minimum(worth, finite(worth + known - trial.log_likelihood[best.indices]))
        target.evaluations += len(known)
    return Adapted(proposal, float(worth.min()), peaks, shares, target.evaluations)


@dataclass(frozen=True)
class Adapted:
    """What to draw from, and what was learnt on the way."""

    proposal: Proposal
    best: float
    """A log weight that some draws reach."""
    peaks: Climbers
    shares: Tensor
    """What draws with each damping were worth."""
    evaluations: int

    def pool(self, target: Target, count: int, generator: torch.Generator) -> Pool:
        """So many weighted draws."""
        target = Counted(target)
        drawn = weigh(target, self.proposal, count, self.best, generator)
        spent = self.evaluations + target.evaluations
        return Pool(*drawn, self.peaks.points, self.shares, spent)

    def again(
        self, target: Target, pool: Pool, settings: SamplerSettings, generator: torch.Generator
    ) -> Adapted:
        """With further mixtures in flat coordinates, which begin at the draws of a pool."""
        assert self.proposal.flat is not None
        target = Counted(target.rough() if settings.rough else target, pool.evaluations)
        flat = self.proposal.flat.begun(pool.positions, pool.log_weights)
        flat = adapt_flat(target, flat, settings, generator)
        proposal = replace(self.proposal, flat=flat)
        return replace(self, proposal=proposal, evaluations=target.evaluations)


def _counts(shares: Tensor, total: int) -> Tensor:
    """Whole numbers near shares of the total, by the largest remainders."""
    whole = (shares * total).floor()
    missing = int(total - whole.sum())
    whole[(shares * total - whole).topk(missing).indices] += 1
    return whole


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
        found = finite(self.log_prior + self.log_likelihood - self.log_sum)
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
        best = float(self.log_weights.max()) - math.log(len(self.positions))
        least = threshold(best, log_sum[-len(new) :], log_prior)
        draws = _Draws(
            positions,
            torch.cat((self.log_prior, log_prior)),
            torch.cat((self.log_likelihood, target.log_likelihood(new, least))),
            log_sum,
            last if self.mixture is None else CurvedMixture.joined([self.mixture, last]),
            self.from_prior,
        )
        return draws, by_damping


def _of_prior(target: Target, count: int, generator: torch.Generator) -> _Draws:
    positions = target.sample(count, generator)
    log_prior = target.log_prior(positions)
    log_likelihood = target.log_likelihood(positions, None)
    return _Draws(positions, log_prior, log_likelihood, log_prior + math.log(count), None, count)


def _brought_on(cloud: Cloud, log_likelihood: Tensor) -> Tensor:
    """Log weights of the particles with the new datum, from their log likelihoods with it."""
    gain = log_likelihood - cloud.log_likelihood
    log_weights = torch.where(torch.isfinite(gain), gain, -torch.inf) + cloud.weights.log()
    # Where nobody explains it, those of the history before.
    some = bool(torch.isfinite(log_weights).any())
    return log_weights if some else cloud.weights.log()


def _follow(
    cloud: Cloud,
    log_likelihood: Tensor,
    log_weights: Tensor,
    target: Target,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> Climbers:
    """Particles that explain the new datum best, a damped Newton step on; where the exact target
    is higher than the one that is climbed they stay."""
    chosen = spread_choice(log_weights, settings.places, generator)
    places = cloud.positions[chosen]
    height = finite(target.log_prior(places) + log_likelihood[chosen])
    return climb(target, set_out(target, places, height), 1).surveyed(target)
