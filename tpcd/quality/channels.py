"""Every channel of a recording by itself: frozen, clipped, never moving, updated too seldom.

Set points are not judged here: they are held on purpose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tpcd.quality.finding import Finding, Weight
from tpcd.quality.habit import COARSEST, Habit, find_habit, grid_step
from tpcd.quality.spikes import find_spikes
from tpcd.quality.stream import Stream
from tpcd.quality.stretches import (
    Stretch,
    clipped_stretches,
    frozen_stretches,
    squeezed_stretches,
)

FORCES = ("F_x", "F_y", "F_z")
TORQUES = ("T_x", "T_y", "T_z", "tau")
WRENCH = (*FORCES, *TORQUES)
POSITIONS = ("x", "y", "z")
ROTATIONS = ("rx", "ry", "rz", "qx", "qy", "qz", "qw", "e1", "e2", "e3", "phi")
COUNTED = ("e1", "e2", "e3", "phi")
"""Angles that begin again after a turn."""
POSE = (*POSITIONS, *ROTATIONS)
UNITS = {
    **dict.fromkeys(POSITIONS, "m"),
    **dict.fromkeys(("rx", "ry", "rz", "e1", "e2", "e3", "phi", "rotation"), "rad"),
    **dict.fromkeys(FORCES, "N"),
    **dict.fromkeys(TORQUES, "N·m"),
}
"""SI units of channels; quaternions have none."""
MIXED = np.sqrt([1.0, 2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0, 29.0])
"""A sum with these weights changes where any of its parts does."""
MOST_LISTED = 6
ROUNDED = 1e-7
"""Lengths of vectors that are turned differ by this part in single precision."""
ALL_BUT = 0.9
"""Part of the steps of a length that are none, in a stretch in which it stays."""
FINE = 0.2
"""Steps of a length that are larger beside its noise tell nothing."""
TOGETHER = 2
"""Channels whose stretches begin and end within so many samples share one cause."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One column of a stream: its finite samples, and how it usually behaves."""

    name: str
    stream: Stream
    samples: Int[np.ndarray, " n"]
    """Rows of the stream that have a number."""
    values: Float[np.ndarray, " n"]
    habit: Habit

    @property
    def times(self) -> Float[np.ndarray, " n"]:
        """[s]"""
        return self.stream.times[self.samples]


def channels_of(streams: Sequence[Stream], names: Sequence[str]) -> Iterator[Channel]:
    """The channels of some names that hold any number.

    The entries of a rotation are one channel, for each of them may stand still by itself: near
    its largest value the scalar part of a quaternion hardly changes.
    """
    for stream in streams:
        present = [(k, n) for k, n in enumerate(stream.channels) if n in names]
        turning = [k for k, n in present if n in ROTATIONS]
        parts = [([k], n) for k, n in present if n not in ROTATIONS]
        parts += [(turning, "rotation")] if turning else []
        for columns, name in parts:
            found = stream.values[:, columns]
            samples = np.flatnonzero(np.isfinite(found).all(1))
            if len(samples):
                weights = MIXED[: len(columns)] if len(columns) > 1 else np.ones(1)
                whole = found[samples]
                if any(stream.channels[k] in COUNTED for k in columns):
                    # A turn back and forth at the end of the circle is no spike.
                    whole = np.unwrap(whole, axis=0)
                values = whole @ weights
                step = sum(w * grid_step(v) for w, v in zip(weights, found[samples].T, strict=True))
                yield Channel(name, stream, samples, values, find_habit(values, float(step)))


def check_channels(streams: Sequence[Stream]) -> tuple[Finding, ...]:
    """What is wrong with single channels; times are [s] on the clock of the streams."""
    found = [each for stream in streams for each in _missing(stream)]
    for group in (POSE, WRENCH):
        for stream in streams:
            channels = list(channels_of([stream], group))
            stretches: list[tuple[str, Channel, Stretch]] = []
            for channel in channels:
                found += _manner(channel)
                stretches += _stretches(channel, group)
            stretches += _turned(stream, stretches) if group == WRENCH else []
            found += _told(stretches)
    return tuple(found)


