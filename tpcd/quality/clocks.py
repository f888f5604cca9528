"""Clocks of a recording: jumps, gaps, rates, and when its streams begin and end.

Nothing is interpolated over a gap. A sample that holds no number is none, so a column that is
empty for seconds, a topic that stops and a table whose rows stop are one kind.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from tpcd.quality.delay import check_delays
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.stream import FEW, LEAST_GAP, Stream, forward, gaps_of, read, role, says_again

JUMP = 0.05
"""Two clocks that part by more than this from one sample to the next have jumped [s]. What arrives
late or in another order by less is a matter of the network."""
SLOW = 0.25
"""Samples that come more rarely than this are too few to know an arm at rest by [s]."""
SOON = 10
"""Two clocks that agree again on average over so many samples have not parted."""


def check_clocks(streams: Sequence[Stream]) -> tuple[Finding, ...]:
    """What the times of all streams of a recording show, in the times of the streams [s]."""
    found = [*_check_ends(streams)]
    measured = [stream for stream in streams if role(stream) != "command"]
    apart = any(not np.array_equal(each.times, measured[0].times) for each in measured)
    spacings = [np.diff(each.times[read(each)]) for each in measured]
    # What is sampled together, however rarely, is drawn by no line between its samples.
    rare = (
        0.0
        if apart
        else max((float(np.median(each)) for each in spacings if len(each)), default=0.0)
    )
    for stream in streams:
        found += check_jumps(stream) + check_gaps(stream, rare) + check_rate(stream, apart)
    return (*found, *check_delays(streams))


def check_gaps(stream: Stream, rare: float = 0.0) -> list[Finding]:
    """Times in which a stream has no samples; spacings that are about `rare` [s] are usual."""
    times, kind = stream.times[read(stream)], role(stream)
    told = []
    for start, end in gaps_of(stream, rare).tolist():
        sentence = (
            f"{stream.name}: no {kind} from {start:.2f} to {end:.2f} s ({end - start:.2g} s, where"
            f" samples come every {_seconds(float(np.median(np.diff(times))))})"
        )
        told.append(Finding("gap", Weight.LEFT_OUT, sentence, stream.channels, start, end))
    return told


def check_rate(stream: Stream, apart: bool = True) -> list[Finding]:
    """How often samples come, and how regularly; `apart` says that others have another clock."""
    times = stream.times[read(stream)]
    spacings = np.diff(times[forward(times)])
    if role(stream) == "command" or len(spacings) < 2:
        return []
    usual, low, high = np.quantile(spacings, (0.5, 0.01, 0.99)).tolist()
    sentence = (
        f"{stream.name}: {role(stream)} every {_seconds(usual)} (98 % within {_seconds(low)} to"
        f" {_seconds(high)})"
    )
    if usual > SLOW:
        line = ": between its samples a straight line is drawn"
        sentence += line if apart else ": too rare to know an arm at rest by"
    weight = Weight.DOUBT if usual > SLOW and apart else Weight.NOTE
    return [Finding("rate", weight, sentence, stream.channels)]


def check_jumps(stream: Stream) -> list[Finding]:
    """Where the clock of a stream goes back."""
    told = []
    for k in np.flatnonzero(np.diff(stream.times) < -JUMP).tolist():
        before, after = stream.times[k : k + 2].tolist()
        sentence = f"{stream.name}: the clock goes back from {before:.6g} to {after:.6g} s"
        told.append(Finding("clock_back", Weight.SERIOUS, sentence, stream.channels, after, before))
    return told


def clock_jumps(
    own: Float[np.ndarray, " k"], other: Float[np.ndarray, " k"]
) -> Int[np.ndarray, " j"]:
    """Samples at which one clock [s] jumps against another that times the same samples.

    A clock that goes back is at fault. Where two part for good, the one whose step is further from
    its usual is; where they part for a few samples, one of those came late. Samples without a time
    of their own (NaN) are passed over.
    """
    timed = np.flatnonzero(np.isfinite(own))
    if len(timed) < 2:
        return np.empty(0, dtype=np.int64)
    own, other = own[timed], other[timed]
    step, held = np.diff(own), np.diff(other)
    usual, apart = np.median(step), own - other
    back = step < -JUMP
    parted = (np.abs(step - held) > JUMP) & (np.abs(step - usual) > np.abs(held - usual))
    for k in np.flatnonzero(parted & ~back).tolist():
        level = np.median(apart[k + 1 : k + 1 + SOON]) - np.median(
            apart[max(k + 1 - SOON, 0) : k + 1]
        )
        parted[k] = abs(level) > JUMP
    return timed[1:][back | parted]


def _check_ends(streams: Sequence[Stream]) -> list[Finding]:
    """What is missing at the beginning and at the end, where other streams go on."""
    spans = [stream.times[read(stream)] for stream in streams]
    if any(not len(span) for span in spans):
        return []
    first, last = (
        min(span.min() for span in spans),
        max(
            span.max()
            for span, stream in zip(spans, streams, strict=True)
            if role(stream) != "command"
        ),
    )
    told = []
    for stream, span in zip(streams, spans, strict=True):
        usual = float(np.quantile(np.abs(np.diff(span)), 0.95)) if len(span) > 1 else 0.0
        limit = max(LEAST_GAP, FEW * usual)
        kind = role(stream)
        begin, end = float(span.min()), float(span.max())
        if begin - first > (LEAST_GAP if kind == "command" else limit):
            sentence = (
                f"{stream.name}: the first {kind} comes {begin - first:.2f} s after the recording"
                " begins; nothing before it is used"
            )
            told.append(
                Finding("late_start", Weight.LEFT_OUT, sentence, stream.channels, -np.inf, begin)
            )
        if last - end > limit and (kind != "command" or says_again(stream)):
            sentence = (
                f"{stream.name}: no {kind} comes in the last {last - end:.2f} s, which are not used"
            )
            told.append(
                Finding("early_end", Weight.LEFT_OUT, sentence, stream.channels, end, np.inf)
            )
    return told


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if value >= 1 else f"{1e3 * value:.3g} ms"
