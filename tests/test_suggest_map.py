"""A column map is suggested that reads the table as it was meant."""

from __future__ import annotations

import numpy as np
import pytest
from made_streams import made_stream

from tpcd.quality.suggest import suggest_map

STREAM = made_stream()
VALUES = dict(zip(STREAM.channels, STREAM.values.T, strict=True))
TURNS = ("qx", "qy", "qz", "qw")


def named(pattern: dict[str, str], scale: dict[str, float] | None = None) -> dict[str, np.ndarray]:
    """Columns by their names in a table, from names of the map."""
    factors = scale or {}
    known = {"time": STREAM.times, **VALUES, **{f"u_{q}": VALUES[q] for q in TURNS}}
    return {column: factors.get(name, 1.0) * known[name] for name, column in pattern.items()}


KUKA = {"time": "timestamp", "x": "X", "y": "Y", "z": "Z", "F_x": "Fx", "F_y": "Fy", "F_z": "Fz",
        "T_x": "Tx", "T_y": "Ty", "T_z": "Tz"}  # fmt: skip
FRANKA = {
    **{n: f"current_pos_{n}" for n in "xyz"},
    **{q: f"current_orientation_{q[1]}" for q in TURNS},
    **{f"u_{n}": f"goal_pos_{n}" for n in "xyz"},
    **{f"u_{q}": f"goal_orientation_{q[1]}" for q in TURNS},
    **{f"F_{n}": f"force_{n}" for n in "xyz"},
    **{f"T_{n}": f"torque_{n}" for n in "xyz"},
}
ROS = {
    **{n: f"pose.position.{n}" for n in "xyz"},
    **{q: f"pose.orientation.{q[1]}" for q in TURNS},
    **{f"u_{n}": f"target_pose.position.{n}" for n in "xyz"},
    **{f"F_{n}": f"wrench.force.{n}" for n in "xyz"},
    **{f"T_{n}": f"wrench.torque.{n}" for n in "xyz"},
}
PLAIN = {n: n for n in ("time", *STREAM.channels)}


@pytest.mark.parametrize("pattern", [KUKA, FRANKA, ROS, PLAIN])
def test_every_column_is_taken_for_what_it_is(pattern: dict[str, str]) -> None:
    others = dict.fromkeys(("joint_1", "Vx", "actual_current_0", "Kx"), np.sin(STREAM.times))
    told = suggest_map({**others, **named(pattern)})
    assert dict(entry.split("=") for entry in told.entries) == pattern
    assert ("--rate" in " ".join(told.notes)) == ("time" not in pattern)


def test_units_are_taken_from_names_and_else_from_sizes() -> None:
    written = {"time": "Time [ms]", "x": "TCP x [mm]", "z": "TCP z (mm)", "F_x": "Force X (N)",
               "F_z": "Force Z (N)", "T_y": "Torque Y [N·m]", "u_x": "cmd x [mm]"}  # fmt: skip
    told = suggest_map(named(written, {"x": 1e3, "z": 1e3, "u_x": 1e3, "time": 1e3}))
    units = {e.split("=")[0]: e.rpartition(":")[2] for e in told.entries}
    assert units == {"time": "ms", "x": "mm", "z": "mm", "F_x": "N", "F_z": "N", "T_y": "Nm",
                     "u_x": "mm"}  # fmt: skip
    assert "'x=TCP x [mm]:mm'" in told.line
    sizes = named(KUKA, {"x": 1e3, "y": 1e3, "z": 1e3, "T_x": 1e3, "T_y": 1e3, "T_z": 1e3})
    sizes["timestamp"] = 1.7e18 + 1e9 * STREAM.times
    entries = suggest_map(sizes).entries
    assert {"x=X:mm", "T_x=Tx:Nmm", "time=timestamp:ns", "F_x=Fx"} <= set(entries)


def test_numbered_columns_are_taken_as_groups() -> None:
    table = {"timestamp": STREAM.times}
    table.update({f"actual_TCP_pose_{k}": STREAM.values[:, k] for k in range(6)})
    table.update({f"target_TCP_pose_{k}": STREAM.values[:, k] for k in range(6)})
    table.update({f"actual_TCP_force_{k}": STREAM.values[:, 7 + k] for k in range(6)})
    table.update({f"command_pose_{k}": STREAM.values[:, k] for k in range(7)})
    told = suggest_map(table)
    assert told.entries == (
        *("time=timestamp", "pose=actual_TCP_pose", "command=command_pose"),
        "wrench=actual_TCP_force",
    )
    assert any("target_TCP_pose" in note for note in told.notes)


def test_what_is_named_as_a_quaternion_and_is_none_is_not_suggested() -> None:
    told = suggest_map({"x": VALUES["x"], **{q: 3.0 * VALUES[q] for q in TURNS}})
    assert told.entries == ("x=x",) and any("length 1" in note for note in told.notes)


def test_columns_without_telling_names_suggest_nothing() -> None:
    told = suggest_map({f"a{k}": column for k, column in enumerate(STREAM.values.T)})
    assert told.entries == () and told.line == ""
    assert any("no columns look like a pose" in note for note in told.notes)