def _stretches(channel: Channel, group: Sequence[str]) -> Iterator[tuple[str, Channel, Stretch]]:
    """Stretches of a channel with their kind; a number at the end of the range is a limit."""
    stream = channel.stream
    beside = [k for k, n in enumerate(stream.channels) if n in group and n != channel.name]
    if channel.name == "rotation":
        beside = [k for k in beside if stream.channels[k] not in ROTATIONS]
    others = stream.values[channel.samples][:, beside]
    clipped = ()
    if group == WRENCH:
        clipped = clipped_stretches(channel.values, channel.habit)
        clipped = clipped or squeezed_stretches(channel.values, channel.habit)
    yield from (("clipped", channel, each) for each in clipped)
    told = {each.value for each in clipped}
    ends = {float(channel.values.min()), float(channel.values.max())} if group == WRENCH else set()
    for each in frozen_stretches(channel.values, channel.habit, others):
        if each.value not in told:
            yield "clipped" if each.value in ends else "frozen", channel, each
    for place in find_spikes(channel.values, channel.habit.step):
        yield "spike", channel, Stretch(int(place), int(place) + 1, float(channel.values[place]))


def _turned(
    stream: Stream, known: Sequence[tuple[str, Channel, Stretch]]
) -> list[tuple[str, Channel, Stretch]]:
    """Stretches in which a force or a torque keeps its length, to the digits it is written in, and
    none of its entries alone: the sensor was frozen, and its readings turned with the hand."""
    found = []
    for names in (FORCES, TORQUES):
        present = [k for k, name in enumerate(stream.channels) if name in names]
        samples = np.flatnonzero(np.isfinite(stream.values[:, present]).all(1))
        if len(present) < 2 or not len(samples):
            continue
        parts = stream.values[np.ix_(samples, present)]
        lengths = np.linalg.norm(parts, axis=1)
        digits = float(np.linalg.norm([grid_step(column) for column in parts.T]))
        least = max(2.0 * digits, ROUNDED * float(lengths.max()))
        again = np.abs(np.diff(lengths, prepend=np.inf)) <= least
        kept = lengths[np.maximum.accumulate(np.where(again, 0, np.arange(len(samples))))]
        habit = find_habit(kept, least)
        if not habit.lively or least > FINE * habit.noise:
            continue
        channel = Channel(
            ", ".join(stream.channels[k] for k in present), stream, samples, kept, habit
        )
        for each in frozen_stretches(kept, habit, np.empty((len(kept), 0))):
            alone = {
                other.name
                for _, other, one in known
                if 2 * (min(one.end, each.end) - max(one.first, each.first)) > each.end - each.first
            }
            rest = [k for k, c in enumerate(present) if stream.channels[c] not in alone]
            moving = parts[each.first : each.end, rest]
            left = np.abs(np.diff(np.linalg.norm(moving, axis=1)))
            # Where one entry froze that is nearly all of the length, the others go on.
            if np.ptp(moving, axis=0).any() and np.quantile(left, ALL_BUT) <= least:
                found.append(("frozen", channel, each))
    return found


def _missing(stream: Stream) -> Iterator[Finding]:
    """Samples that hold no number."""
    lacking = ~np.isfinite(stream.values)
    rows = np.flatnonzero(lacking.any(1))
    if len(rows):
        names = tuple(n for k, n in enumerate(stream.channels) if lacking[:, k].any())
        first, last = stream.times[rows[[0, -1]]]
        told = (
            f"{len(rows)} of {len(stream.times)} samples lack a number ({', '.join(names)}; rows"
            f" {listed_rows(rows)}; from {first:.4g} to {last:.4g} s) and are not used"
        )
        yield Finding("missing", Weight.NOTE, told, names)


