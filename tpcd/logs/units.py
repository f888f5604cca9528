"""Units that a recording was read in, looked at before its forces are held against its motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tpcd.logs.joining import ROTATIONS
from tpcd.logs.log import AXES, Log
from tpcd.quality.finding import Finding
from tpcd.quality.stream import Stream
from tpcd.quality.units import check_units


def doubted_units(log: Log) -> tuple[Finding, ...]:
    """Doubts on the units of a recording, with the columns of its map in the remedy: those found
    when it was read, or else what its samples show."""
    found = [each for each in log.findings if each.kind == "unit"]
    found = found or check_units([_stream(log)])
    return tuple(replace(each, remedy=_mapped(each, log)) for each in found)


def _stream(log: Log) -> Stream:
    parts = [("", log.positions), ("F_", log.forces), ("T_", log.torques)]
    if log.command_positions is not None:
        parts.append(("u_", log.command_positions))
    channels = [prefix + axis for prefix, _ in parts for axis in AXES]
    values = [values for _, values in parts]
    for prefix, numbers in (("", log.numbers), ("u_", log.command_numbers)):
        if numbers is not None and numbers.kind != "quaternion":
            channels += [prefix + name for name in ROTATIONS[numbers.kind]]
            values.append(numbers.entries)
    there = [k for k, name in enumerate(channels) if name not in log.missing]
    names = tuple(channels[k] for k in there)
    return Stream(log.path.name, names, log.times, np.column_stack(values)[:, there])


def _mapped(doubt: Finding, log: Log) -> str:
    """The remedy, as entries of the map for the columns that the recording was read from."""
    unit = doubt.remedy.rpartition(":")[2]
    names = ["tau" if n == "T_y" and "tau" in log.columns else n for n in doubt.channels]
    entries = [f"{name}={log.columns[name]}:{unit}" for name in names if name in log.columns]
    return f"--map {' '.join(entries)}" if entries and "=COLUMN:" in doubt.remedy else doubt.remedy
