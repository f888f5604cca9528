"""Tables of numbers from elsewhere: CSV with any separator, and Parquet.

Unlike the table of an episode, nothing is expected of such a file but a line of names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tpcd.logs.kinds import Refused, columns_of
from tpcd.logs.layout import (
    NULLS,
    Layout,
    find_layout,
    is_null,
    split,
    unit_of_name,
)
from tpcd.logs.log import LogError
from tpcd.numerals import odd_cell
from tpcd.text import encoding_of, lines_of, read_ends, read_text

Columns = Mapping[str, np.ndarray]


class Table(dict[str, np.ndarray]):
    """Columns by name: numbers as float64, or whole where a float is too coarse; else text."""

    path: Path | None = None
    layout: Layout | None = None
    """Of a text table."""
    encoding: str = ""
    """Of a text table."""
    units: dict[str, str]
    """By a line of units."""
    moments: dict[str, str]
    """Columns that are moments or durations by their kind, and in which unit."""
    refused: dict[str, Refused]
    """Columns that cannot be read, as lists of unequal length."""
    notes: tuple[str, ...] = ()
    """What was passed over."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.units, self.moments, self.refused = path, {}, {}, {}


def read_columns(path: Path) -> Table:
    """All columns by name: numbers where every cell is one or says that there is none, else text.

    Raises `LogError` for a file that is missing, empty, ragged or of another kind.
    """
    if not path.is_file():
        raise LogError(path, "no such file", "give a CSV or Parquet file, or a bag")
    columns = Table(path)
    try:
        parquet = path.suffix.lower() in (".parquet", ".pq")
        content = _parquet(path) if parquet else _csv(path, columns)
    except (UnicodeError, OSError, ValueError) as error:  # pyarrow's errors are of these
        problem = " ".join(str(error).split())
        raise LogError(path, f"cannot be read as a table ({problem})", "export it again") from error
    names, parts = content.column_names, content.columns
    del content
    for k, name in enumerate(names):
        # One column after another, so that no more than one is there twice.
        part, parts[k] = parts[k], None
        for column in columns_of(name, part, _usual_mark(columns)):
            if column.name in columns:
                raise LogError(path, f"column {column.name!r} appears twice", "rename one of them")
            if isinstance(column, Refused):
                columns.refused[column.name] = column
                continue
            columns[column.name] = column.values
            if column.unit:
                columns.moments[column.name] = column.unit
            if column.note:
                columns.notes += (column.note,)
    _release()
    if not columns or not len(next(iter(columns.values()))):
        raise LogError(path, "no rows below the line of names", "export it again")
    return columns


def units_of(columns: Columns) -> dict[str, str]:
    """Units that the table itself gives: in a line of units, or in brackets after a name."""
    named = {name: unit for name in columns if (unit := unit_of_name(name))}
    return {**named, **(columns.units if isinstance(columns, Table) else {})}


def place(columns: Columns, row: int) -> str:
    """How a message names a row: by the line of a text file, counted from 1, else from 0."""
    if not isinstance(columns, Table) or columns.layout is None or columns.path is None:
        return f"row {row}, counted from 0"
    layout = columns.layout
    with columns.path.open(encoding=columns.encoding, errors="replace") as file:
        for number, line in enumerate(file, start=1):
            if number > layout.first and line.strip() and _fits(line, layout):
                row -= 1
            if row < 0:
                return f"line {number}"
    return "the last line"


def text_among_numbers(columns: Columns, column: str) -> tuple[str, str]:
    """What stands in a column that should hold numbers, and where; and what to do."""
    cells = [str(cell).strip().replace("\N{MINUS SIGN}", "-") for cell in columns[column]]
    numbers = ["0" if is_null(cell) else cell for cell in cells]
    row, more, remedy = odd_cell(numbers, _usual_mark(columns)) or (0, "", "expected numbers")
    return f"column {column!r} holds {cells[row]!r} in {place(columns, row)}{more}", remedy


