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
"""Less than this is told and not doubted [s]: filters of a sensor take some 10 ms, those that a
controller puts before its set point some 100 ms."""
WIDE = 0.12
"""An interval that reaches further than this to either side tells nothing [s]."""
CLEAR = 0.05
"""Where the best delays leave not even this part less than others do, there is nothing to tell."""
Samples = tuple[Float[np.ndarray, " _"], Float[np.ndarray, "_ _"]]


@dataclass(frozen=True)
class Delay:
    """By how much one stream is late against the pose [s]; negative where it is early."""

    of: str
    """wrench or command"""
    value: float
    low: float
    high: float
    """Two standard errors to either side."""
    gain: float
    """Part of what most delays leave of the wrench that this one explains."""

    @property
    def known(self) -> bool:
        """Whether the data tell it."""
        inside = abs(self.value) < REACH - 2 * STEPS[self.of]
        return inside and self.high - self.low < 2 * WIDE and self.gain > CLEAR

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
        sentence = (
            f"the {name} is {abs(delay.value):.2f} s {'late' if delay.value >= 0 else 'early'}"
            f" against the pose ({delay.low:.2f} to {delay.high:.2f} s late)"
        )
        weight = Weight.DOUBT if delay.doubtful else Weight.NOTE
        remedy = f"if their clocks differ, give --delay {delay.of}={delay.value:.2f}"
        told.append(Finding("delay", weight, sentence, remedy=remedy if delay.doubtful else ""))
    return told


def estimate_delays(streams: Sequence[Stream]) -> tuple[Delay, ...]:
    """Delays of wrench and set point against the pose; none where one of the three is missing."""
    there = {role(stream): _numbers(stream) for stream in streams}
    if set(there) != {"pose", "wrench", "command"}:
        return ()
    if any(len(times) < 2 for times, _ in there.values()):
        return ()
    pose, wrench, command = there["pose"], there["wrench"], there["command"]
    times = _moments(pose, wrench)
    span = max(SPAN, 1.5 * float(np.median(np.diff(pose[0]))))
    at, late, early = (_between(pose, times + by) for by in (0.0, span, -span))
    motion = [at, (late - early) / (2 * span), (late - 2 * at + early) / span**2]
    values = _between(wrench, times)
    if len(times) < 10 * BLOCKS or not values.std(0).any():
        return ()
    lags = {of: np.arange(-REACH, REACH + step / 2, step) for of, step in STEPS.items()}
    left = _left_over(times, motion, command, wrench, lags)
    best = _lowest(left[0], lags)
    without = np.array([_lowest(each, lags) for each in left[1:]])
    error = np.sqrt((BLOCKS - 1) / BLOCKS * ((without - without.mean(0)) ** 2).sum(0))
    found, gain = [], 1.0 - float(left[0].min() / np.median(left[0]))
    for k, (of, step) in enumerate(STEPS.items()):
        wide = 2 * float(np.hypot(error[k], step / np.sqrt(12.0)))
        found.append(Delay(of, best[k], best[k] - wide, best[k] + wide, gain))
    return tuple(found)


def _left_over(
    times: Float[np.ndarray, " s"],
    motion: list[Float[np.ndarray, "s _"]],
    command: Samples,
    wrench: Samples,
    lags: dict[str, Float[np.ndarray, " _"]],
) -> Float[np.ndarray, "b c l"]:
    """Part of the wrench's variance that is left at each pair of delays of set point and wrench:
    of the whole recording, then without each of its blocks."""
    still = _between(wrench, times)
    moving = still.std(0) > 0
    mean, size = still.mean(0)[moving], still.std(0)[moving]
    shifted = np.stack(
        [(_between(wrench, times + lag)[:, moving] - mean) / size for lag in lags["wrench"]], axis=1
    )
    flat = shifted.reshape(len(times), -1)
    blocks = np.array_split(np.arange(len(times)), BLOCKS)
    square = np.stack([(shifted[block] ** 2).sum((0, 2)) for block in blocks])
    left = np.empty((BLOCKS + 1, len(lags["command"]), len(lags["wrench"])))
    for k, lag in enumerate(lags["command"]):
        design = _design([*motion, _held(command, times + lag)])
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


def _moments(pose: Samples, wrench: Samples) -> Float[np.ndarray, " s"]:
    """Where to compare: evenly over what both span, apart from gaps, with room for every delay."""
    room = REACH + 3 * SPAN
    first, last = max(pose[0][0], wrench[0][0]) + room, min(pose[0][-1], wrench[0][-1]) - room
    times = np.linspace(first, last, int(np.clip((last - first) / 0.01, 0, SAMPLES)))
    for start, end in np.concatenate((find_gaps(pose[0]), find_gaps(wrench[0]))).tolist():
        times = times[(times < start - room) | (times > end + room)]
    return times


def _numbers(stream: Stream) -> Samples:
    """The samples that hold numbers, forward in time, with turns that run on."""
    kept = read(stream)
    times, values = stream.times[kept], stream.values[kept]
    fresh = forward(times)
    times, values = times[fresh], values[fresh]
    names = [name.removeprefix("u_") for name in stream.channels]
    turning = [k for k, name in enumerate(names) if name in ("qx", "qy", "qz", "qw")]
    if turning and len(values):
        # A quaternion and its negative are one turn.
        sign = np.where((values[1:, turning] * values[:-1, turning]).sum(1) < 0, -1.0, 1.0)
        values[1:, turning] *= np.cumprod(sign)[:, None]
    for k, name in enumerate(names):
        if name in ("e1", "e2", "e3", "phi"):
            values[:, k] = np.unwrap(values[:, k])
    return times, values


def _between(samples: Samples, times: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s w"]:
    """Averages of values on straight lines, over `SPAN` to either side."""
    own, values = samples
    steps = 0.5 * np.diff(own)[:, None] * (values[1:] + values[:-1])
    return _mean(own, steps, values[-1], times)


def _held(samples: Samples, times: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s w"]:
    """Averages of values that hold until the next one comes, over `SPAN` to either side."""
    own, values = samples
    return _mean(own, np.diff(own)[:, None] * values[:-1], values[-1], times)


def _mean(
    own: Float[np.ndarray, " k"],
    steps: Float[np.ndarray, "j w"],
    last: Float[np.ndarray, " w"],
    times: Float[np.ndarray, " s"],
) -> Float[np.ndarray, "s w"]:
    """Averages from the integrals over the spacings of samples, beyond which the last one holds."""
    far = max(float(times[-1]) + 2 * SPAN, own[-1] + 1.0) if len(times) else own[-1] + 1.0
    knots = np.append(own, far)
    integral = np.cumsum(np.vstack((0 * last, steps, (far - own[-1]) * last)), axis=0)
    late, early = (
        np.stack([np.interp(times + by, knots, column) for column in integral.T], axis=1)
        for by in (SPAN, -SPAN)
    )
    return (late - early) / (2 * SPAN)


def _design(parts: list[Float[np.ndarray, "s _"]]) -> Float[np.ndarray, "s r"]:
    """Columns of mean 0 and size 1, without those that do not move, and a constant."""
    columns = np.column_stack(parts)
    columns = columns - columns.mean(0)
    size = columns.std(0)
    moving = size > 1e-9
    return np.column_stack((columns[:, moving] / size[moving], np.ones(len(columns))))
