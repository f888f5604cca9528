"""Samples of one sensor on its own clock, as they were recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Stream:
    """k samples of one topic of a bag, or of the columns of a table that share a clock."""

    name: str
    """Topic, or file."""
    channels: tuple[str, ...]
    """What the columns are, as in a column map: x, y, z, qx, ..., F_x, ..., u_x, ..."""
    times: Float[np.ndarray, " k"]
    """[s] in the order of recording, on the clock that all streams of the recording share."""
    values: Float[np.ndarray, "k w"]
    """SI units; NaN where the recording has no number."""
    stamps: Float[np.ndarray, " k"] | None = None
    """The sender's own times [s], where they are another clock than `times`."""
