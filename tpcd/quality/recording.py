"""Everything that is checked on a recording before it is believed, in one call.

Readers attach what it finds to `Log.findings`; `scripts/check.py` shows it.
"""

from __future__ import annotations

from collections.abc import Sequence

from tpcd.quality.channels import check_channels
from tpcd.quality.clocks import check_clocks
from tpcd.quality.finding import Finding
from tpcd.quality.rotation import check_poses
from tpcd.quality.stream import Stream
from tpcd.quality.units import check_units


def check_recording(streams: Sequence[Stream]) -> tuple[Finding, ...]:
    """All findings of the streams of one recording, in SI units, as they were recorded.

    The times of findings are those of the streams.
    """
    return (
        *check_clocks(streams),
        *check_channels(streams),
        *check_poses(streams),
        *check_units(streams),
    )
