"""Parts of a diagnosis in plain values: effects with their sizes, theta, detection limits."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tpcd.belief.belief import Belief
from tpcd.discrepancy.coverage import Coverage
from tpcd.discrepancy.diagnosis import Estimate, Limit, NamedEffect
from tpcd.discrepancy.screening import Glance
from tpcd.effects.protocol import Effect, EffectParameter


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
    """Mean, sd and 90 % interval of the scene's entries of theta."""
    return estimates(belief)[: belief.prior.scene_dimension]


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
    unit = parameter.shown_unit or parameter.unit
    value, sd = value * parameter.shown_factor, sd * parameter.shown_factor
    digits = 2 if sd <= 0 or not math.isfinite(sd) else max(0, 1 - math.floor(math.log10(sd)))
    digits = min(digits, 6)
    text = f"{value:.{digits}f} ± {sd:.{digits}f}"
    return text if unit == "1" else f"{text} {unit}"


def detection_limits(
    glances: Sequence[Glance],
    catalogue: Sequence[Effect],
    coverage: Coverage,
    least_gain: float,
) -> tuple[Limit, ...]:
    """For each effect the smallest size that the data would show, by the quick look's curvature.

    A size of s standard deviations gains s^2 / 2 of log likelihood, less what its prior costs.
    """
    known = {g.effect.name: g for g in glances}
    limits = []
    for effect in catalogue:
        lacks = coverage.missing(effect.needs)
        found = known.get(effect.name)
        for k, parameter in enumerate(effect.parameters):
            if parameter.low <= parameter.null <= parameter.high and parameter.name == "at":
                continue
            size, note = math.inf, ""
            if lacks:
                note = f"needs {', '.join(lacks)}"
            elif found is not None:
                sd = found.sd[k]
                width = parameter.high - parameter.low
                cost = math.log(width / (sd * math.sqrt(2 * math.pi))) if sd > 0 else math.inf
                size = sd * math.sqrt(2 * (least_gain + max(cost, 0.0)))
                if size > width:
                    size, note = math.inf, "beyond its prior"
            unit = parameter.shown_unit or parameter.unit
            shown = f"{size * parameter.shown_factor:.2g} {unit}" if math.isfinite(size) else "none"
            limits.append(Limit(effect.name, parameter.name, size, shown, note))
    return tuple(limits)


def _shown(estimate: Estimate, parameter: EffectParameter) -> Estimate:
    parts = {**vars(estimate), "name": parameter.name, "unit": parameter.unit}
    parts["shown"] = shown_value(estimate.value, estimate.sd, parameter)
    return Estimate(**parts)
