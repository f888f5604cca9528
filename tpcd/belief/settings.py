"""Choices of the default estimator: its model, and how many draws it may spend."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from tpcd.effects.protocol import Effect
from tpcd.effects.shape_change import UNCHANGED, ShapeChange
from tpcd.simulator import StepSettings


@dataclass(frozen=True)
class SamplerSettings:
    """Budget of the sampler for one datum; by default what choosing the next move needs."""

    particles: int = 700
    """Particles kept of all draws."""
    places: int = 30
    """Places that each round of importance sampling puts components at, besides the modes."""
    draws_per_place: int = 5
    """Draws at each place."""
    rounds: int = 1
    """Rounds of importance sampling that shape the mixture."""
    draws: int = 1000
    """Draws from the mixture that the rounds arrived at, which are weighted."""
    flat_rounds: int = 3
    """Rounds at most of mixtures in flat coordinates that follow (`flat_rounds`); 0 for none."""
    flat_worth: float = 50.0
    """Effective number of draws of the rounds so far with which the next one is the last."""
    flat_starts: int = 1000
    """Draws at most from all over the prior, and as many places to look for modes from,"""
    flat_enough: int = 300
    """how many draws that agree with the readings in contact are enough,"""
    flat_tried: int = 100
    """how many of those places at most are tried,"""
    flat_climbers: int = 16
    """and how many of these at most set out to climb."""
    flat_draws: int = 300
    """Draws of each flat round but the last."""
    prior_draws: int = 200
    """Draws from the prior at the first datum, falling as 1 / k with datum k."""
    modes: int = 8
    """Modes that are remembered from datum to datum."""
    fresh_modes: int = 8
    """Points from all over the prior that set out to climb to a mode at each datum, besides
    `flat_climbers`."""
    climbing_rounds: int = 2
    """Newton steps before the lower half of those gives up."""
    following_rounds: int = 3
    """Newton steps of the modes that are remembered, and of those that did not give up."""
    rough: bool = True
    """Whether all but the draws that count are of `Target.rough`."""
    full_draws: int = 10
    """Datum up to which `draws` and `flat_draws` are as many as that. Where `assimilate` brings in
    a later datum k they fall as 1 / k, to half or 100, since each takes k transitions to weigh."""

    def __post_init__(self) -> None:
        """Refuse budgets without meaning."""
        least = {
            "particles": 16,
            "places": 1,
            "draws_per_place": 1,
            "rounds": 1,
            "flat_rounds": 0,
            "flat_worth": 0,
            "flat_starts": 1,
            "flat_enough": 1,
            "flat_tried": 1,
            "flat_climbers": 1,
            "flat_draws": 100,
            "draws": 100,
            "prior_draws": 1,
            "modes": 1,
            "fresh_modes": 1,
            "climbing_rounds": 0,
            "following_rounds": 0,
            "full_draws": 1,
        }
        for name, limit in least.items():
            if not getattr(self, name) >= limit:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least {limit}")

    def at(self, datum: int) -> SamplerSettings:
        """The budget that datum 1, 2, ... has."""
        share = min(1.0, max(0.5, self.full_draws / datum))
        draws, flat_draws = (max(100, round(share * n)) for n in (self.draws, self.flat_draws))
        return replace(self, draws=draws, flat_draws=flat_draws)

    def scaled(self, share: float) -> SamplerSettings:
        """The same with such a share of the draws in flat coordinates, of those that count and of
        the points that climb, but no fewer than `SamplerSettings()` has. The rounds before, from
        `places`, stay."""
        least = SamplerSettings()
        names = ("draws", "flat_starts", "flat_enough", "flat_tried", "flat_climbers")
        names = (*names, "flat_draws", "prior_draws", "fresh_modes")
        fewer = {n: max(getattr(least, n), round(share * getattr(self, n))) for n in names}
        return replace(self, **fewer)


CLOSING_SAMPLER = SamplerSettings(
    places=100,
    draws_per_place=9,
    rounds=2,
    draws=20_000,
    flat_rounds=8,
    flat_worth=math.inf,
    flat_starts=60_000,
    flat_enough=10_000,
    flat_tried=6000,
    flat_climbers=960,
    flat_draws=3000,
    prior_draws=1500,
    modes=40,
    fresh_modes=960,
    rough=False,
)
"""Budget of the belief that is left once no more data are to come."""


@dataclass(frozen=True)
class EstimatorSettings:
    """Choices of the default estimator."""

    sampler: SamplerSettings = field(default_factory=SamplerSettings)
    """Budget of the sampler after each transition."""
    closing: SamplerSettings = CLOSING_SAMPLER
    """Budget once no more data are to come (see `refine`), for as many particles as the other."""
    closing_passes: int = 4
    """Times at most that mixtures in flat coordinates are adapted, each time from where draws of
    those before lie."""
    closing_worth: float = 150.0
    """Effective number of closing draws with which they need not be adapted again."""
    step: StepSettings = field(default_factory=StepSettings)
    """The quasi-static model."""
    likelihood_power: float = 0.92
    """Power to which the likelihood is raised, for what it linearises: measured (eval/README.md),
    the power at which 90 % of the intervals of theta hold the truth given all else. An evidence is
    of the likelihood to this power too; 1 is that of Bayes."""
    misfit_sd: float | None = None
    """Median of the standard deviation of the outline misfit [m] before any datum; None takes
    the shape model's own figures, of the median and of the spread."""
    misfit_spread: float | None = None
    """Standard deviation of the logarithm of that standard deviation; 0 makes it known. None takes
    that of the shape model, where it is more than the least, or the least for a given median."""
    least_misfit_spread: float = 1.0
    """Some objects are like none that the spread was measured on."""
    least_misfit_sd: float = 1e-4
    """The median is never taken to be less than this [m]."""
    shape: ShapeChange = UNCHANGED
    """What is expected of the object besides what the shape model says; a given `misfit_sd` is
    taken as it is."""
    effects: tuple[Effect, ...] = ()
    """Effects that the model has besides, whose parameters are estimated with theta."""
    effect_draws: int = 3
    """Times as many draws where there are effects: with what was missing in the model the
    posterior is narrower, and its best modes are missed more easily."""

    def __post_init__(self) -> None:
        """Refuse choices without meaning."""
        if not self.closing_passes >= 1:
            raise ValueError(f"closing_passes is {self.closing_passes}, expected at least 1")
        if not 0 < self.likelihood_power <= 1:
            raise ValueError(
                f"likelihood_power is {self.likelihood_power}, expected above 0 and at most 1"
            )
        for name in ("misfit_sd", "misfit_spread", "least_misfit_spread", "least_misfit_sd"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise ValueError(f"{name} is {value}, expected a finite number of at least 0")
        if not self.closing_worth >= 0:
            raise ValueError(f"closing_worth is {self.closing_worth}, expected at least 0")

    @property
    def budget(self) -> SamplerSettings:
        """Of the sampler, for the model with its effects."""
        return replace(self.sampler, draws=self._more * self.sampler.draws)

    @property
    def closing_budget(self) -> SamplerSettings:
        """The same once all data are in."""
        draws = self._more * self.closing.draws
        return replace(self.closing, particles=self.sampler.particles, draws=draws)

    @property
    def _more(self) -> int:
        return self.effect_draws if self.effects else 1
