"""Detection limits against integrals of what they approximate."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from tpcd.discrepancy.coverage import Coverage
from tpcd.discrepancy.diagnosis import Limit
from tpcd.discrepancy.limits import NOT_ALONE, detection_limits, told_limits
from tpcd.discrepancy.screening import Glance
from tpcd.effects import find_effect
from tpcd.effects.excitations import NEEDED
from tpcd.effects.protocol import EffectParameter

LEAST = 6.0
EXCITED = Coverage(dict.fromkeys(NEEDED, 1e6))


def glance_of(name: str, sd: tuple[float, ...]) -> Glance:
    """A look at an effect whose parameters have these standard deviations."""
    return Glance(0.0, sd, torch.zeros(1), torch.eye(1), torch.zeros(0, 1), find_effect(name))


def log_mean_likelihood(parameter: EffectParameter, size: float, sd: float) -> float:
    """Of a parameter, over its prior, relative to the null value, where it was measured as size."""

    def likelihood(value: float) -> float:
        return math.exp(-0.5 * ((value - size) / sd) ** 2)

    near = (max(parameter.low, size - 9 * sd), min(parameter.high, size + 9 * sd))
    mean = quad(likelihood, *near, epsrel=1e-10)[0] / (parameter.high - parameter.low)
    return math.log(mean) + 0.5 * ((parameter.null - size) / sd) ** 2


@pytest.mark.parametrize(
    ("name", "sd"), [("floor_tilt", (0.002,)), ("stiffness_error", (0.01, 0.02))]
)
def test_an_effect_at_its_limit_gains_what_is_asked_for(name: str, sd: tuple[float, ...]) -> None:
    """The other parameters are at their null value, and their priors cost all the same."""
    effect = find_effect(name)
    limits = detection_limits([glance_of(name, sd)], [effect], EXCITED, LEAST)
    assert [one.parameter for one in limits] == [p.name for p in effect.parameters]
    for k, limit in enumerate(limits):
        sizes = np.where(np.arange(len(sd)) == k, limit.size, 0.0)
        gains = map(log_mean_likelihood, effect.parameters, sizes.tolist(), sd)
        assert sum(gains) == pytest.approx(LEAST, abs=1e-3)


def test_what_cannot_show_has_no_limit() -> None:
    effect = find_effect("floor_tilt")
    (wide,) = detection_limits([glance_of("floor_tilt", (1.0,))], [effect], EXCITED, LEAST)
    (flat,) = detection_limits([glance_of("floor_tilt", (math.nan,))], [effect], EXCITED, LEAST)
    (idle,) = detection_limits([], [effect], Coverage({}), LEAST)
    assert wide.size == flat.size == idle.size == math.inf
    assert wide.note == flat.note == "beyond its prior" and idle.note.startswith("needs ")


def test_limits_are_told_in_units_that_people_read() -> None:
    """A lever without a weight shows in nothing, and is no reason to doubt the weight."""
    payload, friction = find_effect("payload"), find_effect("wall_friction")
    glances = [glance_of("payload", (0.01, math.inf)), glance_of("wall_friction", (0.02,))]
    needed = Coverage({need: 1e6 for need in NEEDED if need != "lift-off"})
    catalogue = [payload, friction, find_effect("adhesion")]
    weight, lever, ratio, adhesion = detection_limits(glances, catalogue, needed, LEAST)
    assert lever.note == NOT_ALONE and lever.size == math.inf and weight.shown.endswith(" N")
    assert ratio.shown == f"{ratio.size:.2g}"  # no unit
    assert adhesion.note == "needs lift-off"
    told = told_limits((weight, lever, ratio, adhesion))
    sizes = f"payload {weight.shown}, wall_friction log_ratio {ratio.shown}; "
    expected = f"{sizes}at no size that is expected: adhesion (needs lift-off)"
    assert " ".join(told.split()).endswith(expected)
    assert max(map(len, told.splitlines())) <= 100 and "lever" not in told
    bias = detection_limits([glance_of("force_bias", (0.1, 0.1, 0.01))],
                            [find_effect("force_bias")], needed, LEAST)  # fmt: skip
    shown = [limit.shown for limit in bias]
    expected = "force_bias F_x {} or F_z {} or tau {}".format(*shown)
    assert expected in " ".join(told_limits(bias).split())


def test_where_the_likelihood_jumps_the_change_of_innovations_tells() -> None:
    """Nothing happens to a ratio of 1.2; at 1.4 some transitions stick that slipped."""
    effect = find_effect("static_kinetic")
    blind = [glance_of("static_kinetic", (9.0,))]

    def limit(*reach: tuple[float, float], seen: Sequence[Glance] = blind) -> Limit:
        (found,) = detection_limits(seen, [effect], EXCITED, LEAST, {effect.name: (reach,)})
        return found

    jump = limit((0.1, 0.0), (0.2, 0.5), (0.4, 6.0), (0.8, 20.0))
    assert jump.size == 0.4 and jump.note == ""
    assert jump.shown == "1.4"  # what is called a ratio is told as one
    # That much gains what is asked for, its prior paid: 18 - log(1 / (0.4 / 6 sqrt(2 pi))) > 6.
    assert log_mean_likelihood(effect.parameters[0], 1.4, 0.4 / 6.0) > LEAST
    faint = limit((0.1, 0.0), (0.2, 0.5), (0.4, 3.4), (0.8, 3.4))  # 5.8 nats
    assert faint.size == math.inf and faint.shown == "none"
    assert limit((0.1, 9.0), seen=[glance_of(effect.name, (0.02,))]).size < 0.1  # by curvature
