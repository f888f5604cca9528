"""All effects that come with the project, and those that users bring along."""

from __future__ import annotations

from collections.abc import Iterable

from tpcd.effects.contact import CONTACT_EFFECTS
from tpcd.effects.drive import DRIVE_EFFECTS
from tpcd.effects.formula import FORMULAS
from tpcd.effects.geometry import GEOMETRY_EFFECTS
from tpcd.effects.protocol import Effect
from tpcd.effects.sensor import SENSOR_EFFECTS

CATALOGUE: tuple[Effect, ...] = (
    *CONTACT_EFFECTS,
    *GEOMETRY_EFFECTS,
    *DRIVE_EFFECTS,
    *SENSOR_EFFECTS,
)
KNOWN: tuple[Effect, ...] = (*CATALOGUE, *FORMULAS)
"""The catalogue and the formulas: what models, beliefs and truths can have by name."""


def find_effect(name: str, effects: Iterable[Effect] = KNOWN) -> Effect:
    """The effect of a name; raises ValueError with the names there are."""
    known = {effect.name: effect for effect in effects}
    if name not in known:
        raise ValueError(f"no effect {name!r}; expected one of {', '.join(sorted(known))}")
    return known[name]


def unit_of(name: str, parameter: str) -> str:
    """SI unit of a parameter of an effect, also of those that MuJoCo alone can be given; "" where
    there is none of the name."""
    units = {(effect.name, one.name): one.unit for effect in KNOWN for one in effect.parameters}
    others = {"height": "m", "x": "m", "length": "m", "skew": "1", "slope": "1/m"}
    return units.get((name, parameter), others.get(parameter, ""))
