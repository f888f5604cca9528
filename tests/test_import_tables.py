"""Reading tables: separators, units and rotations make no difference, and errors are one line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from made_logs import Setting, an_episode, choices_of, in_space, sampled, write_csv
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from tpcd.data.episode import Episode
from tpcd.data.measured import Measured
from tpcd.logs.columns import UNITS, log_from_columns
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.log import Log, LogError
from tpcd.logs.table import read_columns

SETTING = Setting(
    base=Rotation.from_euler("xyz", [0.3, 0.5, 2.0]), tool=Rotation.from_euler("x", 3.0)
)
SPACE = in_space(sampled(an_episode(4)), SETTING)
MAP = ["time=t", *(f"{name}={name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))]
MAP += [f"{name}={name}" for name in ("F_x", "F_y", "F_z", "T_x", "T_y", "T_z")]
MAP += [f"u_{name}=u_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
RTDE = ("actual_TCP_pose", "actual_TCP_force", "target_TCP_pose")


def columns(rotation: str = "q") -> dict[str, np.ndarray]:
    """All columns in SI units, with rotations as quaternions, vectors (r) or Euler angles (e)."""
    table = {"t": SPACE["time"]}
    for prefix, place, turn in (("", "position", "rotation"), ("u_", "target", "turned")):
        table.update({prefix + n: SPACE[place][:, k] for k, n in enumerate("xyz")})
        turns = Rotation.from_quat(SPACE[turn])
        entries = {
            "q": (("qx", "qy", "qz", "qw"), turns.as_quat()),
            "r": (("rx", "ry", "rz"), turns.as_rotvec()),
            "e": (("e1", "e2", "e3"), turns.as_euler("ZYX")),
        }[rotation]
        table.update({prefix + n: entries[1][:, k] for k, n in enumerate(entries[0])})
    for kind, name in (("F", "force"), ("T", "torque")):
        table.update({f"{kind}_{n}": SPACE[name][:, k] for k, n in enumerate("xyz")})
    return table


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


def same(log: Log, atol: float = 1e-6) -> None:
    assert np.allclose(log.times, SPACE["time"], atol=1e-6)
    assert np.allclose(log.positions, SPACE["position"], atol=atol)
    assert np.allclose(log.forces, SPACE["force"], atol=1e-5)
    assert np.allclose(log.torques, SPACE["torque"], atol=1e-5)
    left = log.rotations * Rotation.from_quat(SPACE["rotation"]).inv()
    assert left.magnitude().max() < 1e-6
    assert log.command_positions is not None and log.command_rotations is not None
    assert np.allclose(log.command_positions, SPACE["target"], atol=atol)
    left = log.command_rotations * Rotation.from_quat(SPACE["turned"]).inv()
    assert left.magnitude().max() < 1e-6


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_separators_make_no_difference(separator: str, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", columns(), separator)
    same(log_from_columns(read_columns(path), MAP, path))


def test_decimal_commas_are_read_where_semicolons_part_the_columns(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", columns(), ";")
    path.write_text("\ufeff" + path.read_text().replace(".", ","), encoding="utf-8")
    same(log_from_columns(read_columns(path), MAP, path))


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


def without(*names: str) -> list[str]:
    return [entry for entry in MAP if entry.partition("=")[0] not in names]


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
    "text": ([*without("x"), "x=word"], "column 'word' holds 'w'"),
}


@pytest.mark.parametrize("case", BAD_MAPS)
def test_a_bad_map_is_one_line(case: str, tmp_path: Path) -> None:
    entries, expected = BAD_MAPS[case]
    table = {**columns(), "word": np.array(["w"] * len(SPACE["time"]))}
    with pytest.raises((LogError, ValueError)) as caught:
        log_from_columns(table, entries, tmp_path / "a.csv")
    assert expected in str(caught.value) and "\n" not in str(caught.value)


BAD_FILES = {
    "missing": (None, "no such file"),
    "empty": ("", "the file is empty"),
    "only names": ("t,x\n", "no rows below the line of names"),
    "ragged": ("t,x\n1,2\n3\n4,5\n", "line 3 has 1 cells, expected 2"),
    "twice": ("t,t\n1,2\n", "appears twice"),
    "no text": (b"\xff\xfe\x00t\x00", "cannot be read as a table"),
    "no parquet": ("t,x\n1,2\n", "cannot be read as a table"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_table_is_one_line(case: str, tmp_path: Path) -> None:
    content, expected = BAD_FILES[case]
    path = tmp_path / ("a.parquet" if case == "no parquet" else "a.csv")
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(LogError) as caught:
        read_columns(path)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_time_that_goes_back_is_named(tmp_path: Path) -> None:
    table = columns()
    table["t"] = table["t"].copy()
    table["t"][7] = 0.0
    with pytest.raises(LogError, match="time goes back from .* at row 7"):
        log_from_columns(table, MAP, tmp_path / "a.csv")


def measured_folder() -> Path:
    """Where recordings of real arms are: TPCD_MEASURED, or beside the repository."""
    named = os.environ.get("TPCD_MEASURED")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "measured"


IIWA = measured_folder() / "iiwa_screw_contact" / "sensor_data.csv"
IIWA_MAP = [
    "time=timestamp:ms",
    "x=X",
    "y=Y",
    "z=Z",
    "e1=A",
    "e2=B",
    "e3=C",
    "F_x=Fx",
    "F_y=Fy",
    "F_z=Fz",
    "T_x=Tx",
    "T_y=Ty",
    "T_z=Tz",
]


@pytest.mark.skipif(not IIWA.is_file(), reason="TPCD_MEASURED has no iiwa_screw_contact")
def test_a_real_recording_is_read_through_its_map() -> None:
    log = log_from_columns(read_columns(IIWA), IIWA_MAP, IIWA, "ZYX", keep=("Kz",))
    assert len(log) == 726 and log.times[-1] == pytest.approx(23.764, abs=1e-3)
    # A-B-C of the maker turn by 1.58, 0.63 and -3.12 rad about z, y' and x''.
    assert np.allclose(log.rotations.as_euler("ZYX").mean(0)[:2], [1.58, 0.625], atol=0.005)
    found = import_log(log, Importing((2000.0, 1000.0, 200.0)))
    assert isinstance(found.content, Measured) and found.header.sensor_std is None
    assert "one contact held throughout" in found.content.summary()
    doubts = " ".join(found.account.doubts)
    for told in ("no set points", "never stood still", "motion is out of the plane"):
        assert told in doubts
