"""The column map: which column of a table is what, in which unit.

An entry reads `NAME=COLUMN` or `NAME=COLUMN:UNIT`. The names are

    time                                    s
    x y z                                   position of the end effector        m
    rx ry rz | qx qy qz qw | e1 e2 e3       its rotation: vector, quaternion, Euler angles   rad
    F_x F_y F_z, T_x T_y T_z                wrench                              N, N·m
    u_x u_y u_z, u_rx … | u_qx … | u_e1 …   set point, likewise
    phi, u_phi, tau                         of recordings that are planar in x and z already
    pose, command, wrench                   columns COLUMN_0, COLUMN_1, … of all entries in order

where `pose` and `command` have six entries (with a rotation vector) or seven (with a quaternion).
Recordings of Universal Robots' RTDE need no map: `actual_TCP_pose` and `actual_TCP_force` are
found by their names. A unit that the map does not give is taken from the table, where a line of
units or the name of the column has one, and for whole numbers since 1970 from their size.
"""

from __future__ import annotations

import difflib
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tpcd.logs.joining import join
from tpcd.logs.log import Log, LogError
from tpcd.logs.table import Columns, Table, place, text_among_numbers, units_of
from tpcd.quality.clocks import JUMP
from tpcd.quality.sentinels import without_sentinels
from tpcd.quality.stream import Stream
from tpcd.quality.suggest import suggest_map

_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180}
_FORCES = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
_TORQUES = {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2}
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_POSE_UNITS: dict[str, dict[str, float]] = {
    **dict.fromkeys(("x", "y", "z"), _LENGTHS),
    **dict.fromkeys(("rx", "ry", "rz", "e1", "e2", "e3", "phi"), _ANGLES),
    **dict.fromkeys(("qx", "qy", "qz", "qw"), {"1": 1.0}),
}
UNITS: dict[str, dict[str, float]] = {
    "time": _TIMES,
    **_POSE_UNITS,
    **{f"u_{name}": units for name, units in _POSE_UNITS.items()},
    **dict.fromkeys(("F_x", "F_y", "F_z"), _FORCES),
    **dict.fromkeys(("T_x", "T_y", "T_z", "tau"), _TORQUES),
}
"""Every name of the map with the units it may be in; the first one is SI."""
GROUPS = {
    "pose": (("x", "y", "z", "rx", "ry", "rz"), ("x", "y", "z", "qx", "qy", "qz", "qw")),
    "wrench": (("F_x", "F_y", "F_z", "T_x", "T_y", "T_z"),),
}
GROUPS["command"] = tuple(tuple(f"u_{name}" for name in names) for names in GROUPS["pose"])
RTDE = {
    "time": "timestamp",
    "pose": "actual_TCP_pose",
    "wrench": "actual_TCP_force",
}
"""Names in RTDE recordings; `target_TCP_pose` is where the servo is sent, which under an
admittance loop is not the set point of the impedance, so no command is taken by itself."""


def parse_map(entries: Sequence[str], columns: Columns, path: Path) -> dict[str, tuple[str, str]]:
    """Name to column and unit ("" where the map gives none), for columns that exist.

    Raises `ValueError` for a malformed entry, `LogError` for a column that is not there.
    """
    found: dict[str, tuple[str, str]] = {}
    given = dict(_split(entry) for entry in entries)
    if f"{RTDE['pose']}_0" in columns:
        given = {n: c for n, c in RTDE.items() if c in columns or f"{c}_0" in columns} | given
    for name, column in given.items():
        if name in GROUPS:
            there = [names for names in GROUPS[name] if f"{column}_{len(names) - 1}" in columns]
            if not there:
                _find(f"{column}_{len(GROUPS[name][0]) - 1}", columns, path)
            found.update({n: (f"{column}_{k}", "") for k, n in enumerate(there[-1])})
    for name, column in given.items():
        if name in GROUPS:
            continue
        if name not in UNITS:
            close = difflib.get_close_matches(name, [*UNITS, *GROUPS], 1, 0.5)
            hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(UNITS)}"
            raise ValueError(f"map: unknown name {name!r}; {hint}")
        column, unit = _column_and_unit(column, columns)
        if unit and unit not in UNITS[name]:
            raise ValueError(f"map: {name} in {unit!r}, expected one of {', '.join(UNITS[name])}")
        _find(column, columns, path)
        found[name] = column, unit
    return found


