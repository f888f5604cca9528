"""Rotations and places of a recording: quaternions that are none, change their sign, or jump."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from tpcd.quality.finding import Finding, Weight
from tpcd.quality.stream import Stream

QUATERNION = ("qx", "qy", "qz", "qw")
NO_LENGTH = 1e-3
"""A quaternion shorter than this is no rotation."""
UNIT = 0.02
"""A rotation's quaternion has length 1 within this; printed digits and averaging leave less."""
FAR = 20.0
"""A jump is this many times longer than nearly all steps,"""
LEAST = {"m": 0.02, "rad": 0.2}
"""and at least so long [m, rad]: an arm does not get so far from one sample to the next."""
NEARLY_ALL = 0.995
AT_ONCE = 2.0
"""A jump within so many samples of one of the set point is a command."""


def check_poses(streams: Sequence[Stream]) -> tuple[Finding, ...]:
    """What is wrong with rotations and places, of poses and of set points."""
    found: list[Finding] = []
    for stream in streams:
        for prefix in ("", "u_"):
            found += _quaternions(stream, prefix)
        found += _jumps(stream, streams)
    return tuple(found)


def _columns(stream: Stream, names: Sequence[str]) -> Float[np.ndarray, "n w"] | None:
    if not set(names) <= set(stream.channels):
        return None
    return stream.values[:, [stream.channels.index(name) for name in names]]


def _quaternions(stream: Stream, prefix: str) -> Iterator[Finding]:
    names = tuple(prefix + name for name in QUATERNION)
    entries = _columns(stream, names)
    if entries is None:
        return
    lengths = np.linalg.norm(entries, axis=1)
    none = lengths < NO_LENGTH
    for first, end in _runs(none):
        yield Finding(
            "no_rotation",
            Weight.LEFT_OUT,
            f"{', '.join(names)}: zero, which is no rotation, {_when(stream, first, end)}",
            names,
            float(stream.times[first]),
            float(stream.times[end - 1]),
            (first, end),
        )
    good = np.isfinite(lengths) & ~none
    off = np.abs(lengths[good] - 1.0) > UNIT
    if off.any():
        worst = lengths[good][np.argmax(np.abs(lengths[good] - 1.0))]
        yield Finding(
            "not_unit",
            Weight.SERIOUS if off.mean() > 0.5 else Weight.DOUBT,
            f"{', '.join(names)} have length {worst:.4g} where it is furthest from 1, and in"
            f" {off.mean():.0%} of the samples it is more than {UNIT:.0%} off",
            names,
            remedy="check which columns they are and in which order",
        )
    kept = entries[good]
    flips = (kept[1:] * kept[:-1]).sum(1) < 0
    if flips.any():
        yield Finding(
            "flip",
            Weight.NOTE,
            f"{', '.join(names)} change their sign {int(flips.sum())} times: the same rotation,"
            " nothing to do",
            names,
        )


def _jumps(stream: Stream, streams: Sequence[Stream]) -> Iterator[Finding]:
    """Places and rotations that no arm gets to from one sample to the next."""
    entries = _columns(stream, QUATERNION)
    names: tuple[str, ...] = tuple(n for n in ("x", "y", "z") if n in stream.channels)
    places = _columns(stream, names) if names else None
    if places is not None:
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        yield from _told_jumps(stream, names, steps, "m", _sent(streams, names))
    if entries is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            units = entries / np.linalg.norm(entries, axis=1, keepdims=True)
        same = np.abs((units[1:] * units[:-1]).sum(1))
        turns = 2.0 * np.arccos(np.minimum(same, 1.0))
        yield from _told_jumps(stream, QUATERNION, turns, "rad", _sent(streams, QUATERNION))


def _told_jumps(
    stream: Stream,
    names: tuple[str, ...],
    steps: Float[np.ndarray, " s"],
    unit: str,
    sent: Float[np.ndarray, " c"],
) -> Iterator[Finding]:
    spacing = np.diff(stream.times)
    known = np.isfinite(steps)
    if known.sum() < 200:  # fewer steps do not show what is usual
        return
    usual = float(np.quantile(steps[known], NEARLY_ALL))
    regular = spacing <= 4.0 * np.median(spacing)
    jumps = known & regular & (steps > max(LEAST[unit], FAR * usual))
    # There and back is a spike, which is told of its channel.
    back = np.zeros_like(jumps)
    back[1:] = jumps[1:] & jumps[:-1]
    far = np.flatnonzero(jumps & ~back & ~np.append(back[1:], False))
    # An arm without dynamics jumps with its set point.
    begun = np.searchsorted(sent, stream.times[far] - AT_ONCE * np.median(spacing))
    ended = np.searchsorted(sent, stream.times[far + 1], "right")
    far = far[begun == ended]
    if len(far):
        k = int(far[np.argmax(steps[far])])
        more = f", and {len(far) - 1} times more" if len(far) > 1 else ""
        yield Finding(
            "jump",
            Weight.DOUBT,
            f"{', '.join(names)} jump by {steps[k]:.3g} {unit} from one sample to the next at"
            f" {stream.times[k]:.4g} s (row {k}){more}, where {NEARLY_ALL:.1%} of the steps are"
            f" below {usual:.2g} {unit}",
            names,
            float(stream.times[k]),
            float(stream.times[k + 1]),
            (k, k + 2),
            "cut the recording there, or leave out what does not belong to it",
        )


def _sent(streams: Sequence[Stream], names: Sequence[str]) -> Float[np.ndarray, " c"]:
    """Times at which the set point of some channels changes by as much as a jump."""
    for stream in streams:
        columns = _columns(stream, [f"u_{name}" for name in names])
        if columns is not None:
            least = LEAST["rad"] / 2.0 if names[0] == "qx" else LEAST["m"]
            far = np.linalg.norm(np.diff(columns, axis=0), axis=1) > least
            return stream.times[1:][far]
    return np.empty(0)


def _runs(marked: Bool[np.ndarray, " n"]) -> Iterator[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], marked.astype(np.int8), [0]))))
    for first, end in edges.reshape(-1, 2):
        yield int(first), int(end)


def _when(stream: Stream, first: int, end: int) -> str:
    if end - first == 1:
        return f"at {stream.times[first]:.4g} s (row {first})"
    start, last = stream.times[first], stream.times[end - 1]
    return f"from {start:.4g} to {last:.4g} s (rows {first} to {end - 1})"
