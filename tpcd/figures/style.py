"""How all figures look: panels without global state, colours, units for reading.

Figures are made with matplotlib's objects (`Figure`, `Axes`), never with pyplot, so that
drawing in one place cannot change another. Lengths are shown in millimetres and angles in
degrees; everything else stays in SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.container import Container
from matplotlib.figure import Figure
from torch import Tensor

Array = np.ndarray | Tensor
"""What figures take: NumPy arrays, or tensors on the CPU without gradients."""

LegendKey = Artist | Container | tuple[Artist, ...]
"""What a legend can show beside a text."""

BELIEF = "#0072B2"
TRUTH = "#000000"
FLOOR = "#8C6D46"
WALL = "#5F6B73"
FORCE = "#009E73"
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours that stay apart for colour-blind readers (Okabe and Ito 2008)."""

DOTS_PER_INCH = 150

TEXT = 9.0
"""Size of labels in points; ticks are one smaller, headings two larger."""

_DISPLAY = {"m": (1e3, "mm"), "rad": (180.0 / math.pi, "°"), "1": (1.0, ""), "": (1.0, "")}


def display_unit(unit: str) -> tuple[float, str]:
    """Factor and name of the unit in which an SI unit is shown: m as mm, rad as degrees."""
    return _DISPLAY.get(unit, (1.0, unit))


def axis_label(name: str, unit: str) -> str:
    """A readable axis label with the unit it is shown in: `floor height [mm]`."""
    shown = display_unit(unit)[1]
    words = name if "$" in name else name.replace("_", " ")  # $F_x$ keeps its subscript
    return f"{words} [{shown}]" if shown else f"{words} [–]"


def panels(
    rows: int, columns: int, width: float, height: float, *, share_x: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure with `rows` × `columns` panels of the given size each [inches], row by row."""
    figure = Figure((width * columns, height * rows), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=share_x, squeeze=False).ravel().tolist()
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(True, color="0.9", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.tick_params(labelsize=TEXT - 1)
        panel.xaxis.label.set_size(TEXT)
        panel.yaxis.label.set_size(TEXT)
    return figure, axes


def title(panel: Axes, text: str) -> None:
    """Set the title of a panel in the common size, flush left."""
    panel.set_title(text, fontsize=TEXT, loc="left")


def legend_below(figure: Figure, entries: Mapping[str, LegendKey], columns: int = 4) -> None:
    """One legend for the whole figure, under its panels, where it hides no data."""
    figure.legend(
        cast(Any, list(entries.values())),  # tuples are keys drawn over each other
        list(entries),
        loc="outside lower center",
        ncols=min(len(entries), columns),
        fontsize=TEXT,
        frameon=False,
    )
