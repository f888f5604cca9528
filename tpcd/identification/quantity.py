"""One figure that a recording tells of arm or sensor, with its interval, or why it cannot."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

LEVEL = 0.95
"""Share of intervals that hold the true value."""


@dataclass(frozen=True)
class Quantity:
    """What the data say of one quantity.

    Either `value` with `interval`, or `reason` and `motion`. A value in words (a frame, a sign)
    has no interval. A value whose interval is too wide to be of use has a `motion` besides.
    """

    name: str
    """For programs: weight, force_bias_x, stiffness_rz, pose_lag, ..."""
    unit: str
    """SI; empty for ratios and words."""
    value: float | str | None = None
    interval: tuple[float, float] | None = None
    level: float = LEVEL
    basis: str = ""
    """What it rests on, and what cannot be told apart from it."""
    reason: str = ""
    """Why the data cannot tell."""
    motion: str = ""
    """How to move so that they can."""

    @property
    def told(self) -> bool:
        """Whether the data can tell."""
        return self.value is not None

    def __str__(self) -> str:
        """The line shown: name, value and interval, or why it is not known and what to do."""
        name, unit = self.name.replace("_", " "), f" {self.unit}" if self.unit else ""
        basis = f" ({self.basis})" if self.basis else ""
        move = f"; move so: {self.motion}" if self.motion else ""
        if self.value is None:
            return f"{name}: the data cannot tell, because {self.reason}{basis}{move}"
        if isinstance(self.value, str):
            return f"{name}: {self.value}{basis}{move}"
        if self.interval is None:
            return f"{name}: {self.value:.4g}{unit}{basis}{move}"
        low, high = self.interval
        within = f"{low:.4g} to {high:.4g} at {self.level:.0%}"
        return f"{name}: {self.value:.4g}{unit} ({within}){basis}{move}"


def untold(names: Iterable[str], unit: str, reason: str, motion: str) -> tuple[Quantity, ...]:
    """Quantities that the data cannot tell, for one reason."""
    return tuple(Quantity(name, unit, reason=reason, motion=motion) for name in names)


def quantity(told: Iterable[Quantity], name: str) -> Quantity:
    """The one of that name; raises `KeyError`."""
    for each in told:
        if each.name == name:
            return each
    raise KeyError(name)
