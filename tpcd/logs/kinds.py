"""What a column of pyarrow becomes: numbers where it holds some of any kind, moments, else text.

A column of lists becomes one column for each entry, numbered like those of Universal Robots'
recordings, `pose_0` to `pose_5`; a column of structs one for each field, `force.x`. Text is read as
numbers where all of a column has one decimal mark; whole numbers that a float cannot hold stay
whole.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Shaped

from tpcd.logs.layout import NULLS
from tpcd.numerals import EITHER, INFINITE, MARKS, OTHER, WRITTEN, decimal_mark

EXACT = 2**53
"""Whole numbers up to this are exact as floats."""


@dataclass(frozen=True, eq=False)
class Column:
    """A column as it is used: float64, or whole where a float is too coarse; else truth values or
    text."""

    name: str
    values: Shaped[np.ndarray, " n"]
    unit: str = ""
    """Of moments and durations."""
    note: str = ""
    """How it was read, where that could surprise."""


@dataclass(frozen=True)
class Refused:
    """A column that cannot be read."""

    name: str
    row: int
    problem: str


def columns_of(name: str, column: Any, mark: str = ".") -> Iterator[Column | Refused]:
    """The columns that one becomes; `mark` is the decimal mark in the rest of its file."""
    from pyarrow import types

    kind = column.type
    if types.is_dictionary(kind):
        yield from columns_of(name, column.cast(kind.value_type), mark)
    elif types.is_struct(kind):
        for k in range(kind.num_fields):
            field = _compute().struct_field(column, [k])
            yield from columns_of(f"{name}.{kind.field(k).name}", field, mark)
    elif types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        yield from _entries(name, column)
    elif types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind):
        whole = column.cast("int32" if types.is_time32(kind) else "int64").cast("int64")
        yield Column(name, _whole(whole), kind.unit)
    elif types.is_date(kind):
        yield Column(name, 86400.0 * _whole(column.cast("date32").cast("int32").cast("int64")), "s")
    elif types.is_integer(kind):
        yield Column(name, _whole(column))
    elif types.is_floating(kind) or types.is_decimal(kind):
        yield Column(name, column.cast("float64").to_numpy())
    elif types.is_boolean(kind) and not column.null_count:
        yield Column(name, column.to_numpy())
    elif types.is_null(kind):
        yield Column(name, np.full(len(column), np.nan))
    else:
        yield _text(name, column, mark)


def _entries(name: str, column: Any) -> Iterator[Column | Refused]:
    """A column for each entry of lists of one length; an empty list is one that lacks."""
    from pyarrow import types

    inside, cells = column.type.value_type, column.to_pylist()
    lengths = np.array([len(cell or ()) for cell in cells], dtype=np.int64)
    usual = int(np.bincount(lengths[lengths > 0]).argmax()) if lengths.any() else 0
    odd = np.flatnonzero((lengths > 0) & (lengths != usual))
    if not (types.is_floating(inside) or types.is_integer(inside)):
        yield Refused(name, 0, f"holds lists of {inside}, expected lists of numbers")
    elif not usual:
        yield Refused(name, 0, "holds no entries, expected lists of numbers")
    elif len(odd):
        found = f"holds a list of {lengths[odd[0]]} entries, expected {usual} as elsewhere"
        yield Refused(name, int(odd[0]), found)
    else:
        gap = [None] * usual
        vectors = np.array([cell or gap for cell in cells], dtype=np.float64)
        yield from (Column(f"{name}_{k}", values) for k, values in enumerate(vectors.T))


def _whole(column: Any) -> np.ndarray:
    """Whole numbers as float64, or as they are where a float cannot hold them and none lacks."""
    compute = _compute()
    if not column.null_count and len(column):
        ends = compute.min_max(column).as_py()
        if max(abs(ends["min"]), abs(ends["max"])) > EXACT:
            return column.to_numpy()
    return column.cast("float64", safe=False).to_numpy()


def _text(name: str, column: Any, usual: str) -> Column:
    """Text as numbers or as moments, where all of it can be read so; else as it is."""
    from pyarrow import ArrowInvalid, ArrowNotImplementedError, array, scalar, string, timestamp

    compute = _compute()

    def as_it_is() -> Column:
        return Column(name, np.array([str(v) for v in column.to_pylist()], dtype=np.str_))

    try:
        bare = compute.utf8_trim_whitespace(column.cast(string()))
    except (ArrowInvalid, ArrowNotImplementedError):
        return as_it_is()
    known = compute.is_in(compute.utf8_lower(bare), value_set=array(NULLS))
    bare = compute.if_else(known, scalar(None, string()), bare)
    if bare.null_count == len(bare):
        return as_it_is()
    bare = compute.replace_substring(bare, "\N{MINUS SIGN}", "-")
    if (found := _numbers(name, bare, usual)) is not None:
        return found
    for kind in (timestamp("ns"), timestamp("ns", "UTC")):
        try:
            return Column(name, _whole(bare.cast(kind).cast("int64")), "ns")
        except (ArrowInvalid, ArrowNotImplementedError):
            continue
    return as_it_is()


def _numbers(name: str, bare: Any, usual: str) -> Column | None:
    """Text as numbers, where all of it has one decimal mark."""
    compute = _compute()

    def like(pattern: str) -> Any:
        return compute.match_substring_regex(bare, f"^({pattern})$")

    fits = {mark: like(f"{WRITTEN[mark]}|{INFINITE}") for mark in MARKS}
    only = {mark: _count(compute.and_not(fits[mark], fits[OTHER[mark]])) for mark in MARKS}
    either = {mark: _count(like(EITHER[mark])) for mark in MARKS}
    mark = decimal_mark(only, either, usual)
    if not mark or not compute.all(fits[mark]).as_py():
        return None
    parted = compute.match_substring(bare, OTHER[mark])
    note = ""
    if compute.any(parted).as_py():
        first = bare.filter(parted)[0].as_py()
        value = first.replace(OTHER[mark], "").replace(mark, ".")
        note = f"column {name!r} has marks between thousands: {first!r} is read as {value}"
    plain = compute.replace_substring(bare, OTHER[mark], "")
    plain = compute.replace_substring(plain, mark, ".")
    plain = compute.replace_substring_regex(plain, "[dD]", "e")
    if not compute.any(compute.match_substring_regex(plain, r"[^\d-]")).as_py():
        try:
            return Column(name, _whole(plain.cast("int64")), note=note)
        except ValueError:
            pass  # larger than any whole number
    return Column(name, plain.cast("float64").to_numpy(), note=note)


def _count(mask: Any) -> int:
    return _compute().sum(mask).as_py() or 0


def _compute() -> Any:
    import pyarrow.compute

    return pyarrow.compute
