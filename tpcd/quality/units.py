"""Numbers that are in another unit than they are read in, told by what an arm can do.

An arm on a bench reaches a metre or two, turns by less than a full turn between stops, and presses
with up to some hundreds of newtons. Numbers beyond that by orders of magnitude are millimetres,
degrees or millinewtons; some kinds are told by two channels together, as torque over force is a
lever.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tpcd.quality.channels import FORCES, POSITIONS, TORQUES
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.stream import Stream

REACH, PLAINLY_FAR = 5.0, 20.0
"""Positions beyond the first are doubtful for an arm, beyond the second plainly no metres [m]."""
TINY = 2e-3
"""An arm whose positions all stay below this in size [m] was read in too large a unit."""
TURN, PLAINLY_TURNED = 2 * np.pi + 0.1, 30.0
"""The same of angles [rad]."""
QUICK, OVER = 4.0, 0.2
"""Joints of arms turn no faster [rad/s], over so long [s]."""
FASTEST = 30.0
"""No arm turns faster [rad/s]."""
STRONG, PLAINLY_STRONG = 2e3, 2e4
"""The same of forces [N]."""
LEVER, PLAINLY_LONG = 3.0, 30.0
"""The same of torque over force [m]: sensor and object are within arm's reach of each other."""
FELT = 5.0
"""Torques below this say nothing of their unit [N·m]."""
SLOW, FAST = 5.0, 2e-5
"""Samples further apart, or closer, than this [s] were not timed in seconds."""
FEWEST = 50
"""Samples below which their spacing may be that of rows taken by hand."""
APART = 100.0
"""Set point and pose of one axis do not differ in size by this factor unless their units do."""


@dataclass(frozen=True)
class Unit:
    """What is told of one kind of channel that looks as if in another unit."""

    names: tuple[str, ...]
    symbol: str
    likely: str
    entry: str
    """Unit of the column map."""
    doubtful: float
    plain: float


_ANGLES = ("rx", "ry", "rz", "e1", "e2", "e3", "phi")
_UNITS = (
    Unit(POSITIONS, "m", "millimetres", "mm", REACH, PLAINLY_FAR),
    Unit(tuple(f"u_{n}" for n in POSITIONS), "m", "millimetres", "mm", REACH, PLAINLY_FAR),
    Unit(_ANGLES, "rad", "degrees", "deg", TURN, PLAINLY_TURNED),
    Unit(tuple(f"u_{n}" for n in _ANGLES), "rad", "degrees", "deg", TURN, PLAINLY_TURNED),
    Unit(FORCES, "N", "millinewtons", "mN", STRONG, PLAINLY_STRONG),
)


def check_units(streams: Sequence[Stream]) -> tuple[Finding, ...]:
    """Doubts on the units of all channels of a recording that was read as SI."""
    found: list[Finding] = []
    for stream in streams:
        for unit in _UNITS:
            found += _too_large(stream, unit)
        found += _too_small(stream)
        if max(_sizes(stream, _ANGLES).values(), default=0.0) <= TURN:
            found += _too_fast(stream)
        found += _lever(stream)
        found += _clock(stream)
    return (*found, *_apart(streams))


def _sizes(stream: Stream, names: Sequence[str]) -> dict[str, float]:
    """The size that hardly a sample of each channel exceeds; spikes do not count."""
    sizes = {}
    for k, name in enumerate(stream.channels):
        if name in names:
            column = np.abs(stream.values[:, k])
            column = column[np.isfinite(column)]
            if len(column):
                sizes[name] = float(np.quantile(column, 0.98))
    return sizes


def _too_large(stream: Stream, unit: Unit) -> Iterator[Finding]:
    sizes = _sizes(stream, unit.names)
    if not sizes or max(sizes.values()) <= unit.doubtful:
        return
    name = max(sizes, key=lambda each: sizes[each])
    size = sizes[name]
    names = tuple(each for each in unit.names if each in sizes)
    # Turns that are counted on go far, and no faster than an arm turns.
    counted = unit.symbol == "rad" and _speed(stream, names) < QUICK
    serious = size > unit.plain and not counted
    told = f"{'looks like' if serious else 'perhaps'} {unit.likely}"
    told += ", or turns that are counted on" if counted else ""
    yield Finding(
        "unit",
        Weight.SERIOUS if serious else Weight.DOUBT,
        f"{name} reaches {size:.4g} {unit.symbol}, expected at most {unit.doubtful:.2g} of an arm:"
        f" {told}",
        names,
        remedy=f"map {', '.join(names)} with their unit: {name}=COLUMN:{unit.entry}",
    )


