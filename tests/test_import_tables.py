"""Reading tables: separators, units and rotations make no difference, and errors are one line."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from made_logs import write_csv
from made_tables import MAP, SPACE, columns, same, text_of, without
from pyarrow import csv as pyarrow_csv
from pyarrow import parquet

from tpcd.logs.columns import UNITS, log_from_columns
from tpcd.logs.log import LogError
from tpcd.logs.table import read_columns


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_separators_make_no_difference(separator: str, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", columns(), separator)
    same(log_from_columns(read_columns(path), MAP, path))


def test_decimal_commas_are_read_where_semicolons_part_the_columns(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", columns(), ";")
    path.write_text("\ufeff" + path.read_text().replace(".", ","), encoding="utf-8")
    same(log_from_columns(read_columns(path), MAP, path))


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
