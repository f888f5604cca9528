"""What a check found in a recording: what, in which channel, when, and what follows from it.

Checks return findings and change nothing. Who reads a recording decides by their weight: what is
`LEFT_OUT` is used by no step, a `DOUBT` is written into the episode and repeated by what reads it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float


class Weight(Enum):
    """What follows from a finding; the value is the word shown before its sentence."""

    NOTE = "note"
    """Worth knowing; everything can be used."""
    LEFT_OUT = "left out"
    """The samples between `start` and `end` are used by no step."""
    DOUBT = "doubt"
    """Speaks against using the recording as it is read."""
    SERIOUS = "serious doubt"
    """Speaks so strongly against it that accepting it needs a word of its own."""


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    kind: str
    """A name for programs: gap, frozen, clipped, clock_back, delay, spike, unit, ..."""
    weight: Weight
    sentence: str
    """For people: what was found, where, what was expected."""
    channels: tuple[str, ...] = ()
    """Names as in a column map: x, qw, F_z, u_x, ...; empty where it is about the whole."""
    start: float | None = None
    """Seconds since the first sample."""
    end: float | None = None
    """Seconds since the first sample; infinity to the end."""
    rows: tuple[int, int] | None = None
    """First row of the file's table, and the one after the last."""
    remedy: str = ""
    """What to do, in one clause."""

    def __str__(self) -> str:
        """The line shown."""
        return self.sentence + (f"; {self.remedy}" if self.remedy else "")


def overlapping(start: float, end: float, findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings that leave out anything between two times [s], whether or not samples lie there.

    A stretch that only touches what is left out, where a gap begins or ends, is whole.
    """
    return tuple(
        each
        for each in findings
        if each.weight is Weight.LEFT_OUT and each.start is not None and each.end is not None
        if each.start < end and start < each.end
    )


def usable(times: Float[np.ndarray, " n"], findings: Iterable[Finding]) -> Bool[np.ndarray, " n"]:
    """Which samples at `times` [s since the first] no finding leaves out."""
    kept = np.ones(len(times), dtype=bool)
    for each in findings:
        if each.weight is Weight.LEFT_OUT and each.start is not None and each.end is not None:
            kept &= ~((times >= each.start) & (times <= each.end))
    return kept
