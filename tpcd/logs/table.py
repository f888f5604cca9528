"""Tables of numbers from elsewhere: CSV with any separator, and Parquet.

Unlike the table of an episode, nothing is expected of such a file but a line of names. A column
of lists becomes one column for each entry, numbered like those of Universal Robots' recordings:
`pose` of six becomes `pose_0` to `pose_5`. Whole numbers that a float cannot hold stay whole.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tpcd.logs.layout import (
    NULLS,
    THOUSANDS,
    Layout,
    find_layout,
    is_null,
    is_number,
    split,
    unit_of_name,
)
from tpcd.logs.log import LogError
from tpcd.text import encoding_of, lines_of, read_ends, read_text

EXACT = 2**53
"""Whole numbers up to this are exact as floats."""


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
    notes: tuple[str, ...] = ()
    """What was passed over."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.units, self.moments = path, {}, {}


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
        for column, values, unit in _flat(name, part, columns.layout):
            if column in columns:
                raise LogError(path, f"column {column!r} appears twice", "rename one of them")
            columns[column] = values
            if unit:
                columns.moments[column] = unit
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
    comma = isinstance(columns, Table) and columns.layout is not None and columns.layout.comma
    cells = [str(cell) for cell in columns[column]]
    wrong = [k for k, cell in enumerate(cells) if not (is_null(cell) or _plain(cell, comma))]
    row = wrong[0] if wrong else 0
    found = f"column {column!r} holds {cells[row]!r} in {place(columns, row)}"
    if len(wrong) > 1:
        found += f", and text in {len(wrong)} of {len(cells)} rows"
    if is_number(cells[row]):
        mark = "commas" if comma else "points"
        return found, f"expected numbers: elsewhere in the file decimals have {mark}"
    if THOUSANDS.fullmatch(cells[row]):
        return found, "expected numbers without marks between the thousands"
    return found, "expected numbers, or an empty cell where there is none"


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
                decimal_point="," if layout.comma and layout.separator != "," else ".",
                null_values=[*NULLS, *(n.upper() for n in NULLS), "NaN", "Nan", "None", "Null"],
                column_types=kinds,
            ),
        )

    try:
        table = read({})
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


def _flat(name: str, column: Any, layout: Layout | None) -> Iterator[tuple[str, np.ndarray, str]]:
    """Name, values and unit (of times, by their kind) of the columns that one becomes."""
    from pyarrow import types

    kind = column.type
    if types.is_dictionary(kind):
        yield from _flat(name, column.cast(kind.value_type), layout)
    elif types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        inside, cells = kind.value_type, column.to_pylist()
        lengths = {len(cell) for cell in cells if cell is not None}
        if len(lengths) == 1 and (types.is_floating(inside) or types.is_integer(inside)):
            gap = [None] * max(lengths)
            vectors = np.array([gap if cell is None else cell for cell in cells], dtype=np.float64)
            yield from ((f"{name}_{k}", values, "") for k, values in enumerate(vectors.T))
    elif types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind):
        whole = column.cast("int32" if types.is_time32(kind) else "int64").cast("int64")
        yield name, _whole(whole), kind.unit
    elif types.is_date(kind):
        yield name, 86400.0 * _whole(column.cast("date32").cast("int32").cast("int64")), "s"
    elif types.is_integer(kind):
        yield name, _whole(column), ""
    elif types.is_floating(kind) or types.is_boolean(kind) or types.is_decimal(kind):
        yield name, column.cast("float64").to_numpy(), ""
    elif types.is_null(kind):
        yield name, np.full(len(column), np.nan), ""
    else:
        yield _text(name, column, layout)


def _whole(column: Any) -> np.ndarray:
    """Whole numbers as float64, or as they are where a float cannot hold them and none lacks."""
    compute = _compute()
    if not column.null_count and len(column):
        ends = compute.min_max(column).as_py()
        if max(abs(ends["min"]), abs(ends["max"])) > EXACT:
            return column.to_numpy()
    return column.cast("float64", safe=False).to_numpy()


def _text(name: str, column: Any, layout: Layout | None) -> tuple[str, np.ndarray, str]:
    """Text as numbers or as moments, where all of it can be read so; else as it is."""
    from pyarrow import ArrowInvalid, ArrowNotImplementedError, scalar, string, timestamp

    compute = _compute()
    try:
        bare = compute.utf8_trim_whitespace(column.cast(string()))
    except (ArrowInvalid, ArrowNotImplementedError):
        return name, np.array([str(value) for value in column.to_pylist()], dtype=np.str_), ""
    lowered = compute.utf8_lower(bare)
    known = compute.is_in(lowered, value_set=_nulls())
    bare = compute.if_else(known, scalar(None, string()), bare)
    plain = compute.replace_substring(bare, "\N{MINUS SIGN}", "-")
    if layout is not None and (layout.comma or layout.whole):
        plain = compute.replace_substring(plain, ",", ".")
        if compute.any(compute.match_substring(bare, ".")).as_py():
            plain = bare
    if bare.null_count < len(bare):
        for kind, unit in (
            ("float64", ""),
            (timestamp("ns"), "ns"),
            (timestamp("ns", "UTC"), "ns"),
        ):
            try:
                found = plain.cast(kind)
            except (ArrowInvalid, ArrowNotImplementedError):
                continue
            return name, _whole(found.cast("int64")) if unit else found.to_numpy(), unit
    return name, np.array([str(value) for value in column.to_pylist()], dtype=np.str_), ""


def _release() -> None:
    """Give back what pyarrow keeps for its next table, which may be as large as this one."""
    from pyarrow import default_memory_pool

    default_memory_pool().release_unused()


def _compute() -> Any:
    import pyarrow.compute

    return pyarrow.compute


def _nulls() -> Any:
    from pyarrow import array

    return array(NULLS)


def _plain(cell: str, comma: bool) -> bool:
    """Whether a cell is a number with the decimal mark of the file."""
    bare = cell.strip().replace("\N{MINUS SIGN}", "-")
    return is_number(bare) and ("." if comma else ",") not in bare
