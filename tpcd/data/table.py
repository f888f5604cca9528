"""Tables of named columns in CSV and Parquet files, with errors that name the cell.

A table is a dict from column name to a numpy array; all arrays have one length. Numbers
survive a round trip to the last bit. Required columns are read as finite float64; further
columns keep integers, floats, booleans or text, whichever the whole column fits.
"""

from __future__ import annotations

import csv
import difflib
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tpcd.errors import EpisodeError
from tpcd.numerals import NUMBER

WHOLE_NUMBER = re.compile(r"-?(0|[1-9]\d{0,18})")
LARGEST = 2**63
"""Of int64, which holds nanoseconds since 1970."""
NOT_FINITE = {"nan", "inf", "+inf", "-inf", "infinity", "+infinity", "-infinity"}
UNIT_SUFFIX = re.compile(r"[ _\[(]+(mm|cm|m|rad|deg|degrees|mrad|n|nm|n_m|n\*m|mn|mnm)[\])]*$")
SYNONYMS = {
    "forcex": "F_x",
    "forcez": "F_z",
    "torque": "tau",
    "moment": "tau",
    "ty": "tau",
    "my": "tau",
    "angle": "phi",
    "theta": "phi",
    "uangle": "u_phi",
    "utheta": "u_phi",
    "commandx": "u_x",
    "commandz": "u_z",
    "commandphi": "u_phi",
    "cmdx": "u_x",
    "cmdz": "u_z",
    "cmdphi": "u_phi",
    "posx": "x",
    "posz": "z",
    "index": "step",
    "row": "step",
    "k": "step",
}

Table = dict[str, np.ndarray]


def read_table(path: Path, required: Sequence[str]) -> Table:
    """Read NAME.csv or NAME.parquet; required columns come first, as float64.

    Raises `EpisodeError` for a file that is missing, empty or ragged, for missing or
    repeated columns, and for required cells that are not finite numbers.
    """
    if not path.is_file():
        raise EpisodeError(path, "no such file", "give NAME.csv, NAME.parquet or their folder")
    return _read_parquet(path, required) if path.suffix == ".parquet" else _read_csv(path, required)


def encode_table(table: Table, path: Path) -> bytes:
    """Content of the file `path` for a table: Parquet where its suffix says so, else CSV."""
    if path.suffix == ".parquet":
        pyarrow = _load_pyarrow(path)
        buffer = io.BytesIO()
        pyarrow.parquet.write_table(pyarrow.table(dict(table)), buffer)
        return buffer.getvalue()
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    columns = [[_cell(value) for value in column.tolist()] for column in table.values()]
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue().encode("utf-8")


def row_name(row: int, path: Path, line: int | None = None) -> str:
    """How a message names row k: with the line of a text file, where row 0 is line 2."""
    return f"row {row}" + (f" (line {line or row + 2})" if path.suffix == ".csv" else "")


def _cell(value: object) -> str:
    return repr(value) if isinstance(value, float) else str(value)


def _read_csv(path: Path, required: Sequence[str]) -> Table:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise EpisodeError(path, "not a UTF-8 text file", "save it as CSV in UTF-8") from error
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(c.strip() for c in cells)]
    except csv.Error as error:
        raise EpisodeError(path, f"line {reader.line_num}: {error}", "save it as CSV") from error
    if not lines:
        raise EpisodeError(path, "the file is empty", f"expected the header {','.join(required)}")
    names = [cell.strip() for cell in lines[0][1]]
    _check_names(path, names, required)
    rows = lines[1:]
    for row, (line, cells) in enumerate(rows):
        if len(cells) != len(names):
            raise EpisodeError(
                path,
                f"{row_name(row, path, line)} has {len(cells)} cells, expected {len(names)}",
                "complete the row; decimal points must be '.', not ','",
            )
    table: Table = {}
    for name in [*required, *(n for n in names if n not in required)]:
        position = names.index(name)
        cells = [cells[position].strip() for _, cells in rows]
        if name in required:
            for row, cell in enumerate(cells):
                _check_cell(path, row_name(row, path, rows[row][0]), name, cell)
            table[name] = np.array([float(cell) for cell in cells], dtype=np.float64)
            _check_finite(path, name, table[name], [line for line, _ in rows])
        else:
            table[name] = _free_column([cells[position] for _, cells in rows])
    return table


