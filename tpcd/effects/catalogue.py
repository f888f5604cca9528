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