def log_from_columns(
    columns: Columns,
    entries: Sequence[str],
    path: Path,
    euler: str = "ZYX",
    rate: float | None = None,
    keep: Sequence[str] = (),
    delays: Mapping[str, float] | None = None,
) -> Log:
    """The recording in a table; `euler` are scipy's axes, capitals for turning axes.

    `rate` [Hz] stands in for a column of times, and `delays` say how late pose, wrench or command
    are [s]. Rows that lack a number are left out, and so are repeated times; notes say so. Where
    pose and wrench stand in rows of their own, each with its times, they are joined like topics.
    Raises `LogError` and `ValueError` in one line.
    """
    mapped = parse_map(entries, columns, path)
    for column in keep:
        _find(column, columns, path)
    missing = _check_map(mapped, columns, path, rate)
    values, notes = read_numbers(columns, mapped, path)
    count = len(next(iter(columns.values())))
    times = values.pop("time", None)
    times = np.arange(count) / (rate or 1.0) if times is None else times
    timed = np.flatnonzero(np.isfinite(times))
    _check_order(columns, times, timed, path)
    groups: dict[str, list[str]] = {"pose": [], "wrench": [], "command": []}
    for name in values:
        kind = "command" if name.startswith("u_") else "wrench" if name[0] in "FT" else "pose"
        groups["wrench" if name == "tau" else kind].append(name)
    full = {
        kind: timed[
            functools.reduce(np.logical_and, (np.isfinite(values[n]) for n in names))[timed]
        ]
        for kind, names in groups.items()
        if names
    }
    whole = functools.reduce(np.intersect1d, full.values())
    apart = 2 * len(whole) < len(full["pose"]) and all(len(rows) for rows in full.values())
    if apart:
        told = ", ".join(f"{kind} in {len(rows)}" for kind, rows in full.items())
        notes.append(f"of {count} rows {told} hold numbers: joined by their times, each for itself")
    elif len(whole) < count:
        lacking = np.setdiff1d(np.arange(count), whole)
        empty = [n for n in values if not np.isfinite(values[n][lacking]).all()]
        empty += ["time"] if len(timed) < count else []
        notes.append(
            f"{len(lacking)} of {count} rows lack a number and are left out ({', '.join(empty)};"
            f" first in {place(columns, int(lacking[0]))})"
        )
    streams = []
    for kind, rows in full.items():
        rows = rows if apart else timed
        block = np.stack([values[name][rows] for name in groups[kind]], axis=1)
        streams.append(Stream(path.name, tuple(groups[kind]), times[rows], block))
    values.clear()
    extra = {name: columns[name][full["pose"] if apart else timed] for name in keep}
    log = join(path, streams, euler, delays, (), notes, missing, extra)
    return replace(log, columns={name: column for name, (column, _) in mapped.items()})


