"""Samples of one sensor on its own clock, as they were recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

FEW = 4.0
"""A spacing of so many usual ones is a gap."""
LEAST_GAP = 0.05
"""Shorter than this nothing is a gap [s]: an arm that is pulled by springs moves along a line."""
MOST_GAP = 2.0
"""Longer than this everything is a gap [s]: an arm makes whole moves meanwhile."""
RARE = 1.5
"""But nothing that is not longer by this factor than what all streams are sampled at."""
AGAIN = 0.2
"""A sender of set points of which this part repeats the one before says again what it holds."""
NEAR = 50
"""Spacings on either side that say what is usual."""
ENOUGH = 5
"""Fewer than this say nothing."""


@dataclass(frozen=True, eq=False)
class Stream:
    """k samples of one topic of a bag, or of the columns of a table that share a clock."""

    name: str
    """Topic, or file."""
    channels: tuple[str, ...]
    """What the columns are, as in a column map: x, y, z, qx, ..., F_x, ..., u_x, ..."""
    times: Float[np.ndarray, " k"]
    """[s] in the order of recording, on the clock that all streams of the recording share."""
    values: Float[np.ndarray, "k w"]
    """SI units; NaN where the recording has no number."""
    stamps: Float[np.ndarray, " k"] | None = None
    """The sender's own times [s], where they are another clock than `times`."""


def role(stream: Stream) -> str:
    """What a stream is: command, wrench or pose."""
    if any(name.startswith("u_") for name in stream.channels):
        return "command"
    return "wrench" if any(name[:2] in ("F_", "T_") for name in stream.channels) else "pose"


def read(stream: Stream) -> Bool[np.ndarray, " k"]:
    """The samples whose channels all hold numbers."""
    return np.isfinite(stream.values).all(1)


def forward(times: Float[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """The samples that are later than all before them; what repeats a time or comes late is not."""
    latest = np.maximum.accumulate(times)
    return np.concatenate(([True], times[1:] > latest[:-1])) if len(times) else np.ones(0, bool)


def gaps_of(stream: Stream, rare: float = 0.0) -> Float[np.ndarray, "g 2"]:
    """Last sample before every gap of a stream, and first one after it [s].

    A set point holds until the next one comes, so silence is no gap; but where the sender says
    again and again what it holds, silence is of the sender, and no one knows what it would say.
    """
    if role(stream) == "command" and not says_again(stream):
        return np.empty((0, 2))
    times = stream.times[read(stream)]
    return find_gaps(times[forward(times)], rare)


def says_again(stream: Stream) -> bool:
    """Whether the samples of a stream repeat what holds."""
    values = stream.values[read(stream)]
    return len(values) > 1 and float((values[1:] == values[:-1]).all(1).mean()) >= AGAIN


def find_gaps(times: Float[np.ndarray, " k"], rare: float = 0.0) -> Float[np.ndarray, "g 2"]:
    """Last sample before every gap, and first one after it [s]; times must increase.

    A gap is a spacing of several usual ones, where usual is what nine in ten of the spacings just
    before or just after stay within: so neither a stream that changes its rate, nor one whose
    samples come in bursts, is full of gaps. `rare` is a spacing [s] that all streams have.
    """
    spacings = np.diff(times)
    wide = np.flatnonzero(spacings > LEAST_GAP)
    if not len(wide):
        return np.empty((0, 2))
    before, after = _usual(spacings, wide, -NEAR), _usual(spacings, wide, 1)
    usual = np.nan_to_num(np.fmax(before, after), nan=float(np.median(spacings)))
    # What comes every ten seconds is not missing for ten.
    longest = max(MOST_GAP, RARE * rare)
    found = wide[spacings[wide] > np.clip(FEW * usual, LEAST_GAP, longest)]
    return np.stack((times[found], times[found + 1]), axis=1)


def _usual(
    spacings: Float[np.ndarray, " k"], wide: Int[np.ndarray, " g"], begin: int
) -> Float[np.ndarray, " g"]:
    """What nine in ten of the `NEAR` spacings from `begin` after each stay within; NaN of few."""
    padded = np.concatenate((np.full(NEAR, np.nan), spacings, np.full(NEAR + 1, np.nan)))
    found = np.empty(len(wide))
    for part in np.array_split(np.arange(len(wide)), len(wide) // 100_000 + 1):
        near = np.sort(padded[wide[part, None] + NEAR + begin + np.arange(NEAR)], axis=1)
        count = np.isfinite(near).sum(1)
        place = (0.9 * np.maximum(count - 1, 0)).astype(np.int64)
        found[part] = np.where(count >= ENOUGH, near[np.arange(len(part)), place], np.nan)
    return found
