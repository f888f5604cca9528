"""Numbers as people and programs write them, and which of their marks is the decimal one.

`1.234,5` has decimal commas and points between thousands, `1,234.5` the reverse, `0.5` a decimal
point and `1.0D-3` the exponent of Fortran. `1.234` alone is read either way: what else stands in
its column, or in the file, must tell.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

MARKS: tuple[str, str] = (".", ",")
OTHER = {".": ",", ",": "."}
_FRACTION = {".": r"(\.\d*)?", ",": r"(,\d+)?"}
WRITTEN = {
    mark: rf"[+-]?((\d+{_FRACTION[mark]}|[{mark}]\d+)([eEdD][+-]?\d+)?"
    rf"|[1-9]\d{{0,2}}([{OTHER[mark]}]\d{{3}})+{_FRACTION[mark]})"
    for mark in MARKS
}
"""Numbers with that decimal mark; the other one may part their thousands."""
EITHER = {mark: rf"[+-]?[1-9]\d{{0,2}}[{mark}]\d{{3}}" for mark in MARKS}
"""Numbers with that mark which it may part by thousands as well."""
PARTED = re.compile(r"[+-]?\d{1,3}([.,' ]\d{3})+([.,]\d+)?")
"""Numbers with marks of any kind between thousands."""
INFINITE = r"[+-]?(inf|Inf|INF)(inity|INITY)?"
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
"""As our own files have them."""
_WRITTEN = {mark: re.compile(pattern) for mark, pattern in WRITTEN.items()}
_EITHER = {mark: re.compile(pattern) for mark, pattern in EITHER.items()}
_INFINITE = re.compile(INFINITE)


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with either decimal mark."""
    return any(has_mark(cell, mark) for mark in MARKS)


def has_mark(cell: str, mark: str) -> bool:
    """Whether a cell is a number whose decimal mark is this one, if it has any."""
    return bool(_WRITTEN[mark].fullmatch(cell) or _INFINITE.fullmatch(cell))


def read_number(cell: str, mark: str) -> float:
    """The number in a cell with that decimal mark; raises `ValueError` for another."""
    if not has_mark(cell, mark):
        raise ValueError(f"{cell!r} is no number whose decimal mark is {mark!r}")
    return float(re.sub("[dD]", "e", cell.replace(OTHER[mark], "").replace(mark, ".")))


def decimal_mark(only: dict[str, int], either: dict[str, int], usual: str | None = None) -> str:
    """The decimal mark of some cells, or "" where they contradict each other or do not tell.

    `only` counts cells that are numbers with that mark alone, `either` those that it may part by
    thousands too, which are taken as in the rest of the file: `usual`, or without it as most are.
    """
    shown = [mark for mark in MARKS if only[mark]]
    if shown:
        return shown[0] if len(shown) == 1 else ""
    doubtful = [mark for mark in MARKS if either[mark]]
    if usual is None or not doubtful:
        return max(MARKS, key=lambda mark: either[mark])
    return usual if doubtful == [usual] else ""


def marks_shown(cells: Iterable[str]) -> tuple[dict[str, int], dict[str, int]]:
    """Of some cells, what `decimal_mark` asks for."""
    only: dict[str, int] = dict.fromkeys(MARKS, 0)
    either: dict[str, int] = dict.fromkeys(MARKS, 0)
    for cell in cells:
        point, comma = has_mark(cell, "."), has_mark(cell, ",")
        if point != comma:
            only["." if point else ","] += 1
        for mark in MARKS:
            either[mark] += _EITHER[mark].fullmatch(cell) is not None
    return only, either


def odd_cell(cells: Sequence[str], usual: str | None = None) -> tuple[int, str, str] | None:
    """The first cell that is no number as the others are: where, what else is to be said of it,
    and what to do; None where all are."""
    only, either = marks_shown(cells)
    mark = decimal_mark(only, either, usual)
    if not mark and not any(only.values()):
        row = next(
            k
            for k, cell in enumerate(cells)
            if any(one.fullmatch(cell) for one in _EITHER.values())
        )
        values = " or ".join(f"{read_number(cells[row], mark):.12g}" for mark in MARKS)
        return row, f", which may be {values}", "write numbers without marks between thousands"
    mark = mark or max(MARKS, key=lambda mark: only[mark])
    wrong = [k for k, cell in enumerate(cells) if not has_mark(cell, mark)]
    if not wrong:
        return None
    more = f", and text in {len(wrong)} of {len(cells)} rows" if len(wrong) > 1 else ""
    if PARTED.fullmatch(cells[wrong[0]]):
        return wrong[0], more, "expected numbers without marks between the thousands"
    if is_number(cells[wrong[0]]):
        name = "commas" if mark == "," else "points"
        return wrong[0], more, f"expected numbers: elsewhere in the file decimals have {name}"
    return wrong[0], more, "expected numbers, or an empty cell where there is none"
