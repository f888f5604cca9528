"""Reading tables: separators, units and rotations make no difference, and errors are one line."""

from __future__ import annotations

import os
from decimal import Decimal
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from made_logs import Setting, an_episode, choices_of, in_space, sampled, write_csv
from pyarrow import csv as pyarrow_csv
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from tpcd.data.episode import Episode
from tpcd.data.measured import Measured
from tpcd.logs.columns import UNITS, log_from_columns
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.log import Log, LogError
from tpcd.logs.table import read_columns
from tpcd.quality.finding import Weight
from tpcd.quality.suggest import suggest_map

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
    "text": ([*without("x"), "x=word"], "column 'word' holds 'w' in row 0, counted from 0"),
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
    "no names": ("1,2\n3,4\n", "line 1 holds numbers, and no line above it holds names"),
    "more names": ("t,x,y\n1,2\n3,4\n", "line 1 has 3 names, the rows below it have 2 cells"),
    "commas for both": ("t,x\n0,5,1,5\n1,5,2,5\n", "are commas both decimal marks and separators?"),
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


def text_of(table: dict[str, np.ndarray], separator: str = ",", comma: bool = False) -> list[str]:
    """The lines of a table, names first."""
    rows = np.column_stack(list(table.values()))
    cells = [[f"{value:.9g}" for value in row] for row in rows]
    if comma:
        cells = [[cell.replace(".", ",") for cell in row] for row in cells]
    return [separator.join(row) for row in ([*table], *cells)]


def renamed(names: list[str], lines: list[str], separator: str = ",") -> list[str]:
    return [separator.join(names), *lines[1:]]


def map_to(names: list[str]) -> list[str]:
    """The map where the columns have other names, in the order of `columns`."""
    targets = ["time", *list(columns())[1:]]
    return [f"{target}={name}" for target, name in zip(targets, names, strict=True)]


BLANK = ["time (s)" if name == "t" else f"TCP {name} value" for name in columns()]
COMMA = ["t" if name == "t" else f"pose, {name}" for name in columns()]
LAYOUTS = {
    "names with blanks": ("\n".join(renamed(BLANK, text_of(columns()))), BLANK),
    "names with blanks, tabs": ("\n".join(renamed(BLANK, text_of(columns(), "\t"), "\t")), BLANK),
    "quoted commas": ("\n".join(renamed([f'"{n}"' for n in COMMA], text_of(columns()))), COMMA),
    "blanks after commas": ("\n".join(row.replace(",", ", ") for row in text_of(columns())), None),
    "aligned with blanks": (
        "\n".join("  " + row.replace(" ", "    ") + " " for row in text_of(columns(), " ")),
        None,
    ),
    "remarks above": ("# cell 3\n% rate 100 Hz\n\n" + "\n".join(text_of(columns())), None),
    "text above": ("Recorded by A. Smith\nrate, 100\n" + "\n".join(text_of(columns())), None),
    "names in a remark": ("# made by it\n# " + "\n".join(text_of(columns())), None),
    "units below": (
        "\n".join([text_of(columns())[0], ",".join(["s"] + ["SI"] * 20), *text_of(columns())[1:]]),
        None,
    ),
    "separators at the ends": ("\n".join(row + "," for row in text_of(columns())), None),
    "separators at the ends of rows": (
        "\n".join([text_of(columns())[0], *(row + "," for row in text_of(columns())[1:])]),
        None,
    ),
    "whole first row": (
        "\n".join(
            [
                *(t := text_of(columns(), ";", True))[:1],
                ";".join(["0"] * 7 + ["1"] + ["0"] * 6 + ["1"] + ["0"] * 6),
                *t[2:],
            ]
        ),
        None,
    ),
    "lines of Windows": ("\r\n".join(text_of(columns())), None),
    "lines of old": ("\r".join(text_of(columns())), None),
    "pipes": ("\n".join(text_of(columns(), "|")), None),
    "remarks between": (
        "\n".join([*text_of(columns())[:9], "# paused", *text_of(columns())[9:]]),
        None,
    ),
    "cut off": ("\n".join(text_of(columns())) + "\n9.5,0.1", None),
}


