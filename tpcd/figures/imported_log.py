"""What an import took from a recording: samples, settled rows, and what the plane leaves out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from tpcd.figures.predictions import CHANNEL_UNITS
from tpcd.figures.style import (
    BELIEF,
    SERIES,
    TEXT,
    TRUTH,
    LegendKey,
    axis_label,
    display_unit,
    legend_below,
    panels,
    title,
)

MOST_POINTS = 4000
"""Samples drawn at most; a line of more shows nothing more."""
_LABELS = ("x", "z", "φ", "$F_x$", "$F_z$", "τ")


def imported_log(
    times: Float[np.ndarray, " n"],
    samples: Float[np.ndarray, "n 6"],
    commands: Float[np.ndarray, "n 3"] | None,
    row_times: Float[np.ndarray, "k 2"],
    rows: Float[np.ndarray, "k 6"],
    spring: Float[np.ndarray, "k 3"],
    motion_left_out: Float[np.ndarray, "n 2"],
    wrench_left_out: Float[np.ndarray, "n 3"],
    heading: str = "",
    left_out: Sequence[tuple[float, float]] = (),
) -> Figure:
    """Draw pose and wrench over time [s], wrench against K (x - u), and what is left out.

    `samples` and `rows` are x, z, phi [m, m, rad], F_x, F_z, tau [N, N, N·m]; `row_times` begin and
    end of each row's stretch; `spring` K (x - u) of the rows, NaN without commands; left out are
    motion [m], rotation [rad], force [N] and torque [N·m]. Times that make no row, from `left_out`
    [s], are grey.
    """
    thin = slice(None, None, max(1, len(times) // MOST_POINTS))
    held = commands is not None
    figure, axes = panels(4 if held else 3, 3, 3.5, 1.9)
    entries: dict[str, LegendKey] = {}
    for i, panel in enumerate(axes[:6]):
        factor, _ = display_unit(CHANNEL_UNITS[i])
        (line,) = panel.plot(times[thin], factor * samples[thin, i], color=BELIEF, linewidth=0.8)
        entries["recorded"] = line
        if i < 3 and held:
            (dashed,) = panel.plot(
                times[thin],
                factor * commands[thin, i],
                color=SERIES[1],
                linewidth=0.9,
                dashes=(4, 2),
            )
            entries["set point"] = dashed
        level = factor * rows[:, i]
        (bars,) = panel.plot(row_times.T, np.stack((level, level)), color=TRUTH, linewidth=3)[:1]
        entries["settled rows" if held else "means"] = bars
        for start, end in left_out:
            entries["left out"] = panel.axvspan(
                max(start, times[0]), min(end, times[-1]), color="0.85", linewidth=0, zorder=0
            )
        panel.set_ylabel(axis_label(_LABELS[i], CHANNEL_UNITS[i]))
    for i, panel in enumerate(axes[6:9] if held else (), start=3):
        low, high = float(spring[:, i - 3].min()), float(spring[:, i - 3].max())
        panel.plot((low, high), (low, high), color="0.6", linewidth=0.9)
        panel.plot(spring[:, i - 3], rows[:, i], "o", color=TRUTH, markersize=3)
        panel.set_xlabel(f"K (x − u) [{CHANNEL_UNITS[i]}]", fontsize=TEXT)
        panel.set_ylabel(axis_label(_LABELS[i], CHANNEL_UNITS[i]))
        title(panel, "rows should lie on the line" if i == 3 else "")
    outside = (
        ("motion", "m", motion_left_out[:, 0], 1e-4),
        ("rotation", "rad", motion_left_out[:, 1], 1e-3),
        ("force", "N", wrench_left_out[:, 0], 0.1),
    )
    for panel, (name, unit, values, least) in zip(axes[-3:], outside, strict=True):
        factor, _ = display_unit(unit)
        panel.plot(times[thin], factor * values[thin], color=SERIES[3], linewidth=0.8)
        low, high = min(values.min(), -least), max(values.max(), least)
        panel.set_ylim(1.1 * factor * low, 1.1 * factor * high)
        panel.set_ylabel(axis_label(name, unit))
        panel.set_xlabel("time [s]")
        title(panel, f"{name} out of the plane, left out")
    if heading:
        figure.suptitle(heading, fontsize=TEXT + 2)
    legend_below(figure, entries)
    return figure
