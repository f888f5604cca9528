"""How late the wrench and the set point of a recording are against its pose, from motion alone.

An arm that springs pull to a set point u obeys, with a wrench w that is late by d and a set point
that is late by s,

    w(t + d) = A x(t) + B x'(t) + C x''(t) - A u(t + s) + c,

spring, damper and mass. Here the matrices are free, and A is not asked to be the same in both
places, so neither stiffness, frame nor sign need be known, nor what is touched, nor a plane; d and
s are where least of w is left. The interval is that of the block jackknife (Kuensch, "The jackknife
and the bootstrap for general stationary observations", Annals of Statistics 17, 1989): the estimate
again without each tenth of the recording. Where the arm touches nothing, or no set point is
recorded, w shows no time, and the interval says so or there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tpcd.quality.finding import Finding, Weight
from tpcd.quality.stream import Stream, find_gaps, forward, read, role

REACH = 1.0
"""Delays up to this are looked for, either way [s]."""
STEPS = {"wrench": 0.02, "command": 0.05}
"""Delays are tried so far apart, and a parabola goes between [s]."""
BLOCKS = 10
SAMPLES = 4000
"""So many moments of the recording are enough."""
SPAN = 0.05
"""All is averaged over this to either side, and velocities are differences over it, so that noise
of single samples counts little [s]; an average of all three obeys what they obey."""
HARMLESS = {"wrench": 0.1, "command": 0.15}
"""Less than this is not doubted, and told as a bound [s]: filters of a sensor take some 10 ms, and
those that a controller puts before its set point some 100 ms."""
WIDE = 0.12
"""An interval that reaches further than this to either side tells nothing [s]."""
CLEAR = 0.05
"""Where the best delays leave not even this part less than others do, there is nothing to tell."""


@dataclass(frozen=True, eq=False)
class Averages:
    """The averages of a stream over `SPAN` to either side of any time, from its integral."""

    times: Float[np.ndarray, " k"]
    """Of its samples [s]."""
    integral: Float[np.ndarray, "k w"]

    def at(self, times: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s w"]:
        """Averages around some times, which must lie within those of the samples."""
        late, early = (
            np.stack([np.interp(times + by, self.times, part) for part in self.integral.T], axis=1)
            for by in (SPAN, -SPAN)
        )
        return (late - early) / (2 * SPAN)


@dataclass(frozen=True)
class Delay:
    """By how much one stream is late against the pose [s]; negative where it is early."""

    of: str
    """wrench or command"""
    value: float
    low: float
    high: float
    """Two standard errors to either side; infinite where either stream's is beyond `REACH`."""
    gain: float
    """Part of what most delays leave of the wrench that this one explains."""

    @property
    def known(self) -> bool:
        """Whether the data tell it."""
        return self.high - self.low < 2 * WIDE and self.gain > CLEAR

    @property
    def doubtful(self) -> bool:
        """Whether the clocks must differ, since no filter takes so long."""
        least = HARMLESS[self.of]
        return self.known and (self.low > least or self.high < -least)


def check_delays(streams: Sequence[Stream]) -> list[Finding]:
    """What motion and force tell of the clocks of pose, wrench and set point."""
    told = []
    for delay in estimate_delays(streams):
        name = {"wrench": "wrench", "command": "set point"}[delay.of]
        if not delay.known:
            sentence = f"whether the {name} is late against the pose, motion and force do not tell"
            told.append(Finding("delay", Weight.NOTE, sentence))
            continue
        if not delay.doubtful:
            most = max(abs(delay.low), abs(delay.high))
            sentence = f"{name} and pose are at most {most:.2f} s apart, by motion and force"
            told.append(Finding("delay", Weight.NOTE, sentence))
            continue
        sentence = (
            f"the {name} is {abs(delay.value):.2f} s {'late' if delay.value >= 0 else 'early'}"
            f" against the pose ({delay.low:.2f} to {delay.high:.2f} s late)"
        )
        remedy = f"if their clocks differ, give --delay {delay.of}={delay.value:.2f}"
        told.append(Finding("delay", Weight.DOUBT, sentence, remedy=remedy))
    return told


def estimate_delays(streams: Sequence[Stream]) -> tuple[Delay, ...]:
    """Delays of wrench and set point against the pose; none where one of the three is missing."""
    there = {role(stream): _averages(stream) for stream in streams}
    pose, wrench, command = (there.get(name) for name in ("pose", "wrench", "command"))
    if pose is None or wrench is None or command is None:
        return ()
    times = _moments(pose.times, wrench.times)
    span = max(SPAN, 1.5 * float(np.median(np.diff(pose.times))))
    at, late, early = (pose.at(times + by) for by in (0.0, span, -span))
    motion = [at, (late - early) / (2 * span), (late - 2 * at + early) / span**2]
    if len(times) < 10 * BLOCKS or not wrench.at(times).std(0).any():
        return ()
    lags = {of: np.arange(-REACH, REACH + step / 2, step) for of, step in STEPS.items()}
    left = _left_over(times, motion, command, wrench, lags)
    best = _lowest(left[0], lags)
    without = np.array([_lowest(each, lags) for each in left[1:]])
    error = np.sqrt((BLOCKS - 1) / BLOCKS * ((without - without.mean(0)) ** 2).sum(0))
    found, gain = [], 1.0 - float(left[0].min() / np.median(left[0]))
    inside = all(abs(v) < REACH - 2 * s for v, s in zip(best, STEPS.values(), strict=True))
    for k, (of, step) in enumerate(STEPS.items()):
        # Where one is beyond what is looked for, the other makes up for it.
        wide = 2 * float(np.hypot(error[k], step / np.sqrt(12.0))) if inside else np.inf
        found.append(Delay(of, best[k], best[k] - wide, best[k] + wide, gain))
    return tuple(found)


