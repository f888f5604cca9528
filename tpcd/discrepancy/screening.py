"""A quick look at every candidate: the Laplace approximation of its evidence near the base fit.

Points climb from where the base model arrived, with the effect at its null value and at draws
from its prior, and a few from all over the prior, since without the effect the base model may have
gone astray. The best of them says which candidates deserve the full fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.modes import climb, set_out
from tpcd.belief.prior import ParameterPrior
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.carrying import carried
from tpcd.discrepancy.fit import Fit, Question, fit_stream
from tpcd.effects.protocol import Effect

PLACES = 16
"""Places of the base fit from which points climb, for an effect of one parameter."""
MOST_PLACES = 48
ROUNDS = 4
FRESH_ROUNDS = 2
KEPT = 6
"""Points from all over the prior that go on climbing."""


@dataclass(frozen=True)
class Glance:
    """What the quick look at one candidate found."""

    effect: Effect
    log_evidence: float
    """By Laplace's approximation at the best mode found."""
    sd: tuple[float, ...]
    """Standard deviation there of each parameter of the effect, in SI units."""
    place: Float[Tensor, " s"]
    """The mode, in unconstrained coordinates."""


@dataclass(frozen=True)
class _Peak:
    """The numbers of a glance."""

    log_evidence: float
    sd: tuple[float, ...]
    place: Float[Tensor, " s"]


def glance(question: Question, base: Fit, effect: Effect, fresh: int) -> Glance:
    """Climb to the modes of the base model's effects and one more; `fresh` points set out from
    all over the prior."""
    effects = (*base.effects, effect)
    names = tuple(e.name for e in effects)
    prior = question.scene.with_effects(effects)
    key = (question.fingerprint, names, prior.low, prior.high, base.fingerprint, fresh)
    found = question.memory.recall(key, _Peak, lambda: _peak(question, base, prior, fresh))
    return Glance(effect, found.log_evidence, found.sd, found.place)


def _peak(question: Question, base: Fit, prior: ParameterPrior, fresh: int) -> _Peak:
    effects = prior.effects
    target = ContactTarget(prior, question.misfit, base.step, question.history)
    generator = fit_stream(question, effects, 0)
    # Two parameters, such as how high a step is and where, are rarely right by chance together.
    count = min(PLACES * len(effects[-1].parameters) ** 2, MOST_PLACES)
    start = set_out(target, carried(base, prior, generator, count, repeat=count > PLACES))
    if count > PLACES:
        begun = climb(target, start, FRESH_ROUNDS)
        start = begun[begun.height.topk(PLACES).indices]
    if fresh:
        begun = set_out(target, target.scatter(fresh, generator))
        begun = climb(target, begun, FRESH_ROUNDS)
        start = start.beside(begun[begun.height.topk(min(KEPT, fresh)).indices])
    arrived = climb(target, start, ROUNDS)
    best = arrived[arrived.height.topk(min(2, len(arrived.height))).indices].surveyed(target)
    information = best.information
    width = -0.5 * torch.linalg.slogdet(information).logabsdet
    each = best.height + width + 0.5 * information.shape[-1] * math.log(2 * math.pi)
    top = int(each.argmax())
    covariance = torch.linalg.inv(information[top])
    vector, slope = prior.to_vector_with_slope(best.points[top][:-1])
    own = slice(len(vector) - len(effects[-1].parameters), len(vector))
    sd = covariance.diagonal()[:-1].sqrt() * slope
    return _Peak(float(each[top]), tuple(sd[own].tolist()), best.points[top])
