"""Which columns of a table look like what: a column map to start from.

Names say most (time, x, tcp, force, target, …), with their units in brackets or at their end;
values decide where names do not: times grow, quaternions have length 1, and positions of 500 are
millimetres. What it suggests is to be looked at, not to be trusted.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tpcd.quality.words import Meaning, meaning

PLAIN_MILLIMETRES, PLAIN_DEGREES = 20.0, 7.0
"""Lengths and angles beyond this are not in m and rad."""
LEVER = 10.0
"""Torques beyond this many metres times the forces are not in N·m."""
UNIT_NORM = 0.02
EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Times since 1970 in each unit are larger than this."""
SLOWEST = 2.0
"""Samples further apart than this [s] were timed in another unit."""
FIRST = {"pose": "x", "command": "u_x", "wrench": "F_x"}
"""Groups of columns, and the first entry of each."""
SERVO = "target_TCP_pose"
"""Of Universal Robots' RTDE; under an admittance loop it is not the set point of the impedance."""


@dataclass(frozen=True)
class Suggestion:
    """A column map that fits the names and numbers of a table."""

    entries: tuple[str, ...]
    """NAME=COLUMN or NAME=COLUMN:UNIT, as `--map` takes them."""
    notes: tuple[str, ...]
    """What could not be told, for people."""

    @property
    def line(self) -> str:
        """The option, ready to paste; empty where nothing was found."""
        words = " ".join(shlex.quote(entry) for entry in self.entries)
        return f"--map {words}" if words else ""

    def without(self, names: Collection[str]) -> Suggestion:
        """The suggestion for what is not mapped yet."""
        known = {*names, *(group for group, first in FIRST.items() if first in names)}
        left = tuple(entry for entry in self.entries if entry.partition("=")[0] not in known)
        return replace(self, entries=left)


def suggest_map(columns: Mapping[str, np.ndarray]) -> Suggestion:
    """Which columns of a table look like time, pose, wrench and set point."""
    numbers = {
        name: np.asarray(values, dtype=np.float64)
        for name, values in columns.items()
        if np.asarray(values).dtype.kind in "fiu"
    }
    found: dict[str, Meaning] = {}
    for column in numbers:
        told = meaning(column)
        if told is not None and (told.name not in found or told.sure > found[told.name].sure):
            found[told.name] = told
    entries: dict[str, str] = {}
    notes: list[str] = []
    _add_numbered(numbers, found, entries, notes)
    time, note = _time(numbers, found)
    if time:
        entries = {"time": time, **entries}
    if note:
        notes.append(note)
    for prefix in ("", "u_"):
        _add_pose(numbers, found, entries, prefix, notes)
    _add_wrench(numbers, found, entries)
    ordered = sorted(entries, key=_order)
    if not any(name in entries for name in ("u_x", "u_z", "command")):
        notes.append("no column looks like a set point (command, target, goal, desired)")
    for group, names in (("pose", ("x", "pose")), ("wrench", ("F_x", "wrench"))):
        if not any(name in entries for name in names):
            notes.append(f"no columns look like a {group}")
    return Suggestion(tuple(f"{name}={entries[name]}" for name in ordered), tuple(notes))


def _order(name: str) -> int:
    groups = ("time", "pose", "command", "wrench")
    if name in groups:
        return groups.index(name)
    return 1 + ("F_" in name or "T_" in name or name == "tau") * 2 + name.startswith("u_")


def _time(
    numbers: Mapping[str, Float[np.ndarray, " n"]], found: Mapping[str, Meaning]
) -> tuple[str, str]:
    """The column of times with its unit, or what to do without one."""
    told = found.get("time")
    if told is None or not _grows(numbers[told.column]):
        growing = [n for n, v in numbers.items() if meaning(n) is None and _grows(v)]
        if told is not None or not growing:
            return "", "no column of times: give --rate, the samples a second"
        return "", f"no column is named as times; {growing[0]!r} grows: is it time={growing[0]}?"
    values = numbers[told.column]
    if told.unit:
        return f"{told.column}:{told.unit}" if told.unit != "s" else told.column, ""
    size, step = float(np.nanmax(np.abs(values))), float(np.nanmedian(np.diff(values)))
    for limit, unit in EPOCHS:
        if size > limit:
            return f"{told.column}:{unit}", ""
    for factor, unit in ((1e-3, "ms"), (1e-6, "us"), (1e-9, "ns")):
        if step <= SLOWEST:
            break
        if factor * step <= SLOWEST / 2:
            return f"{told.column}:{unit}", f"times are taken to be in {unit}: they look like it"
    return told.column, ""