def _left_over(
    times: Float[np.ndarray, " s"],
    motion: list[Float[np.ndarray, "s _"]],
    command: Averages,
    wrench: Averages,
    lags: dict[str, Float[np.ndarray, " _"]],
) -> Float[np.ndarray, "b c l"]:
    """Part of the wrench's variance that is left at each pair of delays of set point and wrench:
    of the whole recording, then without each of its blocks."""
    still = wrench.at(times)
    moving = still.std(0) > 0
    mean, size = still.mean(0)[moving], still.std(0)[moving]
    shifted = np.stack(
        [(wrench.at(times + lag)[:, moving] - mean) / size for lag in lags["wrench"]], axis=1
    )
    flat = shifted.reshape(len(times), -1)
    blocks = np.array_split(np.arange(len(times)), BLOCKS)
    square = np.stack([(shifted[block] ** 2).sum((0, 2)) for block in blocks])
    left = np.empty((BLOCKS + 1, len(lags["command"]), len(lags["wrench"])))
    for k, lag in enumerate(lags["command"]):
        design = _design([*motion, command.at(times + lag)])
        gram = np.stack([design[block].T @ design[block] for block in blocks])
        cross = np.stack([design[block].T @ flat[block] for block in blocks])
        for out in range(-1, BLOCKS):
            kept = [b for b in range(BLOCKS) if b != out]
            sums, total = cross[kept].sum(0), square[kept].sum(0)
            inverse = np.linalg.pinv(gram[kept].sum(0), rcond=1e-10, hermitian=True)
            fitted = ((inverse @ sums) * sums).sum(0).reshape(len(total), -1).sum(1)
            left[out + 1, k] = 1.0 - fitted / total
    return left


def _lowest(
    left: Float[np.ndarray, "c l"], lags: dict[str, Float[np.ndarray, " _"]]
) -> tuple[float, float]:
    """Delays of wrench and set point where least is left, between the tried ones by parabolas."""
    row, column = np.unravel_index(int(left.argmin()), left.shape)
    found = []
    for of, values, k in (("wrench", left[row], column), ("command", left[:, column], row)):
        value = float(lags[of][k])
        if 0 < k < len(values) - 1:
            below, at, above = values[k - 1 : k + 2]
            bend = below - 2 * at + above
            value += STEPS[of] * float(0.5 * (below - above) / bend) if bend > 0 else 0.0
        found.append(value)
    return found[0], found[1]


def _moments(
    pose: Float[np.ndarray, " p"], wrench: Float[np.ndarray, " f"]
) -> Float[np.ndarray, " s"]:
    """Where to compare: evenly over what both span, apart from gaps, with room for every delay."""
    room = REACH + 3 * SPAN
    first, last = max(pose[0], wrench[0]) + room, min(pose[-1], wrench[-1]) - room
    times = np.linspace(first, last, int(np.clip((last - first) / 0.01, 0, SAMPLES)))
    for start, end in np.concatenate((find_gaps(pose), find_gaps(wrench))).tolist():
        times = times[(times < start - room) | (times > end + room)]
    return times


def _averages(stream: Stream) -> Averages | None:
    """A stream for averages; None where it has not two samples that hold numbers."""
    kept = np.flatnonzero(read(stream))
    kept = kept[forward(stream.times[kept])]
    if len(kept) < 2:
        return None
    # Four samples to either side of a moment are enough.
    every = max(1, int(SPAN / 4 / float(np.median(np.diff(stream.times[kept])))))
    kept = np.unique(np.append(kept[::every], kept[-1]))
    times, values = stream.times[kept], stream.values[kept]
    names = [name.removeprefix("u_") for name in stream.channels]
    turning = [k for k, name in enumerate(names) if name in ("qx", "qy", "qz", "qw")]
    if turning:
        # A quaternion and its negative are one turn.
        sign = np.where((values[1:, turning] * values[:-1, turning]).sum(1) < 0, -1.0, 1.0)
        values[1:, turning] *= np.cumprod(sign)[:, None]
    for k, name in enumerate(names):
        if name in ("e1", "e2", "e3", "phi"):
            values[:, k] = np.unwrap(values[:, k])
    middle = values[:-1] if role(stream) == "command" else 0.5 * (values[1:] + values[:-1])
    if role(stream) == "command":
        # The last set point holds to the end.
        times, middle = np.append(times, times[-1] + 1e6), np.vstack((middle, values[-1]))
    steps = np.diff(times)[:, None] * middle
    return Averages(times, np.cumsum(np.vstack((0 * steps[0], steps)), axis=0))


def _design(parts: list[Float[np.ndarray, "s _"]]) -> Float[np.ndarray, "s r"]:
    """Columns of mean 0 and size 1, without those that do not move, and a constant."""
    columns = np.column_stack(parts)
    columns = columns - columns.mean(0)
    size = columns.std(0)
    moving = size > 1e-9
    return np.column_stack((columns[:, moving] / size[moving], np.ones(len(columns))))
