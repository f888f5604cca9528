"""An object unlike those of the shape prior: of other size, or less alike.

A diagnosis that explains its data so (`tpcd.discrepancy.variants.wide_shape`) writes it into its
model file, under the key `shape`, for estimates of the same object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

Bounds = Mapping[str, tuple[float, float]]
"""Ranges of scene entries by name [SI units]."""
MOST = 1000.0
"""Times as much error of an outline as can be meant."""


@dataclass(frozen=True)
class ShapeChange:
    """What replaces the expectations of a shape prior; by default nothing does."""

    scale: tuple[float, float] | None = None
    """Range of the scale, in place of the usual one or that of an episode's priors."""
    misfit: float = 1.0
    """Times as much error of the outline is expected."""

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if self.scale is not None and not 0 < self.scale[0] < self.scale[1] < math.inf:
            raise ValueError(f"scale is {list(self.scale)}, expected [low, high], 0 < low < high")
        if not 0 < self.misfit <= MOST:
            raise ValueError(f"misfit is {self.misfit}, expected a number above 0, up to {MOST:g}")

    def bounds(self, priors: Bounds) -> Bounds:
        """The priors of an episode with the range of the scale."""
        return priors if self.scale is None else {**priors, "scale": self.scale}

    def to_plain(self) -> dict[str, Any]:
        """What is changed, in plain values; empty where nothing is."""
        plain = {k: v for k, v in asdict(self).items() if v != getattr(UNCHANGED, k)}
        return plain if self.scale is None else plain | {"scale": list(self.scale)}


UNCHANGED = ShapeChange()


def shape_from_plain(plain: Any) -> ShapeChange:
    """The change of a model file; raises ValueError."""
    if not isinstance(plain, Mapping) or set(plain) - {"scale", "misfit"}:
        raise ValueError(f"shape is {plain!r}, expected any of scale, misfit")
    scale, misfit = plain.get("scale"), plain.get("misfit", 1.0)
    try:
        ends = None if scale is None else tuple(float(end) for end in scale)
        factor = float(misfit)
    except (TypeError, ValueError):
        raise ValueError(
            f"shape is {dict(plain)!r}, expected scale: [low, high] and misfit: a number"
        ) from None
    if ends is not None and len(ends) != 2:
        raise ValueError(f"shape: scale is {scale!r}, expected [low, high]")
    try:
        return ShapeChange(ends, factor)
    except ValueError as error:
        raise ValueError(f"shape: {error}") from None
