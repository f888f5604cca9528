"""Columns of a table become a recording by a map: units, rotations, rows that lack and streams."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow
import pytest
from made_logs import Setting, an_episode, choices_of, sampled, write_csv
from made_tables import IIWA, IIWA_MAP, LONG, MAP, RTDE, SPACE, columns, same, text_of, without
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from tpcd.data.episode import Episode
from tpcd.data.measured import Measured
from tpcd.logs.columns import UNITS, log_from_columns
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.log import LogError
from tpcd.logs.table import read_columns
from tpcd.quality.finding import Weight
from tpcd.quality.suggest import suggest_map


def rtde(separator: str, path: Path) -> Path:
    """A recording with the names of Universal Robots' client."""
    pose, target = (
        np.column_stack((SPACE[p], Rotation.from_quat(SPACE[r]).as_rotvec()))
        for p, r in (("position", "rotation"), ("target", "turned"))
    )
    values = (pose, np.column_stack((SPACE["force"], SPACE["torque"])), target)
    table = {"timestamp": SPACE["time"] + 77.0}
    for name, block in zip(RTDE, values, strict=True):
        table.update({f"{name}_{k}": block[:, k] for k in range(6)})
    return write_csv(path, table, separator)


@pytest.mark.parametrize("rotation", ["q", "r", "e"])
def test_rotations_of_every_kind_are_the_same(rotation: str, tmp_path: Path) -> None:
    table = columns(rotation)
    path = write_csv(tmp_path / "a.csv", table)
    entries = ["time=t", *(f"{name}={name}" for name in table if name != "t")]
    same(log_from_columns(read_columns(path), entries, path, euler="ZYX"))


def test_every_unit_is_converted(tmp_path: Path) -> None:
    table, entries = columns("e"), []
    for name in list(table):
        target = "time" if name == "t" else name
        unit, factor = list(UNITS[target].items())[-1]
        table[name] = table[name] / factor
        entries.append(f"{target}={name}:{unit}")
    path = write_csv(tmp_path / "a.csv", table)
    same(log_from_columns(read_columns(path), entries, path), atol=1e-5)


def test_units_are_taken_from_the_table_where_the_map_gives_none(tmp_path: Path) -> None:
    table = columns()
    table["x"], table["F_z"] = 1e3 * table["x"], 1e-3 * table["F_z"]
    units = ["s", "[mm]", *["m"] * 2, *["-"] * 4, *["m"] * 3, *["1"] * 4, "N", "N", "kN"]
    units += ["N·m", "Nm", "N*m"]
    path = tmp_path / "a.csv"
    lines = text_of(table)
    path.write_text("\n".join([lines[0], ",".join(units), *lines[1:]]), encoding="utf-8")
    log = log_from_columns(read_columns(path), MAP, path)
    same(log)
    assert "column 'x' is in mm by the table" in log.notes
    path.write_text("\n".join(lines).replace("t,x,y", "t,x [mm],y").replace("F_z", "F_z (kN)"))
    named = [*without("x", "F_z"), "x=x [mm]", "F_z=F_z (kN)"]
    same(log_from_columns(read_columns(path), named, path))
    # What the map says is what holds.
    named = [*without("x", "F_z"), "x=x [mm]:m", "F_z=F_z (kN)"]
    given = log_from_columns(read_columns(path), named, path)
    assert np.allclose(given.positions[:, 0], 1e3 * SPACE["position"][:, 0], atol=1e-5)


def test_lists_in_parquet_become_numbered_columns(tmp_path: Path) -> None:
    pose = np.column_stack((SPACE["position"], SPACE["rotation"]))
    target = np.column_stack((SPACE["target"], SPACE["turned"]))
    wrench = np.column_stack((SPACE["force"], SPACE["torque"]))
    table = {"stamp": pyarrow.array((1e9 * SPACE["time"]).astype("int64"), pyarrow.timestamp("ns"))}
    for name, block in (("pose", pose), ("to", target), ("ft", wrench)):
        table[name] = pyarrow.array(block.tolist(), pyarrow.list_(pyarrow.float64()))
    table["label"] = pyarrow.array(["a"] * len(pose))
    path = tmp_path / "a.parquet"
    parquet.write_table(pyarrow.table(table), path)
    entries = ["time=stamp", "pose=pose", "wrench=ft", "command=to"]
    log = log_from_columns(read_columns(path), entries, path, keep=("label",))
    same(log)
    assert log.extra["label"][0] == "a"


