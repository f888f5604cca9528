"""What has been learnt about the parameters, step by step.

One panel for each parameter: the mean of the belief, its 90 % band, and the truth where it
is known. The axis is as wide as the widest band, so the prior at step 0 shows how much
each step has taught.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from tpcd.figures.style import BELIEF, TRUTH, Array, axis_label, display_unit, legend_below, panels


def estimation_progress(
    steps: Shaped[Array, " n"],
    mean: Float[Array, "n d"],
    low: Float[Array, "n d"],
    high: Float[Array, "n d"],
    names: Sequence[str],
    units: Sequence[str],
    truth: Float[Array, " d"] | None = None,
    closed: bool = False,
) -> Figure:
    """Draw mean and band [low, high] of d parameters over n steps, in SI units.

    `names` and `units` are those of `tpcd.parameters` for the chosen columns; where `truth` is
    NaN it is not drawn. `closed` marks the last step as that of the closing draws. Raises
    `ValueError` when the number of names or units is not d.
    """
    steps, mean, low, high = (np.asarray(value) for value in (steps, mean, low, high))
    if not len(names) == len(units) == mean.shape[1]:
        raise ValueError(
            f"{len(names)} names and {len(units)} units for {mean.shape[1]} parameters"
        )
    columns = _columns(len(names))
    rows = math.ceil(len(names) / columns)
    figure, axes = panels(rows, columns, 2.9, 2.1)
    handles: dict[str, Artist] = {}
    for i, (panel, name, unit) in enumerate(zip(axes, names, units, strict=False)):
        factor, _ = display_unit(unit)
        band = panel.fill_between(
            steps, factor * low[:, i], factor * high[:, i], color=BELIEF, alpha=0.25, linewidth=0
        )
        (line,) = panel.plot(steps, factor * mean[:, i], color=BELIEF, linewidth=1.8)
        handles |= {"mean of the belief": line, "90 % interval": band}
        if closed:
            last = (steps[-1:], factor * mean[-1:, i])
            (mark,) = panel.plot(*last, "o", color=BELIEF, markersize=5, clip_on=False)
            handles["from the closing draws"] = mark
        value = math.nan if truth is None else factor * float(np.asarray(truth)[i])
        if math.isfinite(value):
            handles["truth"] = panel.axhline(value, color=TRUTH, linestyle="--", linewidth=1.2)
        panel.set_ylabel(axis_label(name, unit))
        panel.set_xlabel("step")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        panel.margins(x=0)
    for panel in axes[len(names) :]:
        panel.remove()
    legend_below(figure, handles)
    return figure


def _columns(count: int) -> int:
    """Three or four panels in a row, whichever leaves fewer places empty."""
    return count if count <= 3 else min((3, 4), key=lambda columns: (-count % columns, -columns))
