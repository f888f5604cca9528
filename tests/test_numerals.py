"""Marks in numbers: what is written is read, and what may be two numbers is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from tpcd.logs.columns import parse_map, read_numbers
from tpcd.logs.log import LogError
from tpcd.logs.table import read_columns
from tpcd.numerals import MARKS, has_mark, is_number, read_number


@pytest.mark.parametrize(
    ("cell", "point", "comma"),
    [
        ("950", 950.0, 950.0),
        ("12.345", 12.345, 12345.0),
        ("1,234", 1234.0, 1.234),
        ("0.125", 0.125, None),
        ("1.234,56", None, 1234.56),
        ("1,234.5", 1234.5, None),
        ("1.234.567", None, 1234567.0),
        ("-1.0D-3", -1e-3, None),
        ("1,5e3", None, 1500.0),
        ("-Infinity", -np.inf, -np.inf),
        ("12.34,5", None, None),
        ("1,", None, None),
        ("1_000", None, None),
    ],
)
def test_a_cell_is_one_number_for_each_decimal_mark(cell: str, point, comma) -> None:
    found = [read_number(cell, mark) if has_mark(cell, mark) else None for mark in MARKS]
    assert found == [point, comma] and is_number(cell) == (found != [None, None])


def force(path: Path) -> list[float]:
    """The column F of a table, read as a force."""
    values, _ = read_numbers(read_columns(path), {"F_x": ("F", "N")}, path)
    return values["F_x"].tolist()


DOUBTFUL = "write numbers without marks between thousands"
TABLES = {
    "German": ("t;F\n0,5;1.234,56\n1,0;12.345\n1,5;950\n", [1234.56, 12345.0, 950.0]),
    "German, quoted": ('t,F\n"0,5","1.234,56"\n"1,0","12.345"\n', [1234.56, 12345.0]),
    "English": ("t;F\n0.5;1,234.5\n1.0;12,345\n", [1234.5, 12345.0]),
    "English, tabs": ("t\tF\n0.5\t1,234,567\n1.0\t2.5\n", [1234567.0, 2.5]),
    "English, quoted": ('t,F\n0.5,"1,234.5"\n1.0,"-12,345"\n', [1234.5, -12345.0]),
    "three decimals": ("t;F\n1.000;1.234\n2.000;5.678\n", [1.234, 5.678]),
    "three decimals by commas": ("t;F\n1,000;1,234\n2,000;5,678\n", [1.234, 5.678]),
    "another mark than the rest": ("t;F\n0,5;0.25\n1,0;1.234\n", [0.25, 1.234]),
    "Fortran": ("t F\n0.0D+0 1.0D-3\n1.0D+0 -2.5d2\n", [1e-3, -250.0]),
    "quoted": ('t,F\n"0.5","1.25"\n"1.0"," 2.5 "\n', [1.25, 2.5]),
    "typographic minus": ("t;F\n0,5;\u22121,5\n1,0;2,5\n", [-1.5, 2.5]),
    "German or not": (
        "t;F\n0,5;950\n1,0;12.345\n",
        f"'F' holds '12.345' in line 3, which may be 12.345 or 12345; {DOUBTFUL}",
    ),
    "English or not": (
        "t;F\n0.5;1,234\n1.0;950\n",
        f"'F' holds '1,234' in line 2, which may be 1234 or 1.234; {DOUBTFUL}",
    ),
    "columns that differ": (
        "t;F;z\n0,5;1.234;0.5\n1,0;2.345;0.5\n", "'F' holds '1.234' in line 2, which may be",
    ),
    "both in a column": (
        "t;F\n0.5;1.234,5\n1.0;0.5\n1.5;0.7\n",
        "'F' holds '1.234,5' in line 2; expected numbers without marks between the thousands",
    ),
    "truth values": ("t,F\n0.5,true\n1.0,false\n", "'F' holds 'True' in line 2, and"),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLES)
def test_marks_between_thousands_are_read_or_refused(case: str, tmp_path: Path) -> None:
    text, expected = TABLES[case]
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    if isinstance(expected, list):
        assert force(path) == expected
        return
    with pytest.raises(LogError) as caught:
        force(path)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_a_column_with_marks_between_thousands_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t;F\n0,5;1.234,56\n")
    (note,) = read_columns(path).notes
    assert note == "column 'F' has marks between thousands: '1.234,56' is read as 1234.56"


def test_whole_times_keep_every_nanosecond_where_columns_differ_in_their_mark(
    tmp_path: Path,
) -> None:
    path, time = tmp_path / "a.csv", 1_700_000_000_000_000_001
    path.write_text(f"t;F;z\n{time};0,5;0.5\n{time + 1};0,5;0.5\n")
    assert read_columns(path)["t"].tolist() == [time, time + 1]


LISTS = pyarrow.list_(pyarrow.float64())
PARQUET = {
    "an empty list": (pyarrow.array([[1.0, 2.0], [], [3.0, None]], LISTS), "F_0", [1.0, None, 3.0]),
    "a list that lacks": (pyarrow.array([[1.0, 2.0], None], LISTS), "F_1", [2.0, None]),
    "unequal lists": (
        pyarrow.array([[1.0, 2.0], [1.0, 2.0], [3.0]], LISTS),
        "F_1",
        "'F' holds a list of 1 entries, expected 2 as elsewhere in row 2, counted from 0",
    ),
    "empty lists": (pyarrow.array([[], []], LISTS), "F_0", "'F' holds no entries"),
    "lists of text": (pyarrow.array([["a"], ["b"]]), "F_0", "'F' holds lists of string, expected"),
    "structs": (pyarrow.array([{"x": 1.0}, None, {"x": None}]), "F.x", [1.0, None, None]),
    "structs in structs": (pyarrow.array([{"a": {"x": [1, 2]}}]), "F.a.x_1", [2.0]),
    "whole numbers that lack": (pyarrow.array([1, None, 3]), "F", [1.0, None, 3.0]),
    "truth values": (pyarrow.array([True, False]), "F", "'F' holds 'True' in row 0, counted"),
    "truth values that lack": (pyarrow.array([True, None]), "F", "'F' holds 'True' in row 0"),
    "text": (pyarrow.array(["0,5", "1.234,5", None]), "F", [0.5, 1234.5, None]),
}


@pytest.mark.parametrize("case", PARQUET)
def test_columns_of_parquet_are_read_or_refused_by_row(case: str, tmp_path: Path) -> None:
    column, name, expected = PARQUET[case]
    path = tmp_path / "a.parquet"
    parquet.write_table(pyarrow.table({"F": column, "t": np.arange(float(len(column)))}), path)
    entries = ["time=t", *(f"{n}={name}" for n in ("x", "z", "F_x", "F_z"))]
    columns = read_columns(path)
    if isinstance(expected, list):
        mapped = parse_map(entries, columns, path)
        found = read_numbers(columns, mapped, path)[0]["F_x"]
        assert np.array_equal(found, np.array(expected, dtype=float), equal_nan=True)
        return
    with pytest.raises(LogError) as caught:
        read_numbers(columns, parse_map(entries, columns, path), path)
    assert expected in str(caught.value) and "\n" not in str(caught.value)
