"""Predicted poses and wrenches against what was measured, channel by channel."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from tpcd.figures.style import (
    BELIEF,
    TEXT,
    TRUTH,
    Array,
    LegendKey,
    axis_label,
    display_unit,
    legend_below,
    panels,
    title,
)

CHANNELS = ("x", "z", "φ", "F_x", "F_z", "τ")
CHANNEL_UNITS = ("m", "m", "rad", "N", "N", "N·m")
_LABELS = ("x", "z", "φ", "$F_x$", "$F_z$", "τ")


def prediction(
    rows: Float[Array, "n 6"],
    mean: Float[Array, "n 6"],
    low: Float[Array, "n 6"],
    high: Float[Array, "n 6"],
    heading: str = "",
    *,
    first_step: int = 1,
    rows_are: str = "measured",
) -> Figure:
    """Draw six panels x, z, φ [m, m, rad] and F_x, F_z, τ [N, N, N·m] over n steps.

    `rows` are the true or measured values (named by `rows_are`), [low, high] the 90 %
    interval of the prediction. Each panel says its mean absolute error and how many of
    the rows lie in the interval.
    """
    rows, mean, low, high = (np.asarray(value, dtype=float) for value in (rows, mean, low, high))
    steps = np.arange(first_step, first_step + len(rows))
    figure, axes = panels(2, 3, 3.3, 2.2, share_x=True)
    entries: dict[str, LegendKey] = {}
    for i, panel in enumerate(axes):
        factor, unit = display_unit(CHANNEL_UNITS[i])
        band = panel.fill_between(
            steps, factor * low[:, i], factor * high[:, i], color=BELIEF, alpha=0.25, linewidth=0
        )
        (line,) = panel.plot(steps, factor * mean[:, i], color=BELIEF, linewidth=1.4)
        (dots,) = panel.plot(steps, factor * rows[:, i], "o", color=TRUTH, markersize=3)
        entries = {"predicted mean": line, "predicted 90 % interval": band, rows_are: dots}
        error = factor * np.abs(rows[:, i] - mean[:, i]).mean()
        inside = int(((rows[:, i] >= low[:, i]) & (rows[:, i] <= high[:, i])).sum())
        title(panel, f"mean error {error:.2g} {unit}, {inside} of {len(rows)} inside")
        panel.set_ylabel(axis_label(_LABELS[i], CHANNEL_UNITS[i]))
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        if i >= 3:
            panel.set_xlabel("step")
    if heading:
        figure.suptitle(heading, fontsize=TEXT + 2)
    legend_below(figure, entries)
    return figure
