"""A quick look at every candidate: the Laplace approximation of its evidence near the base fit.

Points climb from where the base model arrived, with the effect at its null value and at draws
from its prior, and a few from all over the prior, since without the effect the base model may have
gone astray. Beside the same look at the model itself, the best of them says what an effect promises
to gain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.modes import Climbers, climb, set_out
from tpcd.belief.prior import ParameterPrior
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.carrying import carried
from tpcd.discrepancy.fit import Fit, Question, fit_stream, model_name
from tpcd.effects.protocol import Effect, EffectParameter, effect_parameters

PLACES = 16
"""Places of the base fit from which points climb, for an effect of one parameter."""
MOST_PLACES = 48
SCATTERED = {True: 72, False: 288}
"""Places from which points climb where an effect says where it is: all over that, and small; fewer
where another model explains the data,"""
ELSEWHERE = 4
"""each fourth in a scene from the prior: without the effect, the model may have gone astray."""
OFFERED = 16
"""Of these, places from which a full fit sets out."""
SMALL = 0.2
"""Standard scores within which the others begin about their null values."""
ROUNDS = 4
FURTHER = 3
"""Times at most that so many rounds more are climbed"""
GOING_ON = 8
"""by so many of the points,"""
RISING = 1.0
"""while any of them still rises by so much: where friction changes hands a climb is slow, and one
that is behind may overtake."""
FRESH_ROUNDS = 2
KEPT = 6
"""Points from all over the prior that go on climbing."""


@dataclass(frozen=True)
class Peak:
    """The best mode that a quick look at a model found."""

    log_evidence: float
    """By Laplace's approximation."""
    sd: tuple[float, ...]
    """Standard deviation there of each parameter of the effect that was added, in SI units."""
    place: Float[Tensor, " s"]
    """The mode, in unconstrained coordinates,"""
    information: Float[Tensor, "s s"]
    """and the curvature there."""
    others: Float[Tensor, "k s"]
    """Other places that a full fit should set out from: where an effect says where it is."""

    @property
    def places(self) -> Float[Tensor, "k s"]:
        """From which a full fit sets out."""
        return torch.cat((self.place[None], self.others))


@dataclass(frozen=True)
class Glance(Peak):
    """What the quick look at one candidate found."""

    effect: Effect


def glance(
    question: Question, base: Fit, effect: Effect, fresh: int, explained: bool = False
) -> Glance:
    """Climb to the modes of the base model's effects and one more; `fresh` points set out from
    all over the prior. Less is done where the data are `explained` by another model."""
    found = peak(question, base, (effect,), fresh, explained)
    return Glance(**vars(found), effect=effect)


def peak(
    question: Question, base: Fit, more: tuple[Effect, ...], fresh: int, explained: bool = False
) -> Peak:
    """The same for one effect more, or for the model as it is."""
    effects = (*base.effects, *more)
    names = tuple(e.name for e in effects)
    prior = question.scene.with_effects(effects)
    new = len(effect_parameters(more))
    scattered = SCATTERED[explained] if _says_where(prior, new) else 0
    model = (names, prior.low, prior.high, base.fingerprint, fresh, scattered)
    key = ("peak", question.fingerprint, *model)
    what = f"look at {model_name(effects)}"
    return question.memory.recall(
        what, key, Peak, lambda: _climbed(question, base, prior, new, fresh, scattered)
    )


def _climbed(
    question: Question, base: Fit, prior: ParameterPrior, new: int, fresh: int, scattered: int
) -> Peak:
    """Where points arrive under a prior whose last `new` parameters the base fit has not; so many
    are `scattered` over where an effect may be."""
    target = ContactTarget(prior, question.misfit, base.step, question.history)
    generator = fit_stream(question, prior.effects, 0)
    start = _begun(target, base, new, generator, scattered)
    if fresh:
        begun = set_out(target, target.scatter(fresh, generator))
        begun = climb(target, begun, FRESH_ROUNDS)
        start = start.beside(begun[begun.height.topk(min(KEPT, fresh)).indices])
    arrived = climb(target, start, ROUNDS)
    for _ in range(FURTHER):
        before = arrived[arrived.height.topk(min(GOING_ON, len(arrived.height))).indices]
        arrived = climb(target, before, ROUNDS)
        if not bool((arrived.height > before.height + RISING).any()):
            break
    best = arrived[arrived.height.topk(min(2, len(arrived.height))).indices].surveyed(target)
    information = best.information
    width = -0.5 * torch.linalg.slogdet(information).logabsdet
    each = best.height + width + 0.5 * information.shape[-1] * math.log(2 * math.pi)
    top = int(each.argmax())
    covariance = torch.linalg.inv(information[top])
    vector, slope = prior.to_vector_with_slope(best.points[top][:-1])
    sd = covariance.diagonal()[:-1].sqrt() * slope
    own = sd[len(vector) - new :]
    others = start.points[start.height.topk(min(OFFERED, len(start.height))).indices]
    if not scattered:
        others = others[:0]
    return Peak(float(each[top]), tuple(own.tolist()), best.points[top], information[top], others)


def _says_where(prior: ParameterPrior, new: int) -> bool:
    """Whether any of the last `new` parameters says where an effect is."""
    return new > 0 and any(one.where for one in effect_parameters(prior.effects)[-new:])


def _begun(
    target: ContactTarget, base: Fit, new: int, generator: torch.Generator, scattered: int
) -> Climbers:
    """Points from where the base model arrived that have begun to climb with `new` parameters."""
    prior = target.prior
    if scattered:
        own = effect_parameters(prior.effects)[-new:]
        begins = carried(base, prior, generator, scattered, repeat=True)
        astray = target.scatter(scattered // ELSEWHERE, generator)
        begins[::ELSEWHERE, : -new - 1] = astray[:, : -new - 1]
        start = set_out(target, _all_over(begins, own, prior, generator))
        while len(start.height) > PLACES:
            start = climb(target, start, ROUNDS)
            start = start[start.height.topk(max(PLACES, len(start.height) // 2)).indices]
        return start
    # Two parameters, such as the weight of a payload and its lever, are rarely right together.
    count = min(PLACES * max(new, 1) ** 2, MOST_PLACES)
    start = set_out(target, carried(base, prior, generator, count, repeat=count > PLACES))
    if count > PLACES:
        begun = climb(target, start, FRESH_ROUNDS)
        start = begun[begun.height.topk(PLACES).indices]
    return start


def _all_over(
    points: Float[Tensor, "k s"],
    own: Sequence[EffectParameter],
    prior: ParameterPrior,
    generator: torch.Generator,
) -> Float[Tensor, "k s"]:
    """Points of which what says where an effect is lies all over its range, in equal shares, and
    the other parameters of the effect nearly vanish."""
    k, first = len(points), points.shape[-1] - 1 - len(own)
    null = torch.cat((prior.low[:first], torch.tensor([p.null for p in own], dtype=torch.float64)))
    null_score = prior.to_score(null)
    points = points.clone()
    for i, parameter in enumerate(own, start=first):
        drawn = torch.rand(k, generator=generator, dtype=torch.float64)
        if parameter.where:
            order = torch.randperm(k, generator=generator)
            points[:, i] = torch.special.ndtri((order + drawn) / k)
        else:
            points[:, i] = null_score[i] + SMALL * (2.0 * drawn - 1.0)
    return points
