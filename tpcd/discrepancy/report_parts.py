"""Parts of a diagnosis in plain values: effects with their sizes, theta, detection limits."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace

import torch

from tpcd.belief.belief import Belief
from tpcd.contact import place_points
from tpcd.discrepancy.coverage import Coverage
from tpcd.discrepancy.diagnosis import Estimate, Limit, NamedEffect
from tpcd.discrepancy.screening import Glance
from tpcd.effects.protocol import Effect, EffectParameter

SIZES = ("object_width", "object_height")
"""Names of the outline's extents."""
BEYOND, NOT_ALONE = "beyond its prior", "not without the other parameters"
"""Why a parameter has no limit."""
_HARD_SPACE = "\0"
"""Where lines are not broken."""


def named_effects(belief: Belief, given: int) -> tuple[NamedEffect, ...]:
    """The effects of a belief with their sizes, but for the first ones that were given."""
    entries = estimates(belief)
    place = belief.prior.scene_dimension
    found = []
    for k, effect in enumerate(belief.prior.effects):
        own = []
        for parameter in effect.parameters:
            own.append(_shown(entries[place], parameter))
            place += 1
        if k >= given:
            sentence = effect.sentence([estimate.shown for estimate in own])
            found.append(NamedEffect(effect.name, tuple(own), sentence))
    return tuple(found)


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
    return _with_unit(f"{value:.{digits}f} ± {sd:.{digits}f}", parameter)


def detection_limits(
    glances: Sequence[Glance],
    catalogue: Sequence[Effect],
    coverage: Coverage,
    least_gain: float,
) -> tuple[Limit, ...]:
    """For each effect the smallest size that the data would show, by the quick look's curvature.

    A size of s standard deviations gains s^2 / 2 of log likelihood, less what the priors of all
    parameters of the effect cost (by Laplace's approximation, as if they were independent).
    """
    known = {g.effect.name: g for g in glances}
    limits: list[Limit] = []
    for effect in catalogue:
        lacks = coverage.missing(effect.needs)
        found = known.get(effect.name)
        cost = 0.0 if found is None else sum(map(_cost, effect.parameters, found.sd))
        own = []
        for k, parameter in enumerate(effect.parameters):
            if parameter.low <= parameter.null <= parameter.high and parameter.name == "at":
                continue
            size, note = math.inf, ""
            if lacks:
                note = f"needs {', '.join(lacks)}"
            if found is not None:
                sd = found.sd[k]
                size = sd * math.sqrt(2 * (least_gain + cost)) if sd > 0 else math.inf
                if size > max(parameter.high - parameter.null, parameter.null - parameter.low):
                    size, note = math.inf, note or BEYOND
            shown = _with_unit(f"{size * parameter.shown_factor:.2g}", parameter)
            shown = shown if math.isfinite(size) else "none"
            own.append(Limit(effect.name, parameter.name, size, shown, note))
        some = any(math.isfinite(limit.size) for limit in own)
        limits += [
            replace(limit, note=NOT_ALONE) if some and limit.note == BEYOND else limit
            for limit in own
        ]
    return tuple(limits)


def told_limits(limits: Sequence[Limit]) -> str:
    """The limits in lines for people: what would show from which size on, and what would not."""
    sizes: dict[str, list[Limit]] = {}
    none: dict[str, str] = {}
    for limit in limits:
        if math.isfinite(limit.size):
            sizes.setdefault(limit.name, []).append(limit)
        elif limit.note != NOT_ALONE:
            none[limit.name] = f"{limit.name} ({limit.note})" if limit.note else limit.name
    text = []
    if sizes:
        shown = ", ".join(_told_sizes(*one) for one in sizes.items())
        text.append(f"an effect shows in these data from about: {shown}")
    if none:
        text.append(f"at no size that is expected: {', '.join(none.values())}")
    lines = textwrap.fill(
        "preflight: " + "; ".join(text), 100, subsequent_indent="    ", break_on_hyphens=False
    )
    return lines.replace(_HARD_SPACE, " ")


def _told_sizes(name: str, limits: Sequence[Limit]) -> str:
    """An effect with the size of each parameter, named where there are several or no unit tells."""
    bare = len(limits) == 1 and " " in limits[0].shown
    sizes = [one.shown if bare else f"{one.parameter} {one.shown}" for one in limits]
    text = f"{name} {' or '.join(sizes)}"
    return text.replace(" ", _HARD_SPACE) if len(sizes) < 3 else text


def _with_unit(text: str, parameter: EffectParameter) -> str:
    unit = parameter.shown_unit or parameter.unit
    return text if unit == "1" else f"{text} {unit}"


def _cost(parameter: EffectParameter, sd: float) -> float:
    """The logarithm of how much more the prior holds than the posterior."""
    if not sd > 0:
        return math.inf
    share = (parameter.high - parameter.low) / (sd * math.sqrt(2 * math.pi))
    return math.log(share) if share > 1 else 0.0


def _shown(estimate: Estimate, parameter: EffectParameter) -> Estimate:
    parts = {**vars(estimate), "name": parameter.name, "unit": parameter.unit}
    parts["shown"] = shown_value(estimate.value, estimate.sd, parameter)
    return Estimate(**parts)
