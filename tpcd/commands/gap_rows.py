"""The gap of a diagnosis as rows of a table for people."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tpcd.discrepancy.diagnosis import BLOCKS, Diagnosis, Gap
from tpcd.figures.style import display_unit


def shown_gaps(gaps: Sequence[Gap], by_contact: bool = False) -> list[dict[str, str]]:
    """Errors as text in the units that people read, with their 90 % intervals."""
    return [_shown(gap, by_contact) for gap in gaps]


def shown_data(found: Diagnosis) -> str:
    """Which data the errors are of. Blocks held out are of the episodes that the naming used, so
    that errors after it are optimistic there."""
    if found.held_out != BLOCKS:
        return found.held_out
    return f"{found.held_out}, which the naming used too (optimistic; --fresh is not)"


def shown_share(found: Diagnosis) -> str:
    """What is closed of the gap of all channels together, as text: `95 % (90 to 99)`, and of that
    in typical rows, in which those that land in another contact decide nothing."""
    share = _closed(found.share_closed, found.share_closed_low, found.share_closed_high)
    return f"{share}; in typical rows {_closed(found.share_closed_typical, math.nan, math.nan)}"


def _closed(share: float, low: float, high: float) -> str:
    if not math.isfinite(share):
        return "no excess"
    ends = f" ({100 * low:.0f} to {100 * high:.0f})" if math.isfinite(low) else ""
    return f"{100 * share:.0f} %{ends}"


def _shown(gap: Gap, by_contact: bool) -> dict[str, str]:
    factor, unit = display_unit(gap.unit)

    def value(error: float, low: float, high: float) -> str:
        ends = f" ({_digits(factor * low)} to {_digits(factor * high)})"
        return _digits(factor * error) + (ends if math.isfinite(low) else "")

    place = {"contact": f"{gap.contact} ({gap.rows})"} if by_contact else {}
    return place | {
        "channel": f"{gap.channel} [{unit}]",
        "before": value(gap.before, gap.before_low, gap.before_high),
        "after": value(gap.after, gap.after_low, gap.after_high),
        "noise": _digits(factor * gap.noise_floor),
        "closed": _closed(gap.closed, gap.closed_low, gap.closed_high),
    }


def _digits(value: float) -> str:
    """Three digits, without an exponent."""
    places = 2 - math.floor(math.log10(value)) if value > 0 else 2
    return f"{value:.{max(places, 0)}f}"
