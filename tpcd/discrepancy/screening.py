"""A quick look at every candidate: the Laplace approximation of its evidence at its modes.

Points climb from where the base model arrived, with the effect at its null value and at draws
from its prior, and from all over the prior, since a base model without the effect may have gone
astray. The integral over the modes says which candidates deserve the full fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from tpcd.belief.cloud import SamplerSettings
from tpcd.belief.modes import find_modes, log_target
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.evidence import Fit, Question, carried
from tpcd.effects.protocol import Effect
from tpcd.random import stream

SCREEN_SAMPLER = replace(SamplerSettings(), fresh_modes=24, modes=6, following_rounds=4)
"""Points that climb for each candidate."""


@dataclass(frozen=True)
class Glance:
    """What the quick look at one candidate found."""

    effect: Effect
    log_evidence: float
    """By Laplace's approximation, summed over the modes found."""


def glance(question: Question, base: Fit, effect: Effect, seed: int = 0) -> Glance:
    """Climb to the modes of the base model's effects and one more."""
    effects = (*base.effects, effect)
    prior = question.scene.with_effects(effects)
    target = ContactTarget(prior, question.misfit, base.step, question.history)
    generator = stream(question.seed, sum(map(ord, effect.name)), seed)
    start = carried(base, prior, generator)
    peaks = find_modes(target, start, SCREEN_SAMPLER, generator)
    height = log_target(target, peaks.points)
    size = peaks.information.shape[-1]
    width = -0.5 * torch.linalg.slogdet(peaks.information).logabsdet
    each = height + width + 0.5 * size * math.log(2 * math.pi)
    return Glance(effect, float(torch.logsumexp(each, 0)))


def shortlist(glances: Sequence[Glance], count: int) -> list[Effect]:
    """The candidates that look best."""
    return [g.effect for g in sorted(glances, key=lambda g: -g.log_evidence)[:count]]