def _check_names(path: Path, names: list[str], required: Sequence[str]) -> None:
    if names[0].startswith(("#", "%", "//")):
        raise EpisodeError(
            path, f"the first line is the remark {names[0]!r}", "begin with the line of names"
        )
    if len(names) == 1 and any(mark in names[0] for mark in ";\t"):
        raise EpisodeError(path, f"header is {names[0]!r}", "separate the columns by commas")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise EpisodeError(path, f"column {repeated[0]!r} appears twice", "remove one of them")
    missing = [name for name in required if name not in names]
    if not missing:
        return
    unknown = [name for name in names if name not in required]
    hints = [hint for name in missing if (hint := _hint(name, unknown))]
    problem = f"column{'s' if len(missing) > 1 else ''} {', '.join(missing)} missing"
    found = f"found {', '.join(names)}" if not hints else "; ".join(hints)
    raise EpisodeError(
        path, f"{problem} ({found})", f"expected the columns {','.join(required)} in SI units"
    )


def _hint(missing: str, unknown: list[str]) -> str:
    """A sentence on an unknown column that looks like the missing one, or nothing."""
    for name in unknown:
        lowered = name.strip().lower()
        unit = UNIT_SUFFIX.search(lowered)
        bare = re.sub(r"[^a-z0-9]", "", lowered[: unit.start()] if unit else lowered)
        if bare == missing.lower().replace("_", "") or SYNONYMS.get(bare) == missing:
            wanted = "convert to SI and " if unit else ""
            return f"{name!r} looks like it: {wanted}rename to {missing!r}"
    close = difflib.get_close_matches(missing, [n for n in unknown if len(n) > 2], 1, 0.7)
    return f"{close[0]!r} looks like it: rename to {missing!r}" if close else ""


def _check_cell(path: Path, row: str, name: str, cell: str) -> None:
    if NUMBER.fullmatch(cell) or cell.lower() in NOT_FINITE:
        return
    found = "an empty cell" if not cell else repr(cell)
    raise EpisodeError(
        path, f"{row}, column {name}: found {found}, expected a number", "correct or drop the row"
    )


def _check_finite(
    path: Path, name: str, column: np.ndarray, lines: Sequence[int] | None = None
) -> None:
    bad = np.flatnonzero(~np.isfinite(column))
    if len(bad):
        row = int(bad[0])
        raise EpisodeError(
            path,
            f"{row_name(row, path, lines[row] if lines else None)}, column {name}: found"
            f" {column[row]}, expected a finite number",
            "drop the step from the recording or measure it again",
        )


def _free_column(cells: list[str]) -> np.ndarray:
    """Values of a column that is kept but not used: int, float, bool, else text as it was."""
    stripped = [cell.strip() for cell in cells]
    if all(WHOLE_NUMBER.fullmatch(cell) for cell in stripped):
        whole = [int(cell) for cell in stripped]
        if all(-LARGEST <= value < LARGEST for value in whole):
            return np.array(whole, dtype=np.int64)
    if all(NUMBER.fullmatch(cell) or cell.lower() in NOT_FINITE for cell in stripped):
        return np.array([float(cell) for cell in stripped], dtype=np.float64)
    if all(cell in ("True", "False") for cell in stripped):
        return np.array([cell == "True" for cell in stripped])
    return np.array(cells, dtype=np.str_)


def _load_pyarrow(path: Path) -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise EpisodeError(
            path, f"Parquet needs pyarrow, which does not load here ({error})", "use CSV instead"
        ) from error
    return pyarrow


def _read_parquet(path: Path, required: Sequence[str]) -> Table:
    pyarrow = _load_pyarrow(path)
    try:
        content = pyarrow.parquet.read_table(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise EpisodeError(path, "not a readable Parquet file", "export it again") from error
    names = list(content.column_names)
    _check_names(path, names, required)
    table: Table = {}
    for name in [*required, *(n for n in names if n not in required)]:
        column = content.column(name)
        if name not in required:
            values = column.to_numpy()
            is_text = pyarrow.types.is_string(column.type)
            table[name] = values.astype(np.str_) if is_text else values
            continue
        if not (pyarrow.types.is_floating(column.type) or pyarrow.types.is_integer(column.type)):
            raise EpisodeError(
                path, f"column {name} holds {column.type}, expected numbers", "export it as double"
            )
        table[name] = np.asarray(column.to_numpy(), dtype=np.float64)
        _check_finite(path, name, table[name])
    return table