def _parquet(path: Path) -> Any:
    from pyarrow import parquet

    return parquet.read_table(path)


def _csv(path: Path, columns: Table) -> Any:
    from pyarrow import ArrowInvalid, csv, py_buffer, string

    columns.encoding = encoding = encoding_of(path)
    head, tail = read_ends(path, encoding)
    if not head.strip():
        raise ValueError("the file is empty")
    # A cut line at the end of the sample, or at the beginning of the tail, shows no layout.
    whole = not tail
    layout = find_layout(lines_of(head)[: None if whole else -1], lines_of(tail)[1:])
    names = [name or f"column {k + 1}" for k, name in enumerate(layout.names)]
    columns.layout = layout
    columns.units = {n: u for n, u in zip(names, layout.units, strict=False) if u and u != "1"}
    # As it is where it can be read in parts; else in memory, as UTF-8 with a line feed a line.
    source: Any = str(path)
    old = "\n" not in head
    if encoding not in ("utf-8", "utf-8-sig") or layout.separator == " " or old:
        text = read_text(path, encoding)
        if layout.separator == " ":
            text = re.sub(r"(?m)^ | $", "", re.sub(r"[ \t]+", " ", text))
        source = py_buffer(text.encode())
        del text
    odd: list[str] = []

    def ragged(row: Any) -> str:
        odd.append(row.text or "")
        return "skip"

    def read(kinds: dict[str, Any]) -> Any:
        odd.clear()
        return csv.read_csv(
            source,
            csv.ReadOptions(column_names=names, skip_rows=layout.first),
            csv.ParseOptions(delimiter=layout.separator, invalid_row_handler=ragged),
            csv.ConvertOptions(
                decimal_point=layout.mark or ".",
                null_values=[*NULLS, *(n.upper() for n in NULLS), "NaN", "Nan", "None", "Null"],
                column_types=kinds,
            ),
        )

    try:
        # Where columns differ in their decimal mark, each is read for itself.
        table = read({} if layout.mark else dict.fromkeys(names, string()))
    except ArrowInvalid:
        # The kind of a column is found on the first rows; text further down breaks it.
        table = read(dict.fromkeys(names, string()))
    columns.notes = layout.notes + (_passed_over(odd, path, encoding, layout) if odd else ())
    empty = [n for n, c in zip(names, table.columns, strict=True)
             if n.startswith("column ") and c.null_count == len(c)]  # fmt: skip
    # A separator at the end of each line makes a column without a name that holds nothing.
    return table.drop_columns([n for n in empty if not layout.names[names.index(n)]])


def _fits(line: str, layout: Layout) -> bool:
    return len(split(line, layout.separator)) == len(layout.names)


def _passed_over(odd: list[str], path: Path, encoding: str, layout: Layout) -> tuple[str, ...]:
    """Notes on lines of another width that can be passed over: remarks, and a last line cut off.

    Raises `ValueError` for any other.
    """
    notes, remarks = [], sum(text.lstrip()[:1] in ("#", "%") for text in odd)
    text = read_text(path, encoding)
    for number, line in enumerate(text.split("\n"), start=1):
        if number <= layout.first or not line.strip() or _fits(line, layout):
            continue
        if line.lstrip()[:1] in ("#", "%"):
            continue
        found = len(split(line, layout.separator))
        problem = f"line {number} has {found} cells, expected {len(layout.names)}"
        if not text.endswith(line):
            raise ValueError(problem)
        notes.append(f"{problem}: it is the last, cut off in writing, and left out")
    if remarks:
        notes.append(f"{remarks} lines of remarks among the rows are passed over")
    return tuple(notes)


def _release() -> None:
    """Give back what pyarrow keeps for its next table, which may be as large as this one."""
    from pyarrow import default_memory_pool

    default_memory_pool().release_unused()


def _usual_mark(columns: Columns) -> str:
    """The decimal mark of most numbers of a text table."""
    layout = columns.layout if isinstance(columns, Table) else None
    return "." if layout is None else layout.mark