def _speed(stream: Stream, names: Sequence[str]) -> float:
    """How fast the fastest of some channels changes in all but two of a hundred samples, over
    `OVER` seconds; infinite where samples are further apart."""
    spacing = float(np.median(np.diff(stream.times))) if len(stream.times) > 1 else np.inf
    lag = max(1, round(OVER / spacing)) if 0 < spacing <= OVER else 0
    if not lag or len(stream.times) < 2 * lag:
        return np.inf
    columns = stream.values[:, [stream.channels.index(name) for name in names]]
    speeds = (
        np.abs(columns[lag:] - columns[:-lag]) / (stream.times[lag:] - stream.times[:-lag])[:, None]
    )
    speeds = speeds[np.isfinite(speeds)]
    return float(np.quantile(speeds, 0.98)) if len(speeds) else np.inf


def _too_small(stream: Stream) -> Iterator[Finding]:
    sizes = _sizes(stream, POSITIONS)
    if len(sizes) > 1 and 0.0 < max(sizes.values()) < TINY:
        yield Finding(
            "unit",
            Weight.DOUBT,
            f"{', '.join(sizes)} stay below {max(sizes.values()):.2g} m: perhaps metres taken for"
            " millimetres",
            tuple(sizes),
            remedy="check the units in the map",
        )


def _too_fast(stream: Stream) -> Iterator[Finding]:
    """Angles of less than a turn that change faster than an arm can turn."""
    names = [n for n in _ANGLES if n in stream.channels]
    steps = np.diff(stream.times)
    if not names or len(steps) < FEWEST or np.median(steps) > 0.1:
        return
    columns = stream.values[:, [stream.channels.index(n) for n in names]]
    # Angles wrap, and a rotation vector does at half a turn: such steps are left out.
    change = np.abs(np.diff(columns, axis=0))
    change = np.where(change < np.pi, change, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        speeds = change / steps[:, None]
    speeds = speeds[np.isfinite(speeds)]
    if len(speeds) and np.quantile(speeds, 0.9) > FASTEST:
        yield Finding(
            "unit",
            Weight.DOUBT,
            f"{', '.join(names)} turn by {np.quantile(speeds, 0.9):.3g} rad/s in one of ten"
            f" samples, expected at most {FASTEST:g}: perhaps degrees",
            tuple(names),
            remedy=f"map them with their unit: {names[0]}=COLUMN:deg",
        )


def _lever(stream: Stream) -> Iterator[Finding]:
    forces, torques = _sizes(stream, FORCES), _sizes(stream, TORQUES)
    if not forces or not torques or max(torques.values()) < FELT:
        return
    force, torque = max(forces.values()), max(torques.values())
    lever = torque / max(force, 1e-9)
    if lever > LEVER:
        name = max(torques, key=lambda each: torques[each])
        serious = lever > PLAINLY_LONG
        yield Finding(
            "unit",
            Weight.SERIOUS if serious else Weight.DOUBT,
            f"{name} reaches {torque:.4g} N·m beside forces of {force:.3g} N, a lever of"
            f" {lever:.3g} m: {'looks like' if serious else 'perhaps'} newton millimetres",
            tuple(torques),
            remedy=f"map {', '.join(torques)} with their unit: {name}=COLUMN:Nmm",
        )


def _clock(stream: Stream) -> Iterator[Finding]:
    steps = np.diff(stream.times)
    steps = steps[steps > 0]
    if len(steps) < FEWEST:
        return
    usual = float(np.median(steps))
    if FAST < usual < SLOW:
        return
    likely = "milliseconds" if usual >= SLOW else "seconds that were taken for smaller units"
    remedy = "time=COLUMN:ms" if usual >= SLOW else "time=COLUMN"
    yield Finding(
        "unit",
        Weight.DOUBT,
        f"{stream.name}: samples are {usual:.3g} s apart: perhaps {likely}",
        ("time",),
        remedy=f"map the times with their unit: {remedy}",
    )


def _apart(streams: Sequence[Stream]) -> Iterator[Finding]:
    """Set points of another size than the pose."""
    sizes: dict[str, float] = {}
    for stream in streams:
        sizes |= _sizes(stream, (*POSITIONS, *(f"u_{n}" for n in POSITIONS)))
    pose = max((sizes.get(n, 0.0) for n in POSITIONS), default=0.0)
    command = max((sizes.get(f"u_{n}", 0.0) for n in POSITIONS), default=0.0)
    if pose > 0 and command > 0 and max(pose / command, command / pose) > APART:
        yield Finding(
            "unit",
            Weight.SERIOUS,
            f"the set point reaches {command:.3g} m where the pose reaches {pose:.3g} m: one of"
            " them is in another unit",
            (*POSITIONS, *(f"u_{n}" for n in POSITIONS)),
            remedy="map both with their units",
        )
