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
found by their names.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tpcd.logs.log import Log, LogError
from tpcd.logs.table import Columns

_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180}
_FORCES = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
_TORQUES = {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2}
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
ROTATIONS = {
    "rotation vector": ("rx", "ry", "rz"),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "Euler angles": ("e1", "e2", "e3"),
    "planar angle": ("phi",),
}
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


def parse_map(entries: Sequence[str], columns: Columns, path: Path) -> dict[str, tuple[str, float]]:
    """Name to column and factor to SI, for columns that exist.

    Raises `ValueError` for a malformed entry, `LogError` for a column that is not there.
    """
    found: dict[str, tuple[str, float]] = {}
    given = dict(_split(entry) for entry in entries)
    if f"{RTDE['pose']}_0" in columns:
        given = {n: c for n, c in RTDE.items() if c in columns or f"{c}_0" in columns} | given
    for name, column in given.items():
        if name in GROUPS:
            there = [names for names in GROUPS[name] if f"{column}_{len(names) - 1}" in columns]
            if not there:
                _find(f"{column}_{len(GROUPS[name][0]) - 1}", columns, path)
            found.update({n: (f"{column}_{k}", 1.0) for k, n in enumerate(there[-1])})
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
        found[name] = column, UNITS[name][unit] if unit else 1.0
    return found


def log_from_columns(
    columns: Columns,
    entries: Sequence[str],
    path: Path,
    euler: str = "ZYX",
    rate: float | None = None,
    keep: Sequence[str] = (),
) -> Log:
    """The recording in a table; `euler` are scipy's axes, capitals for turning axes.

    `rate` [Hz] stands in for a column of times. Rows that lack a number are left out, and so
    are repeated times; notes say so. Raises `LogError` and `ValueError` in one line.
    """
    mapped = parse_map(entries, columns, path)
    values: dict[str, np.ndarray] = {}
    for name, (column, factor) in mapped.items():
        if columns[column].dtype.kind != "f":
            example = next(iter(columns[column]))
            raise LogError(path, f"column {column!r} holds {str(example)!r}", "expected numbers")
        values[name] = factor * columns[column]
    for column in keep:
        _find(column, columns, path)
    count = len(next(iter(columns.values())))
    if "time" not in values:
        if rate is None:
            raise LogError(path, "no column of times", "map it (time=COLUMN) or give --rate in Hz")
        values["time"] = np.arange(count) / rate
    missing = {n for n in (*"xyz", "F_x", "F_y", "F_z", "T_x", "T_y", "T_z") if n not in values}
    if {"x", "z"} & missing or {"F_x", "F_z"} & missing:
        raise LogError(
            path,
            f"{', '.join(sorted({'x', 'z', 'F_x', 'F_z'} & missing))} not in the map",
            f"add NAME=COLUMN; the columns are {', '.join(list(columns)[:40])}",
        )
    commanded = any(name.startswith("u_") for name in values)
    if commanded:
        missing |= {f"u_{name}" for name in "xyz" if f"u_{name}" not in values}
        if {"u_x", "u_z"} & missing:
            raise LogError(path, "a set point needs u_x and u_z", "map both, or neither")
    good = np.all([np.isfinite(column) for column in values.values()], axis=0)
    notes = []
    if not good.all():
        notes.append(f"{int((~good).sum())} of {count} rows lack a number and are left out")
        values = {name: column[good] for name, column in values.items()}
    if not len(values["time"]):
        raise LogError(path, "no row has all the numbers of the map", "check the map of columns")
    if "tau" in values:
        # phi turns from x to z, about -y.
        values["T_y"] = -values["tau"]
        missing.discard("T_y")
    rotations, kind = _rotations(values, "", euler, path)
    turned = None
    if rotations is None:
        notes.append("no rotation in the map: taken as constant")
        rotations = Rotation.identity(len(values["time"]))
        missing.add("rotation")
    if commanded:
        turned, other = _rotations(values, "u_", euler, path)
        if turned is None:
            notes.append("no rotation of the set point in the map: taken as that of the start")
            turned = Rotation.from_quat(np.tile(rotations[:1].as_quat(), (len(rotations), 1)))
        elif other != kind:
            notes.append(f"rotations are read from {kind}, those of the set point from {other}")
    log = Log(
        path,
        values["time"],
        _stack(values, ("x", "y", "z")),
        rotations,
        _stack(values, ("F_x", "F_y", "F_z")),
        _stack(values, ("T_x", "T_y", "T_z")),
        _stack(values, ("u_x", "u_y", "u_z")) if commanded else None,
        turned,
        frozenset(missing),
        {name: columns[name][good] for name in keep},
        tuple(notes),
    )
    return in_order(log)


def in_order(log: Log) -> Log:
    """The log with times from 0 and without repeated ones; `LogError` where time goes back."""
    from dataclasses import replace

    steps = np.diff(log.times)
    if (steps < 0).any():
        row = int(np.argmax(steps < 0)) + 1
        raise LogError(
            log.path,
            f"time goes back from {log.times[row - 1]:.6g} to {log.times[row]:.6g} s at row {row}",
            "cut the recording there, or map the right column of times",
        )
    fresh = np.concatenate(([True], steps > 0))
    notes = list(log.notes)
    if not fresh.all():
        notes.append(f"{int((~fresh).sum())} samples repeat the time before and are left out")
    log = log.only(fresh)
    return replace(log, times=log.times - log.times[0], notes=tuple(notes))


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
    close = difflib.get_close_matches(column, list(columns), 1, 0.6)
    names = ", ".join(list(columns)[:40])
    remedy = f"did you mean {close[0]!r}?" if close else f"the columns are {names}"
    raise LogError(path, f"no column {column!r}", remedy)


def _stack(values: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    zero = np.zeros(len(values["time"]))
    return np.stack([values.get(name, zero) for name in names], axis=1)


def _rotations(
    values: Mapping[str, np.ndarray], prefix: str, euler: str, path: Path
) -> tuple[Rotation | None, str]:
    """The rotations that the map gives, and of which kind; None where it gives none."""
    begun = {
        kind: [prefix + name for name in names if prefix + name in values]
        for kind, names in ROTATIONS.items()
    }
    kinds = [kind for kind, names in begun.items() if names]
    if not kinds:
        return None, ""
    kind = kinds[0]
    names = [prefix + name for name in ROTATIONS[kind]]
    if len(kinds) > 1 or begun[kind] != names:
        found = ", ".join(name for kind in kinds for name in begun[kind])
        raise LogError(path, f"{found} in the map", f"expected all of {', '.join(names)} alone")
    entries = np.stack([values[name] for name in names], axis=1)
    try:
        if kind == "rotation vector":
            return Rotation.from_rotvec(entries), kind
        if kind == "quaternion":
            return Rotation.from_quat(entries), kind
        if kind == "Euler angles":
            return Rotation.from_euler(euler, entries), kind
    except ValueError as error:
        raise LogError(path, f"{kind} {', '.join(names)}: {error}", "check the map") from error
    return Rotation.from_rotvec(entries * np.array([0.0, -1.0, 0.0])), kind
