"""How a text table is laid out: encoding, separator, line of names, line of units, decimal mark.

Loggers put remarks above the names, units below them, separators at the ends of lines, blanks and
commas into names. What the lines of numbers agree on decides: the separator is the one that cuts
most of them into equally many numbers, outside of quotes; the names stand in the last line above
them that has as many cells.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from tpcd.numerals import PARTED, decimal_mark, is_number, marks_shown

SEPARATORS = (",", ";", "\t", "|", " ")
NULLS = ("", "-", "--", "?", "na", "n/a", "#n/a", "nan", "-nan", "null", "none", "nil", "1.#ind",
         "-1.#ind", "1.#qnan")  # fmt: skip
"""Cells, in small letters, that say that there is no number."""
REMARK = re.compile(r"^\s*(#|%|//|\*)+\s*")
SAMPLE = 400
"""So many lines from the beginning show the layout."""
_UNITS = {
    "s": "s sec secs second seconds",
    "ms": "ms msec millisecond milliseconds",
    "us": "us µs μs usec microsecond microseconds",
    "ns": "ns nsec nanosecond nanoseconds",
    "m": "m meter meters metre metres",
    "cm": "cm",
    "mm": "mm millimeter millimeters",
    "um": "um µm μm",
    "in": "in inch inches",
    "rad": "rad rads radian radians",
    "mrad": "mrad",
    "deg": "deg degs degree degrees °",
    "N": "n newton newtons",
    "mN": "",
    "kN": "kn",
    "Nm": "nm n*m n·m n.m n_m n-m",
    "mNm": "mnm",
    "Nmm": "nmm n*mm n·mm",
    "Ncm": "ncm n*cm n·cm",
    "1": "1 - none",
}
_SPELLED = {word: unit for unit, words in _UNITS.items() for word in words.split()}


@dataclass(frozen=True)
class Layout:
    """Where names and numbers stand in a text table."""

    separator: str
    names: tuple[str, ...]
    first: int
    """Index of the first line of numbers, from 0."""
    mark: str = "."
    """The decimal mark of the numbers shown; "" where columns differ."""
    units: tuple[str, ...] = ()
    """Units by the line below the names, "" where they are not known."""
    notes: tuple[str, ...] = ()


def unit_word(text: str) -> str:
    """A unit as the map of columns spells it, from `[mm]`, `(N*m)`, `sec`; "" if it is none."""
    bare = text.strip().strip("[](){}").replace(" ", "")
    exact = bare if bare in _UNITS else ""
    return exact or _SPELLED.get(bare.lower(), "")


def unit_of_name(name: str) -> str:
    """The unit in the brackets at the end of a column's name, or ""."""
    found = re.search(r"[\[(]([^\[\]()]*)[\])]\s*$", name)
    unit = unit_word(found.group(1)) if found else ""
    return "" if unit == "1" else unit


def is_null(cell: str) -> bool:
    """Whether a cell says that there is no number."""
    return cell.strip().lower() in NULLS


def split(line: str, separator: str) -> list[str]:
    """Cells of a line, with their quotes and outer blanks off."""
    if separator == " ":
        line = " ".join(line.split())
    cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]


