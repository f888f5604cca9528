"""Effects that a model may lack, each at its fixed site, and the catalogue of them."""

from tpcd.effects.catalogue import CATALOGUE, KNOWN, find_effect
from tpcd.effects.conditions import (
    FLOOR,
    WALL,
    Conditions,
    Outcome,
    Rows,
    base_conditions,
    sequence,
)
from tpcd.effects.declare import DeclaredEffect
from tpcd.effects.protocol import Added, Effect, EffectParameter, effect_parameters

__all__ = [
    "CATALOGUE",
    "FLOOR",
    "KNOWN",
    "WALL",
    "Added",
    "Conditions",
    "DeclaredEffect",
    "Effect",
    "EffectParameter",
    "Outcome",
    "Rows",
    "base_conditions",
    "effect_parameters",
    "find_effect",
    "sequence",
]
