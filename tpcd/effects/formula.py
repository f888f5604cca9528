"""What is no effect of the catalogue: a number of the simulator that varies with a covariate.

Each formula is an ordinary effect with units: friction or the height of the floor, as a function
of something taken at the contact. What it says is a law for these data; why it holds is for
people to find out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from tpcd.effects.conditions import FLOOR, Conditions, Outcome, Rows, angle_difference
from tpcd.effects.declare import DeclaredEffect, column
from tpcd.effects.geometry import sunk
from tpcd.effects.protocol import EffectParameter
from tpcd.effects.uneven import RELIEFS

Covariate = Callable[[Outcome, Rows], Tensor]
"""From the outcome to one number for each particle, row and terrain (m, r, t)."""


def _place(outcome: Outcome, rows: Rows) -> Tensor:
    return outcome.place[..., 0]


def _height(outcome: Outcome, rows: Rows) -> Tensor:
    return outcome.place[..., 1]


def _angle(outcome: Outcome, rows: Rows) -> Tensor:
    return outcome.pose[..., 2:].expand_as(outcome.load)


def _time(outcome: Outcome, rows: Rows) -> Tensor:
    return rows.share[None, :, None].expand_as(outcome.load)


def _slip(outcome: Outcome, rows: Rows) -> Tensor:
    way = angle_difference(outcome.pose, rows.before(outcome.pose))[..., :2]
    return way.norm(dim=-1, keepdim=True).expand_as(outcome.load)


def _log_friction(covariate: Covariate):
    def change(
        conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
    ) -> Conditions:
        if outcome is None:
            return conditions
        exponent = values[:, :1, None] * covariate(outcome, rows)
        ratio = torch.where(outcome.load > 0, exponent.clamp(-3.0, 3.0).exp(), 1.0)
        return replace(conditions, friction=conditions.friction * ratio)

    return change


def _stiffening(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    if outcome is None:
        return conditions
    slope, load = column(values, 0), outcome.load[:, :, FLOOR].clamp_min(0.0)
    # sink = slope * root of load, and on rigid ground the load was more by stiffness * sink.
    less = slope * conditions.stiffness_along(conditions.normal[:, :, FLOOR])
    less = torch.where(outcome.first, less, 0.0)
    sink = 2 * slope * load / (less + (less**2 + 4 * load).sqrt()).clamp_min(1e-12)
    return sunk(conditions, FLOOR, sink, rows, outcome)


def _friction_formula(
    name: str, unit: str, most: float, covariate: Covariate, *needs: str
) -> DeclaredEffect:
    return DeclaredEffect(
        f"log_friction ~ {name}",
        "contact tangent",
        (EffectParameter("slope", unit, -most, most),),
        _log_friction(covariate),
        f"the logarithm of friction changes by {{0}} with the {name} of the contact",
        needs=("floor slip", *needs),
        passes=1,
    )


FORMULAS = (
    _friction_formula("place", "1/m", 20.0, _place, "floor places"),
    _friction_formula("height", "1/m", 20.0, _height, "wall slip"),
    _friction_formula("angle", "1/rad", 5.0, _angle),
    _friction_formula("time", "1", 2.0, _time),
    _friction_formula("slip", "1/m", 20.0, _slip),
    *RELIEFS,
    DeclaredEffect(
        "floor_height ~ root of load",
        "contact normal",
        (EffectParameter("slope", "m/N^0.5", 0.0, 3e-3),),
        _stiffening,
        "the floor yields by {0} times the root of the load",
        needs=("floor loads",),
        passes=1,
    ),
)
"""Formulas that are tried, in no order."""
FORMULA_NAMES = frozenset(formula.name for formula in FORMULAS)


def formulas_over(low: float, high: float) -> tuple[DeclaredEffect, ...]:
    """The formulas for a floor that was touched from `low` to `high` [m], where they look for
    places."""
    middle = 0.5 * (low + high)

    def there(parameter: EffectParameter) -> EffectParameter:
        if parameter.name != "place":
            return parameter
        return replace(parameter, low=low, high=high, null=middle)

    return tuple(
        replace(formula, parameters=tuple(there(parameter) for parameter in formula.parameters))
        for formula in FORMULAS
    )