def _grows(values: Float[np.ndarray, " n"]) -> bool:
    steps = np.diff(values[np.isfinite(values)])
    return len(steps) > 1 and bool((steps > 0).mean() > 0.9) and bool((steps >= 0).mean() > 0.99)


def _add_numbered(
    numbers: Mapping[str, np.ndarray],
    found: dict[str, Meaning],
    entries: dict[str, str],
    notes: list[str],
) -> None:
    """Columns NAME_0, NAME_1, … that are a whole pose, wrench or set point."""
    stems: dict[str, int] = {}
    for column in numbers:
        match = re.fullmatch(r"(.+)_(\d+)", column)
        if match:
            stems[match[1]] = stems.get(match[1], 0) + 1
    for stem, count in stems.items():
        told = meaning(f"{stem} x")
        if told is None or any(f"{stem}_{k}" not in numbers for k in range(count)):
            continue
        group = {"F": "wrench", "u": "command"}.get(told.name[0], "pose")
        quaternion = group != "wrench" and count == 7
        if quaternion and not _unit([numbers[f"{stem}_{k}"] for k in (3, 4, 5, 6)]):
            continue
        if not quaternion and not (count == 6 and told.whole):
            continue
        if stem == SERVO:
            notes.append(f"{SERVO} is where the servo is sent, no set point of an impedance")
            continue
        if group not in entries or "actual" in stem.lower():
            entries[group] = stem
            for name in [n for n in found if _of_group(n, group)]:
                del found[name]


def _of_group(name: str, group: str) -> bool:
    if group == "wrench":
        return name[:2] in ("F_", "T_")
    if group == "command":
        return name.startswith("u_")
    return name[:2] not in ("F_", "T_", "u_") and name not in ("time", "tau")


def _add_pose(
    numbers: Mapping[str, np.ndarray],
    found: Mapping[str, Meaning],
    entries: dict[str, str],
    prefix: str,
    notes: list[str],
) -> None:
    places = [prefix + n for n in "xyz" if prefix + n in found]
    _add(numbers, found, entries, places, PLAIN_MILLIMETRES, "mm")
    for names in (("qx", "qy", "qz", "qw"), ("rx", "ry", "rz"), ("e1", "e2", "e3"), ("phi",)):
        turned = [prefix + n for n in names]
        if not all(n in found for n in turned):
            continue
        columns = [numbers[found[n].column] for n in turned]
        if names[0] == "qx" and not _unit(columns):
            listed = ", ".join(found[n].column for n in turned)
            notes.append(f"{listed} are named as a quaternion and do not have length 1")
            continue
        limit = np.inf if names[0] == "qx" else PLAIN_DEGREES
        _add(numbers, found, entries, turned, limit, "deg")
        return


def _add_wrench(
    numbers: Mapping[str, np.ndarray], found: Mapping[str, Meaning], entries: dict[str, str]
) -> None:
    forces = [f"F_{n}" for n in "xyz" if f"F_{n}" in found]
    torques = [n for n in ("T_x", "T_y", "T_z", "tau") if n in found]
    _add(numbers, found, entries, forces, np.inf, "mN")
    strongest = max((_size(numbers[found[n].column]) for n in forces), default=np.inf)
    _add(numbers, found, entries, torques, max(LEVER * strongest, LEVER), "Nmm")


def _add(
    numbers: Mapping[str, np.ndarray],
    found: Mapping[str, Meaning],
    entries: dict[str, str],
    names: Sequence[str],
    limit: float,
    likely: str,
) -> None:
    """Entries for some names, in the unit of their column's name or the likely one of its size."""
    size = max((_size(numbers[found[n].column]) for n in names), default=0.0)
    for name in names:
        told = found[name]
        unit = told.unit or (likely if size > limit else "")
        entries[name] = f"{told.column}:{unit}" if unit else told.column


def _size(values: Float[np.ndarray, " n"]) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.quantile(finite, 0.98)) if len(finite) else 0.0


def _unit(columns: Sequence[np.ndarray]) -> bool:
    """Whether four columns are quaternions: of length 1, nearly always."""
    lengths = np.sqrt(sum(np.square(column) for column in columns))
    lengths = lengths[np.isfinite(lengths)]
    return len(lengths) > 0 and bool((np.abs(lengths - 1.0) < UNIT_NORM).mean() > 0.9)