@pytest.mark.parametrize("case", LAYOUTS)
def test_the_layout_of_a_table_makes_no_difference(case: str, tmp_path: Path) -> None:
    text, names = LAYOUTS[case]
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode())
    log = log_from_columns(read_columns(path), MAP if names is None else map_to(names), path)
    if case == "whole first row":
        assert np.allclose(log.positions[1:], SPACE["position"][1:], atol=1e-6)
        assert np.allclose(log.forces[1:], SPACE["force"][1:], atol=1e-5)
        return
    same(log)
    assert any("cut off in writing" in note for note in log.notes) == (case == "cut off")
    assert any("remarks among the rows" in note for note in log.notes) == (
        case == "remarks between"
    )


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32", "latin-1"])
def test_the_encoding_of_a_table_makes_no_difference(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(("# gemessen für Zelle 3\n" + "\n".join(text_of(columns()))).encode(encoding))
    same(log_from_columns(read_columns(path), MAP, path))


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


SMALL = {
    "quoted decimal commas": ('"t","x"\n"0,5","1,5"\n"0,6","2,5"\n', [1.5, 2.5]),
    "decimal commas far down": ("t;x\n" + "1;2\n" * 60_000 + "2;3,5\n", [2.0] * 60_000 + [3.5]),
    "names and values above": ("rate,100\nmass,5\nt,x\n" + "0,1\n" * 9, [1.0] * 9),
    "names of two lines": ("pose,pose\nt,x\n0,1\n1,2\n", [1.0, 2.0]),
    "tabs and text above": ("Version\t2\n\nt\tx\tComment\n0,5\t1,5\t\n0,6\t1,6\t\n", [1.5, 1.6]),
    "separator told": ("sep=;\nt;x\n1,5;2\n2,5;3\n", [2.0, 3.0]),
    "signs": ("t,x\n0,+1.5\n1,\N{MINUS SIGN}2.5\n", [1.5, -2.5]),
    "no numbers at first": ("t,x\nnan,nan\n1,2\n", [np.nan, 2.0]),
    "text with blanks": ("t,label,x\n0,free motion here,1\n1,in contact,2\n", [1.0, 2.0]),
}


@pytest.mark.parametrize("case", SMALL)
def test_what_loggers_write_is_read(case: str, tmp_path: Path) -> None:
    text, expected = SMALL[case]
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert np.array_equal(read_columns(tmp_path / "a.csv")["x"], expected, equal_nan=True)


EPOCH = 1_700_000_000


@pytest.mark.parametrize("unit", ["ns", "us", "ms"])
@pytest.mark.parametrize("named", [True, False], ids=["unit in the map", "unit not given"])
@pytest.mark.parametrize("kind", ["csv", "int64", "uint64", "lacking"])
def test_whole_times_since_1970_keep_every_nanosecond(
    unit: str, named: bool, kind: str, tmp_path: Path
) -> None:
    per_second = round(1 / UNITS["time"][unit])
    times = [EPOCH * per_second + round(per_second * float(t)) for t in SPACE["time"]]
    if unit == "ns":
        times = [time + k % 7 for k, time in enumerate(times)]
    table = {**columns(), "t": pyarrow.array(times, "uint64" if kind == "uint64" else "int64")}
    if kind == "lacking":
        table["t"] = pyarrow.array([*times[:-1], None], "int64")
    path = tmp_path / ("a.csv" if kind == "csv" else "a.parquet")
    (pyarrow_csv.write_csv if kind == "csv" else parquet.write_table)(pyarrow.table(table), path)
    entries = [*without("time"), f"time=t:{unit}" if named else "time=t"]
    log = log_from_columns(read_columns(path), entries, path)
    since = np.array([time - times[0] for time in times]) / per_second
    if kind == "lacking":
        assert np.allclose(log.times, since[:-1], atol=3e-7)
        return
    assert np.abs(log.times - since).max() < 1e-12
    assert any(f"is read as {unit} since 1970" in note for note in log.notes) == (not named)


KINDS = {
    "duration": (lambda t: pyarrow.array((1e6 * t).round().astype("int64"),
                                         pyarrow.duration("us"))),
    "moment": (lambda t: pyarrow.array((1e9 * t).round().astype("int64") + EPOCH * 10**9,
                                       pyarrow.timestamp("ns", "Europe/Berlin"))),
    "time of day": (lambda t: pyarrow.array((1e3 * t).round().astype("int32"),
                                            pyarrow.time32("ms"))),
    "decimal": (lambda t: pyarrow.array([Decimal(f"{v:.3f}") for v in t])),
    "dictionary": (lambda t: pyarrow.array(t).dictionary_encode()),
    "text": (lambda t: pyarrow.array([f" {v:.3f} " for v in t])),
    "text of moments": (lambda t: pyarrow.array(
        [f"2026-11-29 10:00:{v:06.3f}" for v in t])),
    "whole": (lambda t: pyarrow.array((1e3 * t).round().astype("int32"))),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_times_of_every_kind_of_parquet_are_the_same(kind: str, tmp_path: Path) -> None:
    table = {**columns(), "t": KINDS[kind](SPACE["time"])}
    table["half"] = pyarrow.array(np.zeros(len(SPACE["time"]), dtype=np.float16))
    table["none"] = pyarrow.nulls(len(SPACE["time"]))
    table["yes"] = pyarrow.array([True] * len(SPACE["time"]))
    path = tmp_path / "a.parquet"
    parquet.write_table(pyarrow.table(table), path)
    entries = [*without("time", "u_qx"), "u_qx=half", f"time=t{':ms' * (kind == 'whole')}"]
    read = read_columns(path)
    log = log_from_columns(read, [*without("time"), entries[-1]], path)
    same(log)
    assert read["half"].dtype == np.float64 and read["yes"].sum() == len(SPACE["time"])
    assert np.isnan(read["none"]).all()


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("err", "holds 'err' in line 9; expected numbers, or an empty cell"),
        ("1.234,5", "holds '1.234,5' in line 9; expected numbers without marks between"),
        ("12.3 N", "holds '12.3 N' in line 9"),
        (
            "0,5",
            "holds '0,5' in line 9; expected numbers: elsewhere in the file decimals have points",
        ),
    ],
)
def test_text_among_numbers_is_named_with_its_line(
    cell: str, expected: str, tmp_path: Path
) -> None:
    lines = ["# made by it", *text_of(columns(), ";")]
    row = lines[8].split(";")
    lines[8] = ";".join([*row[:15], cell, *row[16:]])
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(LogError) as caught:
        log_from_columns(read_columns(path), MAP, path)
    assert expected in str(caught.value) and "column 'F_x'" in str(caught.value)