def listed_rows(rows: Int[np.ndarray, " k"]) -> str:
    """Rows as ranges, the first few of them."""
    cuts = np.flatnonzero(np.diff(rows) > 1)
    parts = [
        f"{part[0]}" if len(part) == 1 else f"{part[0]} to {part[-1]}"
        for part in np.split(rows, cuts + 1)
    ]
    return ", ".join(parts[:MOST_LISTED]) + (", …" if len(parts) > MOST_LISTED else "")


def _manner(channel: Channel) -> Iterator[Finding]:
    """How a channel is recorded, where that hides something: never changing, seldom updated, or in
    steps larger than its noise."""
    habit, count = channel.habit, len(channel.values)
    if count > 1 and len(habit.starts) == 1:
        value = "" if channel.name == "rotation" else f" at {channel.values[0]:.6g}"
        told = f"{channel.name} stays{value} in all {count} samples: not recorded, or nothing"
        yield Finding("constant", Weight.NOTE, f"{told} moves it", (channel.name,))
        return
    if habit.hold > 1 and np.quantile(habit.lengths, 0.9) <= 2 * habit.hold:
        told = f"{channel.name} is updated with every {habit.hold}th sample only"
        yield Finding("slow", Weight.NOTE, told, (channel.name,))
    if habit.step > COARSEST * habit.noise and channel.name != "rotation" and not habit.lively:
        told = f"{channel.name} comes in steps of {habit.step:.3g}, which hide its noise"
        remedy = "whether it ever froze or was clipped cannot be told"
        yield Finding("coarse", Weight.NOTE, told, (channel.name,), remedy=remedy)


def _told(stretches: list[tuple[str, Channel, Stretch]]) -> Iterator[Finding]:
    """One finding for each stretch; channels that freeze together are named together."""
    left = sorted(stretches, key=lambda each: (each[0], each[2].first, each[2].end))
    while left:
        kind, channel, stretch = left[0]
        same = [
            each
            for each in left
            if each[0] == kind
            and abs(each[2].first - stretch.first) <= TOGETHER
            and abs(each[2].end - stretch.end) <= TOGETHER
        ]
        left = [each for each in left if each not in same]
        yield _finding(kind, channel, [each[1].name for each in same], stretch)


def _finding(kind: str, channel: Channel, names: list[str], stretch: Stretch) -> Finding:
    times, count = channel.times, stretch.end - stretch.first
    start, end = float(times[stretch.first]), float(times[stretch.end - 1])
    rows = int(channel.samples[stretch.first]), int(channel.samples[stretch.end - 1]) + 1
    turned = any(", " in name for name in names)
    parts = tuple(dict.fromkeys(part for name in names for part in name.split(", ")))
    who, alone = ", ".join(parts), len(parts) == 1 and names[0] != "rotation"
    during = f"from {start:.4g} to {end:.4g} s ({count} samples, rows {rows[0]} to {rows[1] - 1})"
    remedy = "look at the sensor's connection and driver"
    if kind == "spike":
        size = stretch.value - channel.values[stretch.first - 1]
        what = f"a spike of {size:.4g}" if alone else "a spike"
        told = f"{who}: {what} at {start:.4g} s (row {rows[0]})"
        # Whoever interpolates between samples must not use it on either side.
        start, end = (float(times[stretch.first + k]) for k in (-1, 1))
        remedy = "look at the sensor's cable and driver"
    elif kind == "clipped":
        told = (
            f"{who}: at the end of its range{f', {stretch.value:.6g},' if alone else ''} {during}"
        )
        remedy = "press less, or use a sensor with a larger range"
    else:
        told = f"{who}: frozen {f'at {stretch.value:.6g} ' if alone else ''}{during}"
        if turned:
            told = f"{who}: frozen in the sensor and turned with the hand {during}: their length"
            told += f" stays {stretch.value:.6g}"
        if channel.habit.lively:
            told += f", expected at most {channel.habit.longest:.0f} samples with one value"
        else:
            told += ", then it jumps, while others moved"
    return Finding(kind, Weight.LEFT_OUT, told, parts, start, end, rows, remedy)