@pytest.mark.parametrize("separator", [" ", ","])
def test_recordings_of_universal_robots_need_no_map(separator: str, tmp_path: Path) -> None:
    path = rtde(separator, tmp_path / "robot_data.csv")
    table = read_columns(path)
    log = log_from_columns(table, (), path)
    assert log.command_positions is None, "where the servo is sent is no set point of an impedance"
    same(log_from_columns(table, ("command=target_TCP_pose",), path))


def test_planar_recordings_need_no_third_dimension(tmp_path: Path) -> None:
    episode = an_episode(4)
    samples = sampled(episode)
    table = {"t": samples["time"]}
    for names, block in (("x z phi", "pose"), ("u_x u_z u_phi", "u"), ("F_x F_z tau", "wrench")):
        table.update({n: samples[block][:, k] for k, n in enumerate(names.split())})
    path = write_csv(tmp_path / "a.csv", table)
    entries = ["time=t", *(f"{name}={name}" for name in table if name != "t")]
    log = log_from_columns(read_columns(path), entries, path)
    content = import_log(log, choices_of(Setting())).content
    assert isinstance(content, Episode) and len(content) == len(episode)
    # The tool's direction is not known, so angles count from the first sample.
    assert float((content.poses - episode.poses)[:, :2].abs().max()) < 1e-4
    assert float((content.poses - episode.poses)[:, 2].abs().max()) < 5e-3
    assert float((content.wrenches - episode.wrenches).abs().max()) < 0.2


def test_rows_that_lack_a_number_and_repeated_times_are_told(tmp_path: Path) -> None:
    table = columns()
    table["F_x"] = table["F_x"].copy()
    table["F_x"][3:6] = np.nan
    table["t"] = table["t"].copy()
    table["t"][10] = table["t"][9]
    path = write_csv(tmp_path / "a.csv", table)
    log = log_from_columns(read_columns(path), MAP, path)
    assert len(log) == len(table["t"]) - 4
    assert log.notes == (
        f"3 of {len(table['t'])} rows lack a number and are left out (F_x; first in line 5)",
        "1 samples repeat the time before and are left out",
    )


BAD_MAPS = {
    "malformed": ([*MAP, "x"], "found 'x', expected NAME=COLUMN"),
    "unknown name": ([*MAP, "fx=F_x"], "unknown name 'fx'; did you mean"),
    "unknown unit": ([*without("x"), "x=x:feet"], "x in 'feet', expected one of m, cm, mm"),
    "unknown column": ([*without("x"), "x=xx"], "no column 'xx'"),
    "no force": (without("F_z"), "F_z not in the map"),
    "half a set point": (without("u_x"), "a set point needs u_x and u_z"),
    "half a quaternion": (without("qw"), "expected all of qx, qy, qz, qw alone"),
    "two rotations": ([*MAP, "phi=qx"], "expected all of qx, qy, qz, qw alone"),
    "no time": (without("time"), "time not in the map; the columns are t, x, y"),
    "text": ([*without("x"), "x=word"], "column 'word' holds 'w' in row 0, counted from 0"),
}


@pytest.mark.parametrize("case", BAD_MAPS)
def test_a_bad_map_is_one_line(case: str, tmp_path: Path) -> None:
    entries, expected = BAD_MAPS[case]
    table = {**columns(), "word": np.array(["w"] * len(SPACE["time"]))}
    with pytest.raises((LogError, ValueError)) as caught:
        log_from_columns(table, entries, tmp_path / "a.csv")
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_time_that_goes_back_is_named(tmp_path: Path) -> None:
    table = columns()
    table["t"] = table["t"].copy()
    table["t"][7] = 0.0
    with pytest.raises(LogError, match="time goes back from .* at row 7"):
        log_from_columns(table, MAP, tmp_path / "a.csv")


