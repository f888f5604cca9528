"""What a check shows, as tables and sentences for terminal and page."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tpcd.commands.checked import Checked
from tpcd.identification.quantity import Quantity
from tpcd.quality.channels import POSE, ROTATIONS, UNITS, WRENCH, Channel, channels_of
from tpcd.quality.finding import Finding, Weight

CLOCK_KINDS = (
    *("rate", "gap", "silent", "clock_back", "clock_jump"),
    *("delay", "moved", "late_start", "early_end"),
)
"""Kinds of findings that are about times rather than numbers."""
MOST_LISTED = 8
"""Stretches of one kind and channel that are listed one by one."""
_ORDER = (Weight.SERIOUS, Weight.DOUBT, Weight.LEFT_OUT, Weight.NOTE)


@functools.lru_cache(maxsize=1)  # asked for by every page; a million rows take seconds
def channel_rows(checked: Checked) -> list[dict[str, Any]]:
    """One row for each channel: range, resolution, update, noise at rest, and what is left out."""
    noises = {each.name: each for each in checked.noises}
    rows = []
    for channel in channels_of(checked.streams, (*POSE, *WRENCH)):
        noise = noises.get(channel.name)
        turning = channel.name == "rotation"
        low, high = (None, None) if turning else _range(channel)
        rows.append(
            {
                "channel": channel.name,
                "unit": UNITS.get(channel.name, ""),
                "samples": len(channel.values),
                "lowest": low,
                "highest": high,
                "step": channel.habit.step or None if not turning else None,
                "new every": channel.habit.hold,
                "noise of a sample": _known(noise.sample if noise else None),
                "noise of a row": _known(noise.row if noise else None),
                "frozen": _percent(checked, channel, "frozen"),
                "clipped": _percent(checked, channel, "clipped"),
                "spikes": len(_of(checked, channel, "spike")),
            }
        )
    return rows


def clock_lines(checked: Checked) -> list[str]:
    """What was found in the clocks, gravest first."""
    return finding_lines([f for f in checked.findings if f.kind in CLOCK_KINDS])


def wrong_lines(checked: Checked) -> list[str]:
    """What else was found, gravest first."""
    return finding_lines([f for f in checked.findings if f.kind not in CLOCK_KINDS])


def finding_lines(findings: Sequence[Finding]) -> list[str]:
    """Sentences with their weight; of many stretches of one kind the longest, and the rest
    counted."""
    groups: dict[tuple[Weight, str, tuple[str, ...]], list[Finding]] = {}
    for each in findings:
        groups.setdefault((each.weight, each.kind, each.channels), []).append(each)
    lines = []
    for weight in _ORDER:
        for (found, kind, channels), group in groups.items():
            if found is not weight:
                continue
            shown = sorted(group, key=_length, reverse=True)[:MOST_LISTED]
            lines += [f"{weight.value}: {each}" for each in sorted(shown, key=_start)]
            rest = len(group) - len(shown)
            if rest:
                seconds = sum(_length(each) for each in group)
                who = f"{', '.join(channels)}: " if channels else ""
                more = f"{weight.value}: {who}{rest} more {kind.replace('_', ' ')}"
                lines.append(more + (f", {seconds:.3g} s in all" if seconds else ""))
    return lines


def map_lines(checked: Checked) -> list[str]:
    """Which columns look like what."""
    if checked.suggestion is None:
        return []
    line = checked.suggestion.line or "no column is named as a pose or a wrench"
    return [line, *checked.suggestion.notes]


def known_rows(checked: Checked) -> list[dict[str, str]]:
    """Figures of arm and sensor that the data tell, with their intervals."""
    return [
        {
            "quantity": each.name.replace("_", " "),
            "value": _value(each),
            "interval": _interval(each),
            "from": each.basis,
        }
        for each in checked.quantities
        if each.told
    ]


def unknown_lines(checked: Checked) -> list[str]:
    """What the data cannot tell, why, and how to move so that they can; one line for a reason."""
    groups: dict[tuple[str, str], list[str]] = {}
    for each in checked.quantities:
        if not each.told:
            names = groups.setdefault((each.reason, each.motion), [])
            names.append(each.name.replace("_", " "))
    return [
        f"{', '.join(names)}: the data cannot tell, because {reason}"
        + (f"; move so: {motion}" if motion else "")
        for (reason, motion), names in groups.items()
    ]


def noise_line(checked: Checked) -> str:
    """Standard deviations of a row's mean, for `sensor_std` of an episode."""
    told = [
        f"{each.name} {each.row:.2g} {UNITS.get(each.name, '')}".rstrip()
        for each in checked.noises
        if math.isfinite(each.row) and each.row > 0
    ]
    if not told:
        return "the arm is never at rest, so the noise of a row is unknown"
    moments = max(each.moments for each in checked.noises)
    return f"for sensor_std, noise of a row in {moments} moments at rest: {', '.join(told)}"


def _range(channel: Channel) -> tuple[float, float]:
    return float(channel.values.min()), float(channel.values.max())


def _known(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _of(checked: Checked, channel: Channel, kind: str) -> list[Finding]:
    return [f for f in checked.findings if f.kind == kind and channel.name in f.channels]


def _percent(checked: Checked, channel: Channel, kind: str) -> str | None:
    """The part of the samples in stretches of a kind; None for nothing."""
    left = np.zeros(len(channel.values), dtype=bool)
    for each in _of(checked, channel, kind):
        if each.rows is not None:
            left |= (channel.samples >= each.rows[0]) & (channel.samples < each.rows[1])
    return f"{left.mean():.2%}" if left.any() else None


def _length(finding: Finding) -> float:
    known = finding.start is not None and finding.end is not None
    length = finding.end - finding.start if known else 0.0  # type: ignore[operator]
    return length if math.isfinite(length) else 0.0


def _start(finding: Finding) -> float:
    return finding.start if finding.start is not None else -math.inf


def _value(told: Quantity) -> str:
    if isinstance(told.value, str):
        return told.value
    return f"{told.value:.4g} {told.unit}".rstrip()


def _interval(told: Quantity) -> str:
    if told.interval is None:
        return ""
    low, high = told.interval
    return f"{low:.4g} to {high:.4g} ({told.level:.0%})"


def shown_names(streams: Sequence[Any]) -> list[str]:
    """Channels of pose and wrench that are drawn, in the order of the map."""
    present = {name for stream in streams for name in stream.channels}
    return [n for n in ("x", "y", "z", *ROTATIONS, *WRENCH) if n in present]
