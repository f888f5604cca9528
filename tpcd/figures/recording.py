"""A recording over time, as it was made: every channel with what was found in it, and its clocks.

A million samples are drawn as the band between their least and largest value in each of some
hundred moments, so that a single spike still shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from tpcd.figures.style import (
    BELIEF,
    SERIES,
    TEXT,
    LegendKey,
    axis_label,
    display_unit,
    legend_below,
    panels,
    title,
)

MOMENTS = 600
"""Moments that samples are drawn in; a panel has hardly more points."""
LINE = 3000
"""Up to so many samples are drawn one by one."""
KINDS = {
    "frozen": SERIES[1],
    "clipped": SERIES[3],
    "spike": "#000000",
    "gap": SERIES[4],
    "jump": SERIES[2],
}
"""Colours of what is marked."""
OTHER_KIND = "0.5"


@dataclass(frozen=True, eq=False)
class Trace:
    """One channel over time."""

    name: str
    unit: str
    """SI."""
    times: Float[np.ndarray, " n"]
    """[s]"""
    values: Float[np.ndarray, " n"]
    heading: str
    """What to see."""
    marks: Sequence[tuple[str, float, float]] = ()
    """Kind, begin and end [s] of what was found."""
    beside: tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]] | None = None
    """Times and values of the set point."""


def channels_over_time(traces: Sequence[Trace], heading: str) -> Figure:
    """Draw channels one under the other, with what was found in them marked."""
    columns = 1 if len(traces) < 4 else 2
    rows = -(-len(traces) // columns)
    figure, axes = panels(rows, columns, 5.6, 1.7, share_x=True)
    entries: dict[str, LegendKey] = {}
    for panel, trace in zip(axes, traces, strict=False):
        factor, _ = display_unit(trace.unit)
        if trace.beside is not None:
            draw_samples(panel, trace.beside[0], factor * trace.beside[1], SERIES[4], 0.9)
            entries["set point"] = Patch(color=SERIES[4])
        draw_samples(panel, trace.times, factor * trace.values, BELIEF, 0.7)
        entries["recorded"] = Patch(color=BELIEF)
        for kind, start, end in trace.marks:
            colour = KINDS.get(kind, OTHER_KIND)
            panel.axvspan(start, end, color=colour, alpha=0.35, linewidth=0.8, zorder=0.5)
            entries[kind.replace("_", " ")] = Patch(color=colour, alpha=0.5)
        panel.set_ylabel(axis_label(_label(trace.name), trace.unit))
        title(panel, trace.heading)
    for panel in axes[len(traces) :]:
        panel.set_visible(False)
    for panel in axes[max(0, len(traces) - columns) : len(traces)]:
        panel.set_xlabel("time [s]", fontsize=TEXT)
        panel.tick_params(labelbottom=True)
    figure.suptitle(heading, fontsize=TEXT + 2)
    legend_below(figure, entries, 6)
    return figure


def clocks_over_time(
    clocks: Mapping[str, Float[np.ndarray, " n"]],
    marks: Mapping[str, Sequence[tuple[str, float, float]]],
    headings: Mapping[str, str],
) -> Figure:
    """Draw the time from each sample to the next of every stream [s], which is level where the
    clock is even."""
    figure, axes = panels(len(clocks), 1, 8.0, 1.8, share_x=True)
    entries: dict[str, LegendKey] = {}
    for panel, (name, times) in zip(axes, clocks.items(), strict=True):
        spacing = 1e3 * np.diff(times)
        draw_samples(panel, times[1:], spacing, BELIEF, 0.7)
        for kind, start, end in marks.get(name, ()):
            colour = KINDS.get(kind, OTHER_KIND)
            panel.axvspan(start, end, color=colour, alpha=0.35, linewidth=0.8, zorder=0.5)
            entries[kind.replace("_", " ")] = Patch(color=colour, alpha=0.5)
        usual = float(np.median(spacing)) if len(spacing) else 1.0
        if len(spacing) and spacing.min() > 0 and spacing.max() > 20 * usual > 0:
            panel.set_yscale("log")
        elif len(spacing):
            panel.set_ylim(min(0.0, 1.1 * float(spacing.min())), 1.2 * float(spacing.max()))
        panel.set_ylabel("to the next [ms]", fontsize=TEXT)
        title(panel, headings.get(name, name))
    axes[-1].set_xlabel("time [s]", fontsize=TEXT)
    figure.suptitle("Clocks: the time from sample to sample should be level", fontsize=TEXT + 2)
    if entries:
        legend_below(figure, entries, 6)
    return figure


def draw_samples(
    panel: Axes,
    times: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    colour: str,
    width: float,
) -> None:
    """A line, or the band between the least and largest of many samples."""
    if len(times) <= LINE:
        panel.plot(times, values, color=colour, linewidth=width)
        return
    middle, low, high = envelope(times, values)
    panel.fill_between(middle, low, high, color=colour, linewidth=width, alpha=0.9)


def envelope(
    times: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Time, least and largest value of samples in about `MOMENTS` moments of as many samples.

    Moments without a number are left out.
    """
    size = -(-len(values) // MOMENTS)
    edges = np.arange(0, len(values), size)
    known = np.isfinite(values)
    low = np.minimum.reduceat(np.where(known, values, np.inf), edges)
    high = np.maximum.reduceat(np.where(known, values, -np.inf), edges)
    kept = low <= high
    return times[edges][kept], low[kept], high[kept]


def _label(name: str) -> str:
    """A channel as it is written: F_x with its subscript, phi as its letter."""
    if name in ("phi", "tau"):
        return {"phi": "φ", "tau": "τ"}[name]
    letter, _, axis = name.partition("_")
    return f"${letter}_{{{axis}}}$" if axis else name
