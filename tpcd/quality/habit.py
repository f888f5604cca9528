"""How one channel of a recording usually behaves: what is repeated, in which steps, what noise.

A sensor that works gives another number with every new sample, since its noise never rests; one
that repeats a number for much longer than that is frozen. What "much longer" is depends on the
channel: on how often it is updated, on the steps it is printed in, and on whether it has noise at
all. A simulated arm without noise stands still exactly, and that is no fault.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

FALSE_ALARM = 1e-6
"""Probability of a false alarm for each channel of a recording."""
FEWEST = 10
"""Updates that repeat a number below which nothing is called frozen."""
LONGER = 20.0
"""A run this many times longer than the run that a typical sample is in is no habit."""
QUIET = 16
"""Changes that are looked at together."""
QUIET_SHARE = 0.2
"""Part of them, the quietest, in which noise shows best."""
LEAST_TURNS = 0.1
"""Noise turns back and forth: white noise in 2 of 3 changes; an arm that settles hardly ever."""
LEAST_FLOOR = 0.1
"""Noise is steady: its quietest moments have this part of the usual ones; settling has none."""
ENOUGH = 100_000
"""Samples that show the steps of a reading."""
COARSEST = 3.0
"""Steps of a reading that are larger than this many standard deviations hide its noise."""


@dataclass(frozen=True, eq=False)
class Habit:
    """What is usual for a channel of n samples."""

    starts: Int[np.ndarray, " r"]
    """First sample of each run of equal values."""
    lengths: Int[np.ndarray, " r"]
    """Samples in it."""
    hold: int
    """Samples between updates; 1 where every sample is new."""
    step: float
    """Smallest step between readings, where they are whole multiples of one; else 0."""
    noise: float
    """Standard deviation from one update to the next where the channel is quietest; 0 without."""
    lively: bool
    """Whether noise shows at all times, so that repeats mean something."""
    longest: float
    """Samples that a working sensor may repeat a number for."""

    @property
    def long(self) -> Bool[np.ndarray, " r"]:
        """Runs that are longer than that."""
        return self.lengths >= self.longest


def find_habit(values: Float[np.ndarray, " n"], step: float | None = None) -> Habit:
    """The habit of finite samples in order of recording, of which there is at least one.

    `step` is that between readings, None to find it.
    """
    step = grid_step(values) if step is None else step
    starts = np.concatenate(([0], np.flatnonzero(np.diff(values) != 0) + 1))
    lengths = np.diff(np.append(starts, len(values)))
    hold = max(1, round(float(np.median(lengths))))
    if len(starts) < 4:
        return Habit(starts, lengths, hold, step, 0.0, False, math.inf)
    typical = _typical_length(lengths)
    longest = FEWEST * hold
    if typical > 1.5 * hold:
        longest = max(longest, LONGER * typical)
    usual = lengths < longest
    noise, lively = _noise(values, hold, np.repeat(usual, lengths))
    repeated = 1.0 - usual.sum() / max(1.0, lengths[usual].sum() / hold)
    surprise = -math.log(FALSE_ALARM / len(values))
    for again in (repeated, middle(step, noise)):
        if 0.0 < again < 1.0:
            longest = max(longest, hold * (1.0 + surprise / -math.log(again)))
    lively = lively and step <= COARSEST * noise
    return Habit(starts, lengths, hold, step, noise, lively, float(longest))


def _typical_length(lengths: Int[np.ndarray, " r"]) -> float:
    """The length of the run that a typical sample is in; one run that is a large part of all is a
    sensor that died rather than its habit."""
    total = lengths.sum()
    kept = np.sort(lengths[lengths < 0.2 * total])
    if not len(kept):
        kept = np.sort(lengths)
    return float(kept[np.searchsorted(np.cumsum(kept), kept.sum() / 2)])


def _noise(
    values: Float[np.ndarray, " n"], hold: int, usual: Bool[np.ndarray, " n"]
) -> tuple[float, bool]:
    """Standard deviation of the noise, and whether it is there at all times."""
    changes = np.diff(values[::hold])[usual[::hold][1:]]
    blocks = len(changes) // QUIET
    if blocks < 4:
        return 0.0, False
    parts = changes[: blocks * QUIET].reshape(blocks, QUIET)
    sizes = np.abs(parts).mean(1)
    low, high = np.quantile(sizes, (0.02, QUIET_SHARE))
    quiet = parts[sizes <= high]
    moved = quiet[(quiet != 0).any(1)]
    turns = _turns(moved) if len(moved) else 0.0
    # A difference of two samples of white noise has twice its variance.
    noise = math.sqrt(float((quiet**2).mean()) / 2.0)
    return noise, turns >= LEAST_TURNS and bool(low >= LEAST_FLOOR * high > 0)


def _turns(parts: Float[np.ndarray, "b q"]) -> float:
    """The part of changes that are not zero after which the next one goes the other way."""
    directions = np.sign(parts).ravel()
    directions = directions[directions != 0]
    return float((directions[1:] * directions[:-1] < 0).mean()) if len(directions) > 1 else 0.0


def grid_step(values: Float[np.ndarray, " n"]) -> float:
    """The step between readings where all are whole multiples of it; else 0."""
    levels = np.unique(values[:: max(1, len(values) // ENOUGH)])
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(1e-300, float(np.abs(levels).max()))]
    if not len(gaps):
        return 0.0
    step = float(gaps.min())
    off = gaps / step
    whole = np.abs(off - np.round(off)) < 0.02 * np.maximum(1.0, off)
    # Of numbers with many digits the smallest gap is chance, and few others are multiples of it.
    return step if whole.mean() > 0.98 and np.median(off) < 50.0 else 0.0


def middle(step: float, noise: float) -> float:
    """How often a reading repeats whose value is in the middle of a step: at most so often."""
    return math.erf(step / (2.0 * math.sqrt(2.0) * noise)) if noise > 0 else 0.0


def resolution(values: Float[np.ndarray, " n"]) -> float:
    """The smallest step between readings; 0 where all are equal."""
    steps = np.diff(np.unique(values))
    return float(steps.min()) if len(steps) else 0.0