def test_cells_that_say_that_there_is_no_number_are_left_out_and_told(tmp_path: Path) -> None:
    lines = text_of(columns())
    for k, cell in enumerate(("NaN", "nan", "NA", "-", "", "inf", "null", "--", "N/A")):
        row = lines[10 + 3 * k].split(",")
        lines[10 + 3 * k] = ",".join([*row[:15], cell, *row[16:]])
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    log = log_from_columns(read_columns(path), MAP, path)
    assert len(log) == len(SPACE["time"]) - 9
    assert log.notes[0].endswith("rows lack a number and are left out (F_x; first in line 11)")


def test_text_far_down_is_found_as_well(tmp_path: Path) -> None:
    # Beyond the rows on which the kind of a column is found.
    lines = ["t,x,z,F_x,F_z"] + [f"{k / 100},0.1,0.2,{k % 7}.25,0.5" for k in range(60_000)]
    lines[50_001] = "500,0.1,0.2,overload,0.5"
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    entries = ["time=t", "x=x", "z=z", "F_x=F_x", "F_z=F_z"]
    with pytest.raises(LogError, match="column 'F_x' holds 'overload' in line 50002"):
        log_from_columns(read_columns(path), entries, path)


def test_a_column_that_is_empty_for_seconds_is_a_gap_and_so_are_rows_that_stop(
    tmp_path: Path,
) -> None:
    table = columns()
    table["F_x"] = table["F_x"].copy()
    table["F_x"][300:420] = np.nan
    stopped = {name: np.delete(column, np.arange(500, 620)) for name, column in table.items()}
    log = log_from_columns(stopped, MAP, tmp_path / "a.csv")
    gaps = {(g.start, g.end) for g in log.findings if g.weight is Weight.LEFT_OUT}
    times = SPACE["time"]
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
    doubts = " ".join(map(str, found.account.doubts))
    for told in ("no set points", "never stood still", "motion is out of the plane"):
        assert told in doubts
