"""What an effect is: a named change of the model with parameters of its own.

An effect says where it acts (its site), what its parameters are, which excitation it needs to
be seen, and how it is reported. Its `apply` is pure and batched, and at the null values of the
parameters returns conditions that hold the same bits as before.

Write your own by giving an object these attributes; see tpcd/effects/README.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.effects.conditions import Conditions, Outcome, Rows
from tpcd.effects.guard import known, malformed, set_apart, unusable
from tpcd.errors import EffectError

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


_TRIALS = 8
"""Values of an effect's parameters that are tried before it counts as broken."""


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
    where: bool = False
    """Whether it says where or how wide: the effect is absent at the null values of the others, and
    shows only where this one is about right, which a search has to try all over its range."""

    def __post_init__(self) -> None:
        """Refuse a prior without width."""
        numbers = (self.low, self.high, self.null, self.shown_factor)
        if not self.low < self.high or not all(math.isfinite(number) for number in numbers):
            raise ValueError(
                f"parameter {self.name!r} has the range [{self.low}, {self.high}] and null value"
                f" {self.null}; expected finite numbers with low < high"
            )


@runtime_checkable
class Effect(Protocol):
    """One effect of the catalogue, or of a user."""

    @property
    def name(self) -> str:
        """What models and reports call it."""
        ...

    @property
    def site(self) -> str:
        """Where it acts, one of `SITES`."""
        ...

    @property
    def parameters(self) -> tuple[EffectParameter, ...]:
        """Its p parameters in order."""
        ...

    @property
    def passes(self) -> int:
        """How often the step is solved anew with the effect's answer to its outcome; 0 where the
        effect does not look at it."""
        ...

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the excitations (`effects.excitations`) without which it is hardly seen."""
        ...

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
        """How often the steps are solved before the conditions stand: once more where several
        effects answer to the outcome, and so to each other."""
        passes = [effect.passes for effect in self.effects if effect.passes]
        return max(passes, default=0) + (len(passes) > 1)

    @property
    def parts(self) -> int:
        """Those of its effects, as in `parts_of`."""
        return parts_of(self.effects)

    def apply(self, conditions: Conditions, rows: Rows, outcome: Outcome | None) -> Conditions:
        """The conditions with all effects, site by site.

        Raises `EffectError` where one fails. A particle for which it gives no usable conditions
        settles at NaN, and others are as without it.
        """
        for effect, values in sorted(self._parts(), key=lambda part: SITES.index(part[0].site)):
            conditions = _applied(effect, conditions, values, rows, outcome)
        return conditions

    def __getitem__(self, index: Tensor) -> Added:
        """The effects of some particles."""
        return Added(self.effects, self.values[index])

    def _parts(self) -> list[tuple[Effect, Tensor]]:
        sizes = [len(effect.parameters) for effect in self.effects]
        return list(zip(self.effects, self.values.split(sizes, dim=-1), strict=True))


def _applied(
    effect: Effect, before: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    after = _tried(effect, before, values, rows, outcome)
    bad = unusable(before, after)
    if not bad:
        return after
    fine = known(before, values, rows, outcome)
    first = next(iter(bad))
    everywhere = torch.zeros(len(values), len(rows.share), dtype=torch.bool)
    for part in bad.values():
        everywhere = everywhere | part
    if bool(fine.any()) and bool(everywhere.any(-1)[fine].all()):
        _check_some_answer(effect, first, before, rows, outcome, int(fine.long().argmax()))
    return set_apart(before, after, everywhere, rows)


def _tried(
    effect: Effect, before: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    source = getattr(effect, "source", "")
    try:
        after = effect.apply(before, values, rows, outcome)
    except Exception as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise EffectError(effect.name, f"fails with {cause[:300]}", source) from error
    points = before.warp.shape[2] if outcome is None else outcome.outline.shape[1]
    problem = malformed(before, after, len(values), len(rows.share), points)
    if problem:
        raise EffectError(effect.name, problem, source)
    return after


def _check_some_answer(
    effect: Effect,
    field: str,
    before: Conditions,
    rows: Rows,
    outcome: Outcome | None,
    particle: int,
) -> None:
    """Raise `EffectError` where an effect has no answer at all, whatever its parameters are."""
    low, high = parameter_bounds([effect])
    share = torch.linspace(0.0, 1.0, _TRIALS, dtype=torch.float64)[:, None]

    def repeated(part: Tensor) -> Tensor:
        return part[[particle if len(part) > 1 else 0] * _TRIALS]

    before = Conditions(**{name: repeated(part) for name, part in vars(before).items()})
    if outcome is not None:
        outcome = Outcome(**{name: repeated(part) for name, part in vars(outcome).items()})
    found = unusable(before, _tried(effect, before, low + share * (high - low), rows, outcome))
    bad = sum((part.any(-1).long() for part in found.values()), torch.zeros(_TRIALS).long())
    if bool((bad > 0).all()):
        raise EffectError(
            effect.name,
            f"gives no usable {field} for any value of its parameters, expected finite numbers"
            " (a stiffness above 0, a compliance of at least 0)",
            getattr(effect, "source", ""),
        )


def parts_of(effects: Sequence[Effect]) -> int:
    """Into how many parts the first pass is cut, which goes on from where each part ends."""
    return max((getattr(effect, "parts", 1) for effect in effects), default=1)


def effect_to_plain(effect: Effect) -> dict[str, Any]:
    """An effect in plain values, as in a model file."""
    source = getattr(effect, "source", None)
    plain: dict[str, Any] = {"name": effect.name}
    if source:
        plain["file"] = str(source)
    return plain | {"parameters": {p.name: [p.low, p.high] for p in effect.parameters}}


def effect_parameters(effects: Sequence[Effect]) -> tuple[EffectParameter, ...]:
    """The parameters of all effects in order."""
    return tuple(parameter for effect in effects for parameter in effect.parameters)


def parameter_bounds(effects: Sequence[Effect]) -> Float[Tensor, "2 e"]:
    """Lower and upper ends of the priors of all effects."""
    parameters = effect_parameters(effects)
    ends = [[p.low for p in parameters], [p.high for p in parameters]]
    return torch.tensor(ends, dtype=torch.float64)
