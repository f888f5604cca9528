"""What an effect is: a named change of the model with parameters of its own.

An effect says where it acts (its site), what its parameters are, which excitation it needs to
be seen, and how it is reported. Its `apply` is pure and batched, and at the null values of the
parameters returns conditions that hold the same bits as before.

Write your own by giving an object these attributes; see docs/effects.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.effects.conditions import Conditions, Outcome, Rows

SITES = (
    "command",
    "impedance",
    "arm friction",
    "external load",
    "geometry",
    "contact normal",
    "contact tangent",
    "sensor",
)
"""Where effects act, in the order in which they are applied."""


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect, uniform on [low, high] before any datum."""

    name: str
    unit: str
    """SI unit."""
    low: float
    high: float
    null: float = 0.0
    """Value at which the effect is absent."""
    shown_unit: str = ""
    """Unit in which people read it; empty for the SI unit."""
    shown_factor: float = 1.0
    """What the SI value is multiplied by to be shown."""

    def __post_init__(self) -> None:
        """Refuse a prior without width or a null value outside of it."""
        if not self.low <= self.null <= self.high or not self.low < self.high:
            raise ValueError(
                f"parameter {self.name!r} has the range [{self.low}, {self.high}] and null value"
                f" {self.null}; expected low < high with the null value between them"
            )


@runtime_checkable
class Effect(Protocol):
    """One effect of the catalogue, or of a user."""

    name: str
    site: str
    parameters: tuple[EffectParameter, ...]
    passes: int
    """How often the step is solved anew with the effect's answer to its outcome; 0 where the
    effect does not look at it."""
    needs: tuple[str, ...]
    """Names of the excitations (`discrepancy.coverage`) without which it cannot be seen."""

    def apply(
        self,
        conditions: Conditions,
        values: Float[Tensor, "m p"],
        rows: Rows,
        outcome: Outcome | None,
    ) -> Conditions:
        """The conditions with the effect, for m particles with its p parameters each."""
        ...

    def sentence(self, values: Sequence[str]) -> str:
        """What to tell people, given its parameters as text with units."""
        ...


@dataclass(frozen=True, eq=False)
class Added:
    """Effects with their values, side by side in the order of the effects' parameters."""

    effects: tuple[Effect, ...]
    values: Float[Tensor, "m e"]

    @property
    def passes(self) -> int:
        """How often the steps are solved before the conditions stand."""
        return max((effect.passes for effect in self.effects), default=0)

    def apply(self, conditions: Conditions, rows: Rows, outcome: Outcome | None) -> Conditions:
        """The conditions with all effects, site by site."""
        for effect, values in sorted(self._parts(), key=lambda part: SITES.index(part[0].site)):
            conditions = effect.apply(conditions, values, rows, outcome)
        return conditions

    def __getitem__(self, index: Tensor) -> Added:
        """The effects of some particles."""
        return Added(self.effects, self.values[index])

    def _parts(self) -> list[tuple[Effect, Tensor]]:
        sizes = [len(effect.parameters) for effect in self.effects]
        return list(zip(self.effects, self.values.split(sizes, dim=-1), strict=True))


def effect_parameters(effects: Sequence[Effect]) -> tuple[EffectParameter, ...]:
    """The parameters of all effects in order."""
    return tuple(parameter for effect in effects for parameter in effect.parameters)


def parameter_bounds(effects: Sequence[Effect]) -> Float[Tensor, "2 e"]:
    """Lower and upper ends of the priors of all effects."""
    parameters = effect_parameters(effects)
    ends = [[p.low for p in parameters], [p.high for p in parameters]]
    return torch.tensor(ends, dtype=torch.float64)
