"""Stretches of a channel that are no measurement: frozen, or clipped at the end of its range.

Times are those of the stream [s since its first sample of the recording]; rows are samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from tpcd.quality.habit import Habit, find_habit

BRIDGED = 20
"""Clipped samples this few updates apart are one stretch: what is between is cut off in part."""
FEWEST_CLIPPED = 5
"""Samples at the end of the range below which nothing is called clipped."""
FINEST = 1.5
"""Steps beyond this many standard deviations repeat their largest value by themselves."""
JUMP = 5.0
"""A channel without noise is frozen where it comes back with a jump of this many times its largest
change elsewhere."""
OFTEN = 0.75
"""Part of the moments in which readings scatter by less than what is usual,"""
SQUEEZED = 5.0
"""and behind a limit they scatter so many times less than that,"""
AROUND = 8
"""over so many updates,"""
AGAIN = 2
"""and do so at one level in so many stretches,"""
WITHIN = 4.5
"""which they keep to within so many standard deviations,"""
RARE = 0.1
"""while hardly any others do: this part of them."""
FEWEST_MOVES = 20
"""Changes of its neighbours meanwhile that such a verdict needs."""


@dataclass(frozen=True)
class Stretch:
    """Samples `first` to `end` (excluded) of one channel."""

    first: int
    end: int
    value: float
    """The number repeated."""


def frozen_stretches(
    values: Float[np.ndarray, " n"], habit: Habit, others: Float[np.ndarray, "n w"]
) -> tuple[Stretch, ...]:
    """Where a channel repeats one number for longer than its habit allows.

    `others` are channels of the same sensor. Without noise of its own, a channel is frozen only
    where it comes back with a jump after others changed.
    """
    chosen = habit.long if habit.lively else _came_back(values, habit, others)
    return tuple(
        Stretch(int(first), int(first + length), float(values[first]))
        for first, length in zip(habit.starts[chosen], habit.lengths[chosen], strict=True)
    )


def clipped_stretches(values: Float[np.ndarray, " n"], habit: Habit) -> tuple[Stretch, ...]:
    """Where a channel stands at its largest or smallest value as no sensor does by chance.

    Noise gives the largest number once, or seldom; a sensor at the end of its range gives it again
    and again. Told only of channels whose noise shows in their steps.
    """
    if not habit.lively or habit.step > FINEST * habit.noise:
        return ()
    found: list[Stretch] = []
    for sign in (1.0, -1.0):
        top = float((sign * values).max())
        at_end = sign * values == top
        near = max(1.5 * habit.step, 1e-9 * abs(top))
        beside = int(((sign * values >= top - near) & ~at_end).sum())
        count = int(at_end.sum())
        enough = count >= FEWEST_CLIPPED * habit.hold and count > 1.5 * beside
        if enough and count > beside + 5.0 * np.sqrt(habit.hold * (beside + 1.0)):
            found += _bridged(at_end, BRIDGED * habit.hold, sign * top)
    return tuple(sorted(found, key=lambda each: each.first))


def squeezed_stretches(values: Float[np.ndarray, " n"], habit: Habit) -> tuple[Stretch, ...]:
    """Where a channel is at the end of its range before its last noise, as of digits, is added:
    readings scatter much less than elsewhere, several times at one level, and none lies beyond it.

    Free air may be so quiet and at an end too; a recording begins in it.
    """
    updates = values[:: habit.hold]
    if len(updates) < 4 * AROUND:
        return ()
    bend = np.diff(updates, 2, prepend=updates[:1], append=updates[-1:])
    # A second difference of white noise has six times its variance.
    local = np.sqrt(np.maximum(uniform_filter1d(bend**2, AROUND, mode="nearest"), 0.0) / 6.0)
    usual = float(np.quantile(local, OFTEN))
    quiet = (local < usual / SQUEEZED) & (local > 0.0)
    found: list[Stretch] = []
    for sign in (1.0, -1.0):
        top = float((sign * updates).max())
        near = quiet & (sign * updates > top - usual)
        if near.sum() < AGAIN * AROUND or (quiet & ~near).sum() > RARE * near.sum():
            continue
        scatter = max(float(np.median(local[near])), habit.step / np.sqrt(12.0))
        level = float(np.median(sign * updates[near]))
        band = np.abs(sign * values - level) <= WITHIN * scatter
        begun = band[: AROUND * habit.hold].any()
        if begun or band.all() or top > level + WITHIN * scatter:
            continue
        if find_habit(values[~band]).lively:
            stretches = _bridged(band, BRIDGED * habit.hold, sign * level)
            least = AROUND * habit.hold
            long = [each for each in stretches if band[each.first : each.end].sum() >= least]
            found += long if len(long) >= AGAIN else []
    return tuple(sorted(found, key=lambda each: each.first))


def _came_back(
    values: Float[np.ndarray, " n"], habit: Habit, others: Float[np.ndarray, "n w"]
) -> Bool[np.ndarray, " r"]:
    """Long runs of a channel without noise that end in a jump, while other channels moved."""
    chosen = np.zeros(len(habit.starts), dtype=bool)
    if len(habit.starts) < 3 or not others.shape[1]:
        return chosen
    # edges[k] is the change into run k; the first run has none, the last never ends.
    edges = np.abs(np.diff(values[habit.starts], prepend=np.nan))
    long = (habit.lengths >= FEWEST_MOVES) & (habit.lengths > 5 * habit.hold)
    inside = ~long
    inside[1:] &= ~long[:-1]
    inside[0] = False
    if inside.sum() < FEWEST_MOVES:
        return chosen
    largest = edges[inside].max()
    moved = (np.diff(others, axis=0) != 0).any(1)
    counted = np.concatenate(([0], np.cumsum(moved)))
    last = habit.starts + habit.lengths - 1
    moves = counted[last] - counted[habit.starts]
    back = np.append(edges[1:], 0.0)
    return long & (moves >= FEWEST_MOVES) & (back > JUMP * largest)


def _bridged(marked: Bool[np.ndarray, " n"], gap: int, value: float) -> list[Stretch]:
    """Marked samples as stretches, those at most `gap` apart as one."""
    places = np.flatnonzero(marked)
    cuts = np.flatnonzero(np.diff(places) > gap)
    firsts = places[np.concatenate(([0], cuts + 1))]
    lasts = places[np.append(cuts, len(places) - 1)]
    return [Stretch(int(a), int(b) + 1, value) for a, b in zip(firsts, lasts, strict=True)]
