"""Outlines by what a user calls them: a built-in or YCB name, or a file."""

from __future__ import annotations

import difflib
from pathlib import Path

from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.outline import Outline
from tpcd.shape.sources import load_outlines
from tpcd.shape.ycb import load_ycb, ycb_folder


def find_outline(name: str, unit: str | None = None) -> Outline:
    """The outline of a file (in `unit`) or of a name; `ValueError` if there is none, or a name has
    a unit."""
    if Path(name).suffix:
        outlines = load_outlines(name, unit=unit)
        if len(outlines) != 1:
            raise ValueError(
                f"{name} holds {len(outlines)} outlines ({', '.join(list(outlines)[:6])}, …),"
                " expected one; save the one you mean to its own file"
            )
        return next(iter(outlines.values()))
    if unit is not None:
        raise ValueError(f"unit is {unit!r}, expected none for {name!r}, which is no file")
    outlines = builtin_outlines()
    if name not in outlines and ycb_folder() is not None:
        outlines = {**outlines, **load_ycb("all")}
    if name not in outlines:
        close = difflib.get_close_matches(name, outlines, 4, 0.4)
        raise ValueError(
            f"no outline {name!r}; did you mean {', '.join(close or sorted(outlines)[:6])}?"
            " Give a built-in name, a YCB name, or a file"
        )
    return outlines[name]