def find_layout(lines: Sequence[str], more: Sequence[str] = ()) -> Layout:
    """The layout of a table from its first lines, and `more` from further on.

    Raises `ValueError` where there are no names, or as many as fit no line of numbers.
    """
    shown = list(lines[:SAMPLE])
    if not any(line.strip() for line in shown):
        raise ValueError("the file is empty")
    separator, count = _separator([*shown, *more])
    cells = [split(line, separator) for line in shown]
    rows = [len(row) == count and any(map(_looks_numeric, row)) for row in cells]
    if not any(rows):
        # Nothing but names, or nothing that is a table.
        last = max(k for k, line in enumerate(shown) if line.strip())
        return Layout(separator, tuple(split(REMARK.sub("", shown[last]), separator)), last + 1)
    headers = {
        k: named for k, line in enumerate(shown) if (named := _names(line, separator, count))
    }
    if not headers:
        first = rows.index(True)
        above = [k for k in range(first) if shown[k].strip()]
        if not above:
            raise ValueError(f"line {first + 1} holds numbers, and no line above it holds names")
        found = len(split(REMARK.sub("", shown[above[-1]]), separator))
        twice = ": are commas both decimal marks and separators?" if count == 2 * found else ""
        raise ValueError(
            f"line {above[-1] + 1} has {found} names, the rows below it have {count} cells{twice}"
        )
    # Remarks may look like a row, and a row may hold no number; but most rows are below the names.
    last = max(headers, key=lambda k: (sum(rows[k:]) - 2 * sum(rows[:k]), k))
    names, units, notes = headers[last], (), ()
    if last - 1 in headers and _below_names(names):
        units = tuple(unit_word(cell) for cell in names)
        if not all(units[k] or not cell for k, cell in enumerate(names)):
            odd = next(cell for k, cell in enumerate(names) if cell and not units[k])
            notes = (f"line {last + 1} is no line of names, and {odd!r} in it is no known unit",)
        names = headers[last - 1]
    first = last + 1
    table = [row for row in [*cells[first:], *(split(line, separator) for line in more)]]
    if not names[-1] and any(len(row) == count and row[-1] for row in table):
        raise ValueError(
            f"line {first} has {count - 1} names, the rows below it have {count} cells"
        )
    mark = decimal_mark(*marks_shown(cell for row in table for cell in row))
    return Layout(separator, names, first, mark, units, notes)


def _looks_numeric(cell: str) -> bool:
    return is_number(cell) or bool(PARTED.fullmatch(cell))


def _separator(lines: Sequence[str]) -> tuple[str, int]:
    """The separator that cuts most lines into equally many numbers, and how many cells."""
    best, chosen = (-1.0, 0), (",", 1)
    for separator in SEPARATORS:
        rows = [split(line, separator) for line in lines if line.strip()]
        counts = Counter(len(row) for row in rows if any(map(_looks_numeric, row)))
        counts = counts or Counter(len(row) for row in rows)
        count, _ = counts.most_common(1)[0]
        if count < 2 or (separator == " " and chosen[0] == "\t"):
            continue
        fitting = [row for row in rows if len(row) == count]
        full = sum(sum(1 for cell in row if cell) for row in fitting)
        numbers = sum(_looks_numeric(cell) for row in fitting for cell in row)
        score = (numbers / max(full, 1) * len(fitting) / len(rows), count)
        if score > best:
            best, chosen = score, (separator, count)
    return chosen


def _names(line: str, separator: str, count: int) -> tuple[str, ...]:
    """Names in a line, as many as there are columns and no numbers; else none.

    The lines of numbers may end in a separator where that of the names does not, and the reverse;
    names may be parted otherwise, as by a blank after each comma.
    """
    bare = REMARK.sub("", line)
    for mark in (separator, *SEPARATORS):
        cells = split(bare, mark)
        if len(cells) == count + 1 and not cells[-1]:
            cells = cells[:-1]
        if len(cells) == count - 1 and line.strip() and mark == separator and count > 2:
            cells = [*cells, ""]
        if len(cells) == count and not all(map(is_null, cells)):
            # In a line of units, 1 stands for none.
            numbers = [cell for cell in cells if _looks_numeric(cell)]
            units = set(numbers) <= {"1"} and 2 * len(numbers) < len(cells)
            return tuple(cells) if units else ()
    return ()


def _below_names(cells: Sequence[str]) -> bool:
    """Whether cells are units, or cannot be names since they repeat."""
    full = [cell for cell in cells if cell]
    known = sum(bool(unit_word(cell)) for cell in full)
    return 2 * known >= len(full) or len(set(full)) < len(full)
