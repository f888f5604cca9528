"""Tables of numbers from elsewhere: CSV with any separator, and Parquet.

Unlike the table of an episode, nothing is expected of such a file but a line of names. A column
of lists becomes one column for each entry, numbered like those of Universal Robots' recordings:
`pose` of six becomes `pose_0` to `pose_5`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tpcd.logs.log import LogError

SEPARATORS = (",", ";", "\t", " ")
Columns = dict[str, np.ndarray]


def read_columns(path: Path) -> Columns:
    """All columns by name: float64 where they hold numbers, else text; gaps are NaN.

    Raises `LogError` for a file that is missing, empty, ragged or of another kind.
    """
    if not path.is_file():
        raise LogError(path, "no such file", "give a CSV or Parquet file, or a bag")
    try:
        table = _parquet(path) if path.suffix.lower() in (".parquet", ".pq") else _csv(path)
    except (UnicodeDecodeError, OSError, ValueError) as error:  # pyarrow's errors are of these
        problem = " ".join(str(error).split())
        raise LogError(path, f"cannot be read as a table ({problem})", "export it again") from error
    columns: Columns = {}
    for name, content in zip(table.column_names, table.columns, strict=True):
        for column, values in _flat(name, content):
            if column in columns:
                raise LogError(path, f"column {column!r} appears twice", "rename one of them")
            columns[column] = values
    if not columns or not len(next(iter(columns.values()))):
        raise LogError(path, "no rows below the line of names", "export it again")
    return columns


def _parquet(path: Path) -> Any:
    from pyarrow import parquet

    return parquet.read_table(path)


def _csv(path: Path) -> Any:
    from pyarrow import csv

    with path.open(encoding="utf-8-sig") as file:
        header, first = file.readline().strip(), file.readline()
    if not header:
        raise ValueError("the file is empty")
    separator = max(SEPARATORS, key=header.count)
    names = [name.strip().strip('"') for name in header.lstrip("# ").split(separator)]
    comma = separator != "," and re.search(r"\d,\d", first) and "." not in first
    return csv.read_csv(
        path,
        csv.ReadOptions(column_names=names, skip_rows=1),
        csv.ParseOptions(delimiter=separator),
        csv.ConvertOptions(decimal_point="," if comma else "."),
    )


def _flat(name: str, column: Any) -> Iterator[tuple[str, np.ndarray]]:
    from pyarrow import types

    kind = column.type
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        inside, cells = kind.value_type, column.to_pylist()
        lengths = {len(cell) for cell in cells if cell is not None}
        if len(lengths) == 1 and (types.is_floating(inside) or types.is_integer(inside)):
            gap = [None] * max(lengths)
            vectors = np.array([gap if cell is None else cell for cell in cells], dtype=np.float64)
            yield from ((f"{name}_{k}", values) for k, values in enumerate(vectors.T))
        return
    if types.is_timestamp(kind):
        factor = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        yield name, factor * column.cast("int64").to_numpy().astype(np.float64)
    elif types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind):
        yield name, column.cast("float64").to_numpy()
    else:
        yield name, np.array([str(value) for value in column.to_pylist()], dtype=np.str_)
