"""A quick look at every candidate: the Laplace approximation of its evidence near the base fit.

Points climb from where the base model arrived, with the effect at its null value and at draws
from its prior. The best of them says which candidates deserve the full fit from the prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tpcd.belief.modes import climb
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.evidence import Fit, Question, carried, fit_stream
from tpcd.effects.protocol import Effect

PLACES = 8
"""Places of the base fit from which points climb."""
ROUNDS = 3


@dataclass(frozen=True)
class Glance:
    """What the quick look at one candidate found."""

    effect: Effect
    log_evidence: float
    """By Laplace's approximation at the best mode found."""


def glance(question: Question, base: Fit, effect: Effect) -> Glance:
    """Climb to the modes of the base model's effects and one more."""
    effects = (*base.effects, effect)
    prior = question.scene.with_effects(effects)
    target = ContactTarget(prior, question.misfit, base.step, question.history)
    start = carried(base, prior, fit_stream(question, effects, 0), PLACES)
    points, height = climb(target, start, ROUNDS)
    best = height.topk(min(2, len(height))).indices
    _, information = target.curvature(points[best])
    width = -0.5 * torch.linalg.slogdet(information).logabsdet
    each = height[best] + width + 0.5 * information.shape[-1] * math.log(2 * math.pi)
    return Glance(effect, float(each.max()))


def shortlist(glances: Sequence[Glance], count: int) -> list[Effect]:
    """The candidates that look best."""
    return [g.effect for g in sorted(glances, key=lambda g: -g.log_evidence)[:count]]
