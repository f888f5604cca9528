"""Spikes: single samples far from what comes before and after, which agree.

A step or an impact stays where it went, or swings; a spike of a cable or of a driver is gone with
the next sample.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import median_filter

WIDTH = 5
"""Samples whose median a sample is compared with."""
BLOCK = 64
"""Samples over which the usual distance to that median is taken, so that an arm that rings or
chatters is compared with itself."""
FAR = 12.0
"""A spike is this many standard deviations away."""
ALONE = 0.2
"""The two samples on either side are within this part of it of each other, and of the median."""
LEAST_SHARE = 0.02
"""And it is at least this part of the range of the channel: what is smaller harms nothing."""
LEAST_STEPS = 3.0
"""And so many steps of the reading."""


def find_spikes(values: Float[np.ndarray, " n"], step: float) -> Int[np.ndarray, " k"]:
    """Samples that are spikes, in finite values in order of recording with a resolution `step`."""
    whole = len(values) // BLOCK
    if not whole:
        return np.zeros(0, dtype=np.int64)
    away = np.abs(values - median_filter(values, WIDTH, mode="nearest"))
    low, high = np.quantile(values, (0.01, 0.99))
    least = max(FAR * _usual(away), LEAST_SHARE * (high - low), LEAST_STEPS * step)
    far = np.flatnonzero(away > least)
    far = far[(far >= 2) & (far < len(values) - 2)]
    if not len(far):
        return far
    places = np.minimum(far // BLOCK, whole - 1)
    blocks = away[: whole * BLOCK].reshape(-1, BLOCK)
    around = np.array([_usual(blocks[max(0, k - 1) : k + 2].ravel()) for k in places])
    sides = np.stack([values[far + k] for k in (-2, -1, 1, 2)])
    alone = np.ptp(sides, axis=0) <= ALONE * away[far] + LEAST_STEPS * step / 2.0
    return far[(away[far] > FAR * around) & alone]


def _usual(away: Float[np.ndarray, " n"]) -> float:
    """A standard deviation of what is usually left, from its 90 % quantile."""
    return float(np.quantile(away, 0.9)) / 1.645
