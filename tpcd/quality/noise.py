"""Noise and creep of every channel while the arm stands still, without any model.

The arm rests where its set point is held, if one was recorded, and its pose moves hardly more than
in the quietest moments. A row of an episode is the mean over such a moment, and its standard
deviation comes from means of four blocks (batch means: Law and Kelton, "Simulation Modeling and
Analysis"), so noise that is correlated for less than a block counts in full.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tpcd.quality.channels import POSE, UNITS, WRENCH, Channel, channels_of
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.habit import grid_step
from tpcd.quality.stream import Stream

WINDOW = 0.5
"""Length of the moments that are looked at [s], that of a row of an import."""
FEWEST = 16
"""Samples in a moment; a slower recording has longer ones."""
BLOCKS = 4
QUIETEST = 0.1
"""The part of all moments that shows how still the arm can stand."""
STILL = 3.0
"""A moment counts as rest where the pose spreads by at most this many times as much."""
MOST_MOTION = (2e-3, 5e-3)
"""Whatever spreads by more is no rest [m, rad or a quaternion's 1]."""
LONG = 5.0
"""Rests of this length or more tell of creep [s]."""
SURE = 4.0
"""Creep is told from this many standard errors on."""


@dataclass(frozen=True)
class RestNoise:
    """Noise of one channel at rest, in its SI unit."""

    name: str
    moments: int
    """Moments of rest that it was measured in."""
    sample: float
    """One standard deviation of a sample."""
    row: float
    """One standard deviation of the mean over a moment; nan where a moment has few samples."""
    creep: float
    """Largest change over a rest that is beyond the noise; 0 where there is none."""
    creep_time: float
    """How long that rest was [s]."""

    @property
    def correlation(self) -> float:
        """How many samples say as much as one of white noise would."""
        return self.row**2 / self.sample**2 if self.sample > 0 else math.nan


def rests(streams: Sequence[Stream]) -> Float[np.ndarray, "k 2"]:
    """Begin and end of the moments at rest [s]; none where there is no pose."""
    poses = [s for s in streams if set(s.channels) & set(POSE)]
    if not poses:
        return np.empty((0, 2))
    stream = poses[0]
    columns = [k for k, n in enumerate(stream.channels) if n in POSE]
    edges = _edges(stream.times)
    if len(edges) < 2:
        return np.empty((0, 2))
    spread = _spread(stream.values[:, columns], edges)
    floor = np.quantile(spread, QUIETEST, axis=0)
    angular = np.array([stream.channels[k] not in ("x", "y", "z") for k in columns])
    allowed = np.minimum(STILL * floor, np.where(angular, MOST_MOTION[1], MOST_MOTION[0]))
    still = (spread <= allowed + 1e-9).all(1)
    spans = np.stack((stream.times[edges[:-1]], stream.times[edges[1:] - 1]), axis=1)
    for other in streams:
        still &= _held(other, spans)
    return spans[still]


def noise_at_rest(streams: Sequence[Stream]) -> tuple[RestNoise, ...]:
    """Noise of every channel of pose and wrench; empty where the arm is never at rest.

    That of a rotation is the angle by which it turns, about whatever axis [rad].
    """
    spans = rests(streams)
    if not len(spans):
        return ()
    found = []
    for channel in channels_of(streams, (*POSE, *WRENCH)):
        parts = [_measured(channel, name, values, spans) for name, values in _columns(channel)]
        if channel.name == "rotation":
            factor = 2.0 if any(part.name.startswith("q") for part in parts) else 1.0
            parts = [_together(parts, factor)]
        found += parts
    return tuple(found)


def _together(parts: Sequence[RestNoise], factor: float) -> RestNoise:
    """Noise of all entries of a rotation as one angle; a quaternion has half of it."""

    def root(values: Sequence[float]) -> float:
        return factor * math.sqrt(sum(value**2 for value in values))

    return RestNoise(
        "rotation",
        parts[0].moments,
        root([part.sample for part in parts]),
        root([part.row for part in parts]),
        root([part.creep for part in parts]),
        max(part.creep_time for part in parts),
    )


def check_noise_at_rest(noises: Sequence[RestNoise]) -> tuple[Finding, ...]:
    """Creep that is worth knowing of."""
    return tuple(
        Finding(
            "creep",
            Weight.NOTE,
            f"{each.name} creeps by {each.creep:.2g} {UNITS[each.name]} in {each.creep_time:.3g} s"
            f" at rest, where a row's noise is {each.row:.2g}",
            (each.name,),
            remedy="wait before reading, or zero the sensor more often",
        )
        for each in noises
        if each.creep > 0 and each.name in WRENCH
    )


def _columns(channel: Channel) -> list[tuple[str, Float[np.ndarray, " n"]]]:
    """The columns of a channel, by name; a rotation has several."""
    stream = channel.stream
    if channel.name != "rotation":
        return [(channel.name, channel.values)]
    names = [n for n in stream.channels if n in POSE and n not in ("x", "y", "z")]
    return [(n, stream.values[channel.samples, stream.channels.index(n)]) for n in names]


def _edges(times: Float[np.ndarray, " n"]) -> Int[np.ndarray, " e"]:
    """Samples at which moments begin, and the one after the last."""
    if len(times) < 2 * FEWEST:
        return np.zeros(0, dtype=np.int64)
    usual = float(np.median(np.diff(times)))
    size = max(FEWEST, math.ceil(WINDOW / usual) if usual > 0 else FEWEST)
    return np.arange(0, len(times) // size * size + 1, size, dtype=np.int64)


def _spread(values: Float[np.ndarray, "n w"], edges: Int[np.ndarray, " e"]) -> np.ndarray:
    """Largest minus smallest value in every moment; infinite where a number is missing."""
    size = int(edges[1])
    parts = values[: edges[-1]].reshape(len(edges) - 1, size, -1)
    spread = parts.max(1) - parts.min(1)
    return np.where(np.isfinite(spread), spread, np.inf)


def _held(stream: Stream, spans: Float[np.ndarray, "k 2"]) -> Bool[np.ndarray, " k"]:
    """The moments in which the set points of a stream do not change."""
    columns = [k for k, n in enumerate(stream.channels) if n.startswith("u_")]
    if not columns:
        return np.ones(len(spans), dtype=bool)
    changed = (np.abs(np.diff(stream.values[:, columns], axis=0)) > 1e-5).any(1)
    changes = stream.times[1:][changed]
    return np.searchsorted(changes, spans[:, 1], "right") == np.searchsorted(changes, spans[:, 0])


def _measured(
    channel: Channel,
    name: str,
    values: Float[np.ndarray, " n"],
    spans: Float[np.ndarray, "k 2"],
) -> RestNoise:
    times = channel.times
    first = np.searchsorted(times, spans[:, 0])
    end = np.searchsorted(times, spans[:, 1], "right")
    usual = ~np.repeat(channel.habit.long & channel.habit.lively, channel.habit.lengths)
    parts = []
    for a, b in zip(first, end, strict=True):
        if b - a >= 2 * BLOCKS and usual[a:b].all():
            parts.append((a, b))
    if not parts:
        return RestNoise(name, 0, math.nan, math.nan, 0.0, 0.0)
    squares, of_means, means = [], [], []
    for a, b in parts:
        part = values[a:b]
        line = np.linspace(-1.0, 1.0, len(part))
        left = part - part.mean() - line * (line @ part) / (line @ line)
        squares.append((left**2).sum() / (len(part) - 2))
        cut = len(part) // BLOCKS * BLOCKS
        blocks = part[:cut].reshape(BLOCKS, -1).mean(1)
        # Half of the variance of a difference: slow creep is no noise of a row.
        of_means.append((np.diff(blocks) ** 2).mean() / 2.0 / BLOCKS)
        means.append(part.mean())
    # What is below the resolution is not seen: a reading is off by up to half a step.
    step = grid_step(values) if channel.name == "rotation" else channel.habit.step
    least = step / math.sqrt(12.0)
    row = max(math.sqrt(float(np.mean(of_means))), least)
    creep, lasted = _creep(np.array(means), times[np.array(parts) - [0, 1]], row)
    sample = max(math.sqrt(float(np.median(squares))), least)
    return RestNoise(name, len(parts), sample, row, creep, lasted)


def _creep(
    means: Float[np.ndarray, " k"], spans: Float[np.ndarray, "k 2"], row: float
) -> tuple[float, float]:
    """The largest change of means over rests without a break, and how long that rest was."""
    lengths = spans[:, 1] - spans[:, 0]
    cuts = np.flatnonzero(spans[1:, 0] - spans[:-1, 1] > 0.5 * float(np.median(lengths))) + 1
    largest = (0.0, 0.0)
    for part, when in zip(np.split(means, cuts), np.split(spans, cuts), strict=True):
        lasted = float(when[-1, 1] - when[0, 0])
        if lasted < LONG or len(part) < 4:
            continue
        line = (when[:, 0] - when[:, 0].mean()) / lasted
        slope = float(line @ part / (line @ line))
        error = row / math.sqrt(float(line @ line))
        if abs(slope) > SURE * error and abs(slope) > largest[0]:
            largest = (abs(slope), lasted)
    return largest
