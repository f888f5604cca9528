"""Pictures of a diagnosis: what was left before and after, evidence, the gap, theta."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tpcd.figures.style import SERIES, TRUTH, display_unit, legend_below, panels, title

BEFORE, AFTER = SERIES[1], SERIES[0]
SHOWN = 12
"""Candidates shown at most."""
_LIMIT = 6.0
"""Scores beyond this have the full colour."""

CellRow = tuple[str, str, float]
"""Contact mode, channel and score of a cell."""
Interval = tuple[float, float, float]
"""A value and the ends of its interval."""


def residual_map(
    before: Sequence[CellRow], after: Sequence[CellRow], rows: Sequence[tuple[str, int]]
) -> Figure:
    """Largest scores of residuals by contact mode and channel, before and after.

    `rows` are the contact modes with their numbers of transitions, from top to bottom.
    """
    channels = {"x": "x", "z": "z", "phi": "φ", "F_x": "$F_x$", "F_z": "$F_z$", "tau": "τ"}
    figure, axes = panels(1, 2, 4.6, 0.36 * len(rows) + 1.9)
    labels = [f"{mode} ({count})" for mode, count in rows]
    image = None
    for panel, cells, heading in zip(axes, (before, after), ("before", "after"), strict=True):
        scores = np.full((len(rows), len(channels)), np.nan)
        for mode, channel, score in cells:
            place = [name for name, _ in rows].index(mode)
            scores[place, list(channels).index(channel)] = score
        image = panel.imshow(scores, cmap="RdBu_r", vmin=-_LIMIT, vmax=_LIMIT, aspect="auto")
        for (i, j), value in np.ndenumerate(scores):
            if math.isfinite(value):
                dark = abs(value) > 0.6 * _LIMIT
                panel.text(
                    j, i, f"{value:+.1f}", ha="center", va="center", fontsize=8,
                    color="white" if dark else "black",
                )  # fmt: skip
        panel.set_xticks(range(len(channels)), list(channels.values()))
        panel.set_yticks(range(len(rows)), labels if panel is axes[0] else [""] * len(rows))
        panel.grid(False)
        title(panel, heading)
    assert image is not None
    figure.colorbar(image, ax=axes, label="largest score [sd]", shrink=0.9)
    return figure


def evidence_bars(
    names: Sequence[str], gains: Sequence[float], accepted: Sequence[bool], threshold: float
) -> Figure:
    """Gain of log evidence of the best candidates, one bar each."""
    order = np.argsort(gains)[::-1][:SHOWN]
    figure, (panel,) = panels(1, 1, 6.0, 0.3 * len(order) + 1.6)
    for place, i in enumerate(order):
        colour = AFTER if accepted[i] else "0.7"
        panel.barh(place, gains[i], color=colour)
        panel.text(max(gains[i], 0.0), place, f" {gains[i]:+.1f}", va="center", fontsize=8)
    panel.axvline(threshold, color=TRUTH, linestyle="--", linewidth=1.0)
    panel.set_yticks(range(len(order)), [names[i].replace("_", " ") for i in order])
    panel.invert_yaxis()
    panel.set_xscale("symlog", linthresh=10.0)
    panel.margins(x=0.15)
    panel.set_xlabel("gain of log evidence over the model before [nats]")
    entries = {
        "accepted": Line2D([], [], color=AFTER, linewidth=6),
        "not accepted": Line2D([], [], color="0.7", linewidth=6),
        "least gain": Line2D([], [], color=TRUTH, linestyle="--", linewidth=1.0),
    }
    legend_below(figure, entries, columns=3)
    return figure


def gap_bars(bars: Sequence[tuple[str, str, Interval, Interval, float]]) -> Figure:
    """Root mean square errors before and after, and what noise alone leaves.

    Each bar has the channel, its SI unit, the errors before and after, and the noise.
    """
    figure, axes = panels(1, len(bars), 1.5, 2.6)
    for panel, (channel, si_unit, before, after, noise) in zip(axes, bars, strict=True):
        factor, unit = display_unit(si_unit)
        value, low, high = factor * np.array([before, after]).T
        low, high = np.where(np.isfinite([low, high]), [low, high], value)  # too few rows
        ends = np.maximum([value - low, high - value], 0.0)
        panel.bar([0, 1], value, color=[BEFORE, AFTER], yerr=ends, ecolor="0.3", capsize=3)
        panel.axhline(factor * noise, color=TRUTH, linestyle="--", linewidth=1.0)
        panel.set_xticks([])
        panel.set_ylim(0, 1.15 * max(*high, factor * noise))
        title(panel, f"{channel} [{unit}]")
    entries = {
        "before": Line2D([], [], color=BEFORE, linewidth=6),
        "after": Line2D([], [], color=AFTER, linewidth=6),
        "90 % interval": Line2D([], [], color="0.3"),
        "sensor noise alone": Line2D([], [], color=TRUTH, linestyle="--", linewidth=1.0),
    }
    legend_below(figure, entries, columns=4)
    return figure


def worst_stretch(
    rows: np.ndarray, measured: np.ndarray, before: np.ndarray, after: np.ndarray, noise: np.ndarray
) -> Figure:
    """Prediction errors of the height and measured against predicted wrenches over n rows.

    Values (n, 4) of z [m], F_x [N], F_z [N] and tau [N·m], and the noise (4) of each.
    """
    names, units = ("error of z", "$F_x$", "$F_z$", "τ"), ("m", "N", "N", "N·m")
    figure, axes = panels(4, 1, 6.4, 1.5, share_x=True)
    for k, panel in enumerate(axes):
        factor, unit = display_unit(units[k])
        # Heights differ by far more than their errors.
        zero = measured[:, k] if k == 0 else np.zeros_like(measured[:, k])
        middle = measured[:, k] - zero
        band = 2 * noise[k]
        panel.fill_between(
            rows, factor * (middle - band), factor * (middle + band), color="0.85", linewidth=0
        )
        panel.plot(rows, factor * middle, color=TRUTH, linewidth=1.0)
        for values, colour, marker in ((before, BEFORE, "o"), (after, AFTER, ".")):
            panel.plot(
                rows, factor * (values[:, k] - zero), color=colour, marker=marker, linewidth=0
            )
        panel.set_ylabel(f"{names[k]} [{unit}]")
    figure.align_ylabels(axes)
    axes[-1].set_xlabel("row")
    axes[-1].locator_params(axis="x", integer=True)
    entries = {
        "measured, ± 2 sd of the noise": (Patch(color="0.85"), Line2D([], [], color=TRUTH)),
        "predicted before": Line2D([], [], color=BEFORE, marker="o", linewidth=0),
        "predicted after": Line2D([], [], color=AFTER, marker=".", linewidth=0),
    }
    legend_below(figure, entries, columns=3)
    return figure


def theta_shift(
    names: Sequence[str],
    before: Sequence[tuple[float, float]],
    after: Sequence[tuple[float, float]],
) -> Figure:
    """How every entry of theta moved, in standard deviations of the model found."""
    figure, (panel,) = panels(1, 1, 6.0, 0.3 * len(names) + 1.5)
    for place, ((was, was_sd), (now, now_sd)) in enumerate(zip(before, after, strict=True)):
        unit = now_sd if now_sd > 0 else 1.0
        panel.errorbar(
            (was - now) / unit, place - 0.15, xerr=1.645 * was_sd / unit, color=BEFORE, fmt="o"
        )
        panel.errorbar(0.0, place + 0.15, xerr=1.645 * now_sd / unit, color=AFTER, fmt="o")
    panel.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    panel.invert_yaxis()
    panel.set_xlabel("difference from the model found [its standard deviations]; bars 90 %")
    entries = {
        "before": Line2D([], [], color=BEFORE, marker="o"),
        "after": Line2D([], [], color=AFTER, marker="o"),
    }
    legend_below(figure, entries)
    return figure
