"""The YCB objects that an evaluation asks for."""

from __future__ import annotations

from collections.abc import Sequence

from tpcd.shape.outline import Outline
from tpcd.shape.ycb import load_ycb


def main_outlines(asked: Sequence[str]) -> dict[str, Outline]:
    """The main outline of every YCB object by name; `ValueError` where one is asked for that is
    not among them."""
    known = load_ycb("main")
    for name in asked:
        if name not in known:
            raise ValueError(f"object is {name!r}, expected one of {', '.join(sorted(known))}")
    return known
