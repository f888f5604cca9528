"""What a check found in one recording or episode."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tpcd.identification.quantity import Quantity
from tpcd.quality.finding import Finding, usable
from tpcd.quality.noise import RestNoise
from tpcd.quality.stream import Stream
from tpcd.quality.suggest import Suggestion


@dataclass(frozen=True, eq=False)
class Checked:
    """What was found in one recording or episode."""

    path: Path
    kind: str
    """recording or episode"""
    streams: tuple[Stream, ...]
    findings: tuple[Finding, ...]
    noises: tuple[RestNoise, ...] = ()
    quantities: tuple[Quantity, ...] = ()
    untold: str = ""
    """Why nothing can be said of arm and sensor."""
    suggestion: Suggestion | None = None
    """Which columns look like what; None where there are none to choose from."""
    mapped: tuple[str, ...] = ()
    """The column map that was used."""
    notes: tuple[str, ...] = ()

    @property
    def left_out(self) -> float:
        """The part of the samples that no step can use."""
        parts = []
        for stream in self.streams:
            own = [f for f in self.findings if not f.channels or set(f.channels) & _own(stream)]
            parts.append(
                float(1.0 - usable(stream.times, own).mean()) if len(stream.times) else 0.0
            )
        return max(parts, default=0.0)


def _own(stream: Stream) -> set[str]:
    """Channels of a stream, a rotation being one."""
    return {*stream.channels, "rotation"} if "u_x" not in stream.channels else {*stream.channels}