def read_numbers(
    columns: Columns, mapped: Mapping[str, tuple[str, str]], path: Path
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The mapped columns in SI units, and which units were taken from where; times since the first,
    and NaN for numbers that stand for no reading, which is told.

    Raises `LogError` for a column that holds text, with the line and what stands there.
    """
    values, notes = {}, list(columns.notes) if isinstance(columns, Table) else []
    given = units_of(columns)
    for name, (column, unit) in mapped.items():
        content = columns[column]
        if content.dtype.kind not in "fiu":
            raise LogError(path, *text_among_numbers(columns, column))
        if name == "time" and isinstance(columns, Table) and column in columns.moments:
            unit = columns.moments[column]
        elif not unit and (found := given.get(column)):
            unit = found if found in UNITS[name] else ""
            ending = "" if unit else f"; that is no unit of {name}, and not used"
            notes.append(f"column {column!r} is in {found} by the table{ending}")
        if name == "time":
            if not unit and (unit := since_1970(content)):
                notes.append(f"column {column!r} is read as {unit} since 1970")
            # Whole nanoseconds are subtracted as such: a float holds them to 256 ns only.
            content = content - _first(content)
            content = content.astype(np.int64) if content.dtype.kind == "u" else content
        factor = UNITS[name][unit or next(iter(UNITS[name]))]
        content = content.astype(np.float64, copy=False)
        if name != "time":
            # A sentinel is one in the unit that it was written in.
            read, told = without_sentinels({name: content})
            content, notes = read[name], notes + told
        values[name] = content if factor == 1.0 else factor * content
    return values, notes


def since_1970(times: np.ndarray) -> str:
    """The unit of times that can only be ns, us or ms since 1970, else "".

    They must lie between 2001 and 2036, and follow each other by 10 us to 100 s.
    """
    held = times[np.isfinite(times)]
    if len(held) < 2:
        return ""
    spacing = float(np.median(np.abs(np.diff(held.astype(np.float64)))))
    for unit in ("ns", "us", "ms"):
        per_second = 1.0 / _TIMES[unit]
        if 1e9 < float(held[0]) / per_second < 2.1e9 and 1e-5 < spacing / per_second < 100.0:
            return unit
    return ""


def _first(times: np.ndarray) -> np.generic | float:
    held = np.flatnonzero(np.isfinite(times))
    return times[held[0]] if len(held) else 0.0


def _check_map(
    mapped: Mapping[str, object], columns: Columns, path: Path, rate: float | None
) -> frozenset[str]:
    """Components that the map leaves out; raises `LogError` for those that must be there."""
    names = set(mapped) | ({"T_y"} if "tau" in mapped else set())
    lacking = {"x", "z", "F_x", "F_z"} - names
    if "time" not in names and rate is None:
        lacking |= {"time"}
    if lacking:
        fitting = suggest_map(columns).without(names).line
        remedy = f"the columns are {_listed(columns)}"
        if fitting:
            remedy += f"; by names and numbers, try {fitting}"
        time = "; give --rate in Hz where there are no times" if "time" in lacking else ""
        raise LogError(path, f"{', '.join(sorted(lacking))} not in the map", remedy + time)
    missing = {n for n in (*"xyz", "F_x", "F_y", "F_z", "T_x", "T_y", "T_z") if n not in names}
    if any(name.startswith("u_") for name in names):
        if {"u_x", "u_z"} - names:
            raise LogError(path, "a set point needs u_x and u_z", "map both, or neither")
        missing |= {f"u_{name}" for name in "xyz" if f"u_{name}" not in names}
    return frozenset(missing)


def _check_order(columns: Columns, times: np.ndarray, timed: np.ndarray, path: Path) -> None:
    """Raises `LogError` where the only clock of a table goes back."""
    if not len(timed):
        raise LogError(path, "no row has a time", "check the map of columns")
    held = times[timed]
    if len(held) > 2 and 2 * int((np.diff(held) < 0).sum()) > len(held):
        raise LogError(path, "time runs backwards from row to row", "sort the rows by time")
    back = np.flatnonzero(np.diff(held) < -JUMP)
    if len(back):
        k = int(back[0])
        more = f", and {len(back) - 1} times more" if len(back) > 1 else ""
        raise LogError(
            path,
            f"time goes back from {held[k]:.6g} to {held[k + 1]:.6g} s at"
            f" {place(columns, int(timed[k + 1]))}{more}",
            "cut the recording there, or map the right column of times",
        )


def _split(entry: str) -> tuple[str, str]:
    name, equals, column = entry.partition("=")
    if not equals or not name or not column:
        raise ValueError(f"map: found {entry!r}, expected NAME=COLUMN or NAME=COLUMN:UNIT")
    return name.strip(), column.strip()


def _column_and_unit(text: str, columns: Mapping[str, object]) -> tuple[str, str]:
    if text in columns:
        return text, ""
    column, colon, unit = text.rpartition(":")
    return (column, unit) if colon else (text, "")


def _find(column: str, columns: Columns, path: Path) -> None:
    if column in columns:
        return
    refused = columns.refused if isinstance(columns, Table) else {}
    if odd := refused.get(column) or refused.get(column.rpartition("_")[0]):
        told = f"column {odd.name!r} {odd.problem} in {place(columns, odd.row)}"
        raise LogError(path, told, "export it again, or leave it out of the map")
    close = difflib.get_close_matches(column, list(columns), 1, 0.6)
    remedy = f"did you mean {close[0]!r}?" if close else f"the columns are {_listed(columns)}"
    raise LogError(path, f"no column {column!r}", remedy)


def _listed(columns: Columns) -> str:
    names = [f"{name!r}" if " " in name else name for name in columns]
    return ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "")
