"""Parts of a diagnosis in plain values: effects with their sizes, and theta."""

from __future__ import annotations

import math

import torch

from tpcd.belief.belief import Belief
from tpcd.contact import place_points
from tpcd.discrepancy.diagnosis import Estimate, NamedEffect
from tpcd.effects.protocol import EffectParameter

SIZES = ("object_width", "object_height")
"""Names of the outline's extents."""


def named_effects(belief: Belief, given: int) -> tuple[NamedEffect, ...]:
    """The effects of a belief with their sizes, but for the first ones that were given."""
    return _sized_effects(belief)[given:]


def given_effects(belief: Belief, given: int) -> tuple[NamedEffect, ...]:
    """The first effects of a belief, which were given, with the sizes that these data give them."""
    return _sized_effects(belief)[:given]


def theta_estimates(belief: Belief) -> tuple[Estimate, ...]:
    """Mean, sd and 90 % interval of the scene's entries of theta, and of the outline's size."""
    return (*estimates(belief)[: belief.prior.scene_dimension], *size_estimates(belief))


def size_estimates(belief: Belief) -> tuple[Estimate, ...]:
    """Width and height of the held outline along the end effector's axes [m].

    Unlike the scale, which multiplies an outline of the prior with a size of its own, they can
    be held against a ruler. Each of two opposite sides is off by the misfit of its own.
    """
    theta, weights = belief.parameters, belief.weights
    points = belief.prior.shape.boundary_points(theta.latent)
    points = place_points(points, theta.scale, theta.mount).double()
    sizes = points.amax(-2) - points.amin(-2)
    generator = torch.Generator().manual_seed(0)
    off = torch.randn(2, *sizes.shape, generator=generator, dtype=torch.float64).sum(0)
    sizes = sizes + belief.misfit_sd[:, None] * off
    mean = weights @ sizes
    std = (weights @ (sizes - mean) ** 2).sqrt()
    low, high = (belief.quantile_of(sizes, level) for level in (0.05, 0.95))
    columns = zip(SIZES, *(c.tolist() for c in (mean, std, low, high)), strict=True)
    return tuple(Estimate(*column, "m") for column in columns)


def estimates(belief: Belief) -> tuple[Estimate, ...]:
    """Mean, sd and 90 % interval of every entry of theta."""
    columns = zip(
        belief.prior.names,
        belief.mean().tolist(),
        belief.std().tolist(),
        belief.quantile(0.05).tolist(),
        belief.quantile(0.95).tolist(),
        belief.prior.units,
        strict=True,
    )
    return tuple(Estimate(*column) for column in columns)


def shown_value(value: float, sd: float, parameter: EffectParameter) -> str:
    """A value and its sd as text in the unit in which people read it."""
    value, sd = value * parameter.shown_factor, sd * parameter.shown_factor
    digits = 2 if sd <= 0 or not math.isfinite(sd) else max(0, 1 - math.floor(math.log10(sd)))
    digits = min(digits, 6)
    return with_unit(f"{value:.{digits}f} ± {sd:.{digits}f}", parameter)


def with_unit(text: str, parameter: EffectParameter) -> str:
    """A number as text with the unit in which people read it, which a mere number has not."""
    unit = parameter.shown_unit or parameter.unit
    return text if unit == "1" else f"{text} {unit}"


def _sized_effects(belief: Belief) -> tuple[NamedEffect, ...]:
    """All effects of a belief with their sizes."""
    entries = iter(estimates(belief)[belief.prior.scene_dimension :])
    found = []
    for effect in belief.prior.effects:
        own = tuple(_shown(next(entries), parameter) for parameter in effect.parameters)
        sentence = effect.sentence([estimate.shown for estimate in own])
        found.append(NamedEffect(effect.name, own, sentence))
    return tuple(found)


def _shown(estimate: Estimate, parameter: EffectParameter) -> Estimate:
    parts = {**vars(estimate), "name": parameter.name, "unit": parameter.unit}
    parts["shown"] = shown_value(estimate.value, estimate.sd, parameter)
    return Estimate(**parts)