def test_a_column_that_is_empty_for_seconds_is_a_gap_and_so_are_rows_that_stop(
    tmp_path: Path,
) -> None:
    table = columns(samples=LONG)
    table["F_x"] = table["F_x"].copy()
    table["F_x"][300:420] = np.nan
    stopped = {name: np.delete(column, np.arange(500, 620)) for name, column in table.items()}
    log = log_from_columns(stopped, MAP, tmp_path / "a.csv")
    gaps = {(g.start, g.end) for g in log.findings if g.weight is Weight.LEFT_OUT}
    times = LONG["time"]
    expected = {(times[299], times[420]), (times[499], times[620])}
    assert {tuple(np.round(g, 6)) for g in gaps} == {tuple(np.round(g, 6)) for g in expected}
    assert len(log) == len(times) - 240


def test_streams_in_rows_of_their_own_are_joined_by_their_times(tmp_path: Path) -> None:
    # As exports of bags put them: each message a row, empty where the others are.
    table, count = columns(), len(SPACE["time"])
    late = {name: np.full(2 * count, np.nan) for name in table}
    pose = [n for n in table if n[0] in "xyzqu"]
    for name, column in table.items():
        if name == "t":
            late[name][0::2], late[name][1::2] = column, column + 0.003
        elif name in pose:
            late[name][0::2] = column
        else:
            late[name][1::2] = column
    log = log_from_columns(late, MAP, tmp_path / "a.csv")
    assert len(log) == count - 1 and any("joined by their times" in note for note in log.notes)
    expected = 0.7 * SPACE["force"][9] + 0.3 * SPACE["force"][8]
    assert np.allclose(log.forces[8], expected, atol=1e-3)


def test_without_a_map_the_columns_are_listed_and_a_map_is_suggested(tmp_path: Path) -> None:
    names = ["Timestamp (s)", "TCP_Pos_X", "TCP_Pos_Y", "TCP_Pos_Z", "orientation.x",
             "orientation.y", "orientation.z", "orientation.w"]  # fmt: skip
    names += [f"desired_pose_{n}" for n in "xyz"] + [f"target_quat_{n}" for n in "xyzw"]
    names += [f"wrench.force.{n}" for n in "xyz"] + [f"Mom{n}" for n in "XYZ"]
    named = dict(zip(names, columns().values(), strict=True))
    with pytest.raises(LogError) as caught:
        log_from_columns(named, (), tmp_path / "a.csv")
    told = str(caught.value)
    assert "F_x, F_z, time, x, z not in the map; the columns are 'Timestamp (s)', TCP_Pos_X" in told
    assert suggest_map(named).line in told
    same(log_from_columns(named, suggest_map(named).entries, tmp_path / "a.csv"))


def test_a_table_of_streams_with_other_clocks_is_mended_on_request(tmp_path: Path) -> None:
    table, late = columns(), 30
    for name in ("F_x", "F_y", "F_z", "T_x", "T_y", "T_z"):
        table[name] = np.concatenate((np.full(late, table[name][0]), table[name][:-late]))
    log = log_from_columns(table, MAP, tmp_path / "a.csv", delays={"wrench": late / 100})
    count = len(log)
    assert np.allclose(log.forces[:, 0], SPACE["force"][:count, 0], atol=1e-3)
    assert any(each.kind == "moved" for each in log.findings)


@pytest.mark.skipif(not IIWA.is_file(), reason="TPCD_MEASURED has no iiwa_screw_contact")
def test_a_real_recording_is_read_through_its_map() -> None:
    log = log_from_columns(read_columns(IIWA), IIWA_MAP, IIWA, "ZYX", keep=("Kz",))
    assert len(log) == 726 and log.times[-1] == pytest.approx(23.764, abs=1e-3)
    # A-B-C of the maker turn by 1.58, 0.63 and -3.12 rad about z, y' and x''.
    assert np.allclose(log.rotations.as_euler("ZYX").mean(0)[:2], [1.58, 0.625], atol=0.005)
    found = import_log(log, Importing((2000.0, 1000.0, 200.0)))
    assert isinstance(found.content, Measured) and found.header.sensor_std is None
    assert "one contact held throughout" in found.content.summary()
    doubts = " ".join(map(str, found.account.doubts))
    for told in ("no set points", "never stood still", "motion is out of the plane"):
        assert told in doubts
