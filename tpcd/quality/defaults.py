"""Samples that a driver fills in where it read nothing: zeros in all channels, or one vector.

A sensor that works hardly ever gives the same numbers in all of its channels again, for each of
them has noise. Where one vector comes again and again, more often than readings near it could by
chance, it is no reading; filters and means would take it for one. A channel that
often reads its number of that vector while others do not has a dead zone there, and a vector of
dead zones is a reading. One that comes in a few long stretches is frozen (`stretches`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from tpcd.quality.channels import MIXED, POSE, WRENCH, Channel, channels_of
from tpcd.quality.habit import middle
from tpcd.quality.stream import Stream, read

AGAIN = 6
"""A vector that comes less often, in stretches of their own, is not looked at."""
LOOKED_AT = 5
"""So many vectors that come again are looked at: those with most jumps to and from them."""
NEAR = 4.0
"""Readings are near each other within so many standard deviations of their noise."""
CERTAIN = 5.0
"""Standard deviations by which it comes more often than chance explains."""


def find_defaults(stream: Stream) -> Bool[np.ndarray, " k"]:
    """Samples of a stream that hold no reading."""
    none = np.zeros(len(stream.times), dtype=bool)
    held = np.flatnonzero(read(stream))
    whole = replace(stream, times=stream.times[held], values=stream.values[held])
    channels = [each for each in channels_of([whole], (*POSE, *WRENCH)) if each.habit.lively]
    if len(channels) < 2:
        return none
    mixed = np.column_stack([each.values for each in channels]) @ MIXED[: len(channels)]
    jumps = np.abs(np.diff(mixed, prepend=mixed[0]))
    starts = np.flatnonzero((jumps > 0) | (np.arange(len(mixed)) == 0))
    numbers, which, counts = np.unique(mixed[starts], return_inverse=True, return_counts=True)
    # What is no reading comes often and far from those around it; one at rest comes often as well.
    far = np.where(counts >= AGAIN, np.bincount(which, jumps[starts]), 0.0)
    for k in np.argsort(far)[: -LOOKED_AT - 1 : -1]:
        same = mixed == numbers[k]
        if far[k] > 0 and _filled_in(channels, same, int(counts[k])):
            none[held] = same
            break
    return none


def _filled_in(channels: Sequence[Channel], same: Bool[np.ndarray, " n"], often: int) -> bool:
    """Whether a vector that some samples hold comes more often than by chance, and none of its
    numbers alone."""
    near, chance = ~same, 1.0
    for each in channels:
        step, noise, number = each.habit.step, each.habit.noise, each.values[np.argmax(same)]
        close = ~same & (np.abs(each.values - number) <= NEAR * noise + step)
        again = middle(step, noise)
        if (each.values[~same] == number).sum() > _most(again * close.sum()):
            return False
        near, chance = near & close, chance * again
    return bool(often > _most(chance * int(near.sum())))


def _most(expected: float) -> float:
    """What is counted by chance at most."""
    return expected + CERTAIN * math.sqrt(expected + 1.0)
