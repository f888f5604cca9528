"""Detection limits: from which size on an effect would show in these data."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace

from tpcd.discrepancy.confusion import Reach
from tpcd.discrepancy.coverage import Coverage
from tpcd.discrepancy.diagnosis import Limit
from tpcd.discrepancy.report_parts import with_unit
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.workbench import Workbench
from tpcd.effects.protocol import Effect, EffectParameter

BEYOND, NOT_ALONE = "beyond its prior", "not without the other parameters"
"""Why a parameter has no limit."""
_HARD_SPACE = "\0"
"""Where lines are not broken."""


def limits_of(bench: Workbench, given: Sequence[str]) -> tuple[Limit, ...]:
    """The limits of all effects of the catalogue but those that the model is given."""
    settings = bench.settings
    asked = [effect for effect in settings.catalogue if effect.name not in given]
    return detection_limits(bench.glances, asked, bench.coverage, settings.least_gain, bench.reach)


def detection_limits(
    glances: Sequence[Glance],
    catalogue: Sequence[Effect],
    coverage: Coverage,
    least_gain: float,
    reach: Mapping[str, Sequence[Reach]] = {},
) -> tuple[Limit, ...]:
    """For each effect the smallest size that the data would show, by the quick look's curvature.

    A size of s standard deviations gains s^2 / 2 of log likelihood, less what the priors of all
    parameters of the effect cost (by Laplace's approximation, as if they were independent).
    Curvature does not see what sticks or slips until an effect is large enough: where a size of
    `reach` that changes the innovations by as much is smaller, the limit is that.
    """
    known = {g.effect.name: g for g in glances}
    limits: list[Limit] = []
    for effect in catalogue:
        lacks = coverage.missing(effect.needs)
        found = known.get(effect.name)
        sds = () if found is None else found.sd
        cost = sum(map(_cost, effect.parameters, sds))
        jumps = reach.get(effect.name, ((),) * len(effect.parameters))
        own = []
        for k, parameter in enumerate(effect.parameters):
            if parameter.low <= parameter.null <= parameter.high and parameter.name == "at":
                continue
            size, note = math.inf, ""
            if lacks:
                note = f"needs {', '.join(lacks)}"
            if sds:
                size = _size(parameter, sds[k], least_gain + cost)
                size = min(size, _jump(parameter, jumps[k], least_gain))
                note = note or ("" if math.isfinite(size) else BEYOND)
            value = (parameter.null + size) * parameter.shown_factor
            shown = with_unit(f"{value:.{3 if parameter.null else 2}g}", parameter)
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


def _size(parameter: EffectParameter, sd: float, gain: float) -> float:
    """The size that gains so much; infinite beyond the prior."""
    size = sd * math.sqrt(2 * gain) if sd > 0 else math.inf
    most = max(parameter.high - parameter.null, parameter.null - parameter.low)
    return size if size <= most else math.inf


def _jump(parameter: EffectParameter, reach: Reach, gain: float) -> float:
    """The first size that changes innovations by enough to gain so much; infinite if none does."""
    for size, norm in reach:
        if norm > 0 and norm**2 / 2 >= gain + _cost(parameter, size / norm):
            return size
    return math.inf


def _cost(parameter: EffectParameter, sd: float) -> float:
    """The logarithm of how much more the prior holds than the posterior."""
    if not sd > 0:
        return math.inf
    share = (parameter.high - parameter.low) / (sd * math.sqrt(2 * math.pi))
    return math.log(share) if share > 1 else 0.0
