"""Every channel of a recording by itself: frozen, clipped, never moving, updated too seldom.

Set points are not judged here: they are held on purpose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tpcd.quality.finding import Finding, Weight
from tpcd.quality.habit import Habit, find_habit
from tpcd.quality.stream import Stream
from tpcd.quality.stretches import Stretch, clipped_stretches, frozen_stretches

FORCES = ("F_x", "F_y", "F_z")
TORQUES = ("T_x", "T_y", "T_z", "tau")
WRENCH = (*FORCES, *TORQUES)
POSITIONS = ("x", "y", "z")
ROTATIONS = ("rx", "ry", "rz", "qx", "qy", "qz", "qw", "e1", "e2", "e3", "phi")
POSE = (*POSITIONS, *ROTATIONS)
MIXED = np.sqrt([1.0, 2.0, 3.0, 5.0])
"""A sum with these weights changes where any of its parts does."""
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
                values = found[samples, 0]
                if len(columns) > 1:
                    values = found[samples] @ MIXED[: len(columns)]
                yield Channel(name, stream, samples, values, find_habit(values))


def check_channels(streams: Sequence[Stream]) -> tuple[Finding, ...]:
    """What is wrong with single channels; times are [s] on the clock of the streams."""
    found: list[Finding] = []
    for group in (POSE, WRENCH):
        for stream in streams:
            channels = list(channels_of([stream], group))
            stretches: list[tuple[str, Channel, Stretch]] = []
            for channel in channels:
                found += _still(channel)
                stretches += _stretches(channel, group)
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
    yield from (("clipped", channel, each) for each in clipped)
    told = {each.value for each in clipped}
    ends = {float(channel.values.min()), float(channel.values.max())} if group == WRENCH else set()
    for each in frozen_stretches(channel.values, channel.habit, others):
        if each.value not in told:
            yield "clipped" if each.value in ends else "frozen", channel, each


def _still(channel: Channel) -> Iterator[Finding]:
    """A channel that never changes was not recorded, or measures nothing."""
    if len(channel.values) > 1 and len(channel.habit.starts) == 1:
        value = "" if channel.name == "rotation" else f" at {channel.values[0]:.6g}"
        yield Finding(
            "constant",
            Weight.NOTE,
            f"{channel.name} stays{value} in all {len(channel.values)} samples: not recorded,"
            " or nothing moves it",
            (channel.name,),
        )


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
    who = ", ".join(names)
    during = f"from {start:.4g} to {end:.4g} s ({count} samples, rows {rows[0]} to {rows[1] - 1})"
    if kind == "frozen":
        value = f"at {stretch.value:.6g} " if names[0] != "rotation" and len(names) == 1 else ""
        usual = f"at most {channel.habit.longest:.0f}" if channel.habit.lively else "a change"
        told = f"{who}: frozen {value}{during}, expected {usual} samples with one value"
        if not channel.habit.lively:
            told = f"{who}: frozen {value}{during}, then it jumps, while others moved"
        remedy = "left out; look at the sensor's connection and driver"
    else:
        told = f"{who}: at the end of its range, {stretch.value:.6g}, {during}"
        remedy = "left out; press less, or use a sensor with a larger range"
    return Finding(kind, Weight.LEFT_OUT, told, tuple(names), start, end, rows, remedy)
