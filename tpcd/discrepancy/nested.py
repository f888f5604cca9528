"""What one more effect gains, weighed on the draws of the model without it.

Both evidences of a gain are estimated from the same draws, so that what the search over shapes
has missed is missing in both, and only what the effect adds is left (umbrella or ratio importance
sampling: Chen and Shao, "On Monte Carlo methods for estimating ratios of normalizing constants",
1997). Each draw of theta gets a value of the effect, and moves along with it as the curvature at
the effect's mode says: with x the scores of all else, e the effect's parameters and e0 their null
values, x' = x + B (e - e0). Then

    Z with / Z without = mean of  L(x', e) p(x') p(e) / (L(x) p(x) q(e)),

where q, from which e is drawn, is a normal density of twice the variance that the curvature gives,
cut off where the prior ends, and some of the prior. Where an effect that is there takes the scene
elsewhere, these draws do not go along, and the estimate is too low; a look from all over the prior
(`screening`) tells that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.resampling import effective_sample_size, systematic_resample
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.fit import Fit, Question, fit_stream
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.settings import FEWEST_DRAWS

DRAWS = 600
FROM_PRIOR = 0.3
"""Share of the effect's values that are drawn from all of their prior."""
WIDER = 2.0
"""Factor of the variance of the others over what the curvature says."""
HOPELESS = 8.0
"""A draw that has a log density so much lower with the effect counts as impossible."""
_TRIALS = 20_000
_SEED = 60


@dataclass(frozen=True)
class NestedGain:
    """What an effect gains beside a model, by the draws of that model."""

    gain: float
    """Log of the ratio of the evidences; -inf where no draw with the effect has a weight."""
    std: float
    """Standard error, from what draws of the model differ by; infinite where these are few."""


def nested_gain(question: Question, base: Fit, look: Glance) -> NestedGain:
    """Weigh the effect of a quick look on the draws of the model that it looked beside."""
    effects = (*base.effects, look.effect)
    prior = question.scene.with_effects(effects)
    names = tuple(effect.name for effect in effects)
    key = ("nested", question.fingerprint, names, prior.low, prior.high, base.fingerprint)
    what = f"gain of {look.effect.name} by draws"
    return question.memory.recall(
        what, (*key, look.place), NestedGain, lambda: _weighed(question, base, look)
    )


def _weighed(question: Question, base: Fit, look: Glance) -> NestedGain:
    effects = (*base.effects, look.effect)
    generator = fit_stream(question, effects, _SEED)
    without, with_it = (
        ContactTarget(prior, question.misfit, base.step, question.history)
        for prior in (base.prior, question.scene.with_effects(effects))
    )
    first = base.prior.dimension
    values, log_density, along = _values(look, with_it, first, generator)
    cloud = base.cloud_by_evidence
    chosen = systematic_resample(cloud.weights, len(values), generator)
    chosen = chosen[torch.randperm(len(chosen), generator=generator)]
    draws, reached = cloud.positions[chosen], cloud.log_likelihood[chosen]
    null = torch.tensor([p.null for p in look.effect.parameters], dtype=torch.float64)
    moved = draws + (values - null) @ along.T
    log_prior = without.log_prior(moved)
    level = without.log_prior(draws) + reached - log_prior
    vector = torch.cat((base.prior.to_vector(moved[:, :-1]), values), dim=-1)
    own = with_it.prior.to_score(vector)[:, first:]
    score = torch.cat((moved[:, :-1], own, moved[:, -1:]), dim=-1)
    least = torch.where(torch.isfinite(log_prior), level - HOPELESS, torch.inf)
    log_ratio = with_it.log_likelihood(score, least) - level - log_density
    found = _mean(torch.where(torch.isfinite(log_ratio), log_ratio, -torch.inf), chosen)
    few = effective_sample_size(cloud.weights) < FEWEST_DRAWS
    return replace(found, std=math.inf) if few else found


def _values(
    look: Glance, target: ContactTarget, first: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n p"], Float[Tensor, " n"], Float[Tensor, "s p"]]:
    """Values of the effect's parameters, which come from entry `first` of theta on, the log of
    their density over that of their prior, and how all other scores move with them."""
    prior = target.prior
    own = torch.zeros(len(look.place), dtype=torch.bool)
    own[first : prior.dimension] = True
    covariance = torch.linalg.inv(look.information)
    vector, slope = prior.to_vector_with_slope(look.place[:-1])
    middle, slope = vector[first:], slope[first:].clamp_min(1e-12)
    low, high = prior.low[first:], prior.high[first:]
    among = covariance[own][:, own]
    along = torch.linalg.solve(among, covariance[own][:, ~own]).T / slope
    root = torch.linalg.cholesky(WIDER * slope[:, None] * among * slope)
    trial = torch.randn(_TRIALS, len(low), generator=generator, dtype=torch.float64)
    trial = middle + trial @ root.T
    inside = ((trial > low) & (trial < high)).all(-1)
    near = trial[inside][: round((1 - FROM_PRIOR) * DRAWS)]
    spread = torch.rand(DRAWS - len(near), len(low), generator=generator, dtype=torch.float64)
    values = torch.cat((near, low + (high - low) * spread))
    offset = torch.linalg.solve_triangular(root, (values - middle).T, upper=False)
    normal = -0.5 * (offset**2 + math.log(2 * math.pi)).sum(0) - root.diagonal().log().sum()
    normal = normal - inside.double().mean().clamp_min(1e-300).log() + (high - low).log().sum()
    share = len(near) / DRAWS
    log_density = torch.log(share * normal.exp() + (1 - share))
    return values, log_density, along


def _mean(log_ratio: Float[Tensor, " n"], draw: Int[Tensor, " n"]) -> NestedGain:
    """The log of the mean and its standard error, from sums over the same draw."""
    top = float(log_ratio.max())
    if top == -math.inf:
        return NestedGain(-math.inf, math.inf)
    ratio = (log_ratio - top).exp()
    place = draw.unique(return_inverse=True)[1]
    sums = torch.zeros(int(place.max()) + 1, dtype=torch.float64).index_add(0, place, ratio)
    mean, often = float(ratio.mean()), place.bincount().double()
    gain, groups = top + math.log(mean), len(often)
    if groups < 2:
        return NestedGain(gain, math.inf)
    error = float((sums - often * mean).norm()) / (mean * len(ratio))
    return NestedGain(gain, error * math.sqrt(groups / (groups - 1)))
