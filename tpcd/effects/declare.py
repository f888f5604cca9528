"""Effects from a function: what most of the catalogue is made with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from tpcd.effects.conditions import Conditions, Outcome, Rows
from tpcd.effects.protocol import SITES, EffectParameter, effect_to_plain

Change = Callable[[Conditions, Tensor, Rows, Outcome | None], Conditions]


@dataclass(frozen=True)
class DeclaredEffect:
    """An effect that a function applies; the text names its parameters as {0}, {1}, ..."""

    name: str
    site: str
    parameters: tuple[EffectParameter, ...]
    change: Change
    text: str
    needs: tuple[str, ...] = ()
    passes: int = 0
    parts: int = 1
    """Parts into which the first pass is cut: more where how a row settles depends on its way."""
    source: str = ""
    """File that it was read from; empty for the catalogue."""

    def __post_init__(self) -> None:
        """Refuse a site that is not one, and a text that names other parameters."""
        if self.site not in SITES:
            raise ValueError(
                f"effect {self.name!r} acts at {self.site!r}, expected one of {', '.join(SITES)}"
            )
        try:
            self.sentence([""] * len(self.parameters))
        except (IndexError, KeyError, ValueError) as error:
            raise ValueError(
                f"the text of effect {self.name!r} is {self.text!r}, expected {{0}}, {{1}}, ... for"
                f" its {len(self.parameters)} parameters"
            ) from error

    def apply(
        self,
        conditions: Conditions,
        values: Float[Tensor, "m p"],
        rows: Rows,
        outcome: Outcome | None,
    ) -> Conditions:
        """The conditions with the effect; without an outcome, those before the first pass."""
        return self.change(conditions, values, rows, outcome)

    def sentence(self, values: Sequence[str]) -> str:
        """What to tell people, given the parameters as text."""
        return self.text.format(*values)

    def to_plain(self) -> dict[str, Any]:
        """In plain values, as in a model file."""
        return effect_to_plain(self)


def column(values: Float[Tensor, "m p"], i: int) -> Float[Tensor, "m 1"]:
    """Parameter i of every particle, with an axis for the rows."""
    return values[:, i, None]
