"""How good predictions are: calibration of their intervals, errors of many objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from scipy.stats import binom

from tpcd.figures.style import SERIES, TRUTH, Array, LegendKey, legend_below, panels, title


def calibration(
    probability_transform: Float[Array, "n c"],
    names: Sequence[str],
    values: str = "rows",
    samples: int | None = None,
) -> Figure:
    """Draw observed against nominal coverage of central intervals for c channels.

    `probability_transform` holds F(y), the predicted distribution function at each of the
    n observed values, in [0, 1]; it is uniform where predictions are calibrated. The grey
    band holds 90 % of the curves of a calibrated prediction from `samples` independent
    values (default n). `values` says what the n are. Raises `ValueError` when the number of names
    is not c.
    """
    transform = np.asarray(probability_transform, dtype=float)
    if len(names) != transform.shape[1]:
        raise ValueError(f"{len(names)} names for {transform.shape[1]} channels")
    levels = np.linspace(0.0, 1.0, 101)
    observed = central_coverage(transform, levels)
    count = samples or len(transform)
    figure, (panel,) = panels(1, 1, 4.6, 4.4)
    band = panel.fill_between(
        100 * levels,
        100 * binom.ppf(0.05, count, levels) / count,
        100 * binom.ppf(0.95, count, levels) / count,
        color="0.85",
        linewidth=0,
    )
    (ideal,) = panel.plot([0, 100], [0, 100], color=TRUTH, linestyle="--", linewidth=1.0)
    entries: dict[str, LegendKey] = {}
    for k, (sharing, curve) in enumerate(_distinct(names, observed)):
        (line,) = panel.plot(100 * levels, 100 * curve, color=SERIES[k % len(SERIES)])
        entries[f"{', '.join(sharing)} ({100 * curve[90]:.0f} % in 90 %)"] = line
    panel.set_xlim(0, 100)
    panel.set_ylim(0, 100)
    panel.set_aspect("equal")
    panel.set_xlabel("nominal level of the interval [%]")
    panel.set_ylabel("values observed inside [%]")
    title(panel, f"below: too sure; above: not enough ({count} {values})")
    legend_below(figure, entries | {"calibrated": ideal, "90 % by chance": band}, columns=2)
    return figure


def _distinct(
    names: Sequence[str], curves: Float[np.ndarray, "k c"]
) -> list[tuple[list[str], Float[np.ndarray, " k"]]]:
    """Each different curve with the names that share it, as pose and force do (F = K (x - u))."""
    found: list[tuple[list[str], np.ndarray]] = []
    for name, curve in zip(names, curves.T, strict=True):
        same = next((shared for shared, other in found if np.array_equal(curve, other)), None)
        if same is None:
            found.append(([name], curve))
        else:
            same.append(name)
    return found


def central_coverage(
    transform: Float[Array, "n c"], levels: Float[Array, " k"]
) -> Float[np.ndarray, "k c"]:
    """Share of values F(y) inside the central interval of each nominal level."""
    distance = 2 * np.abs(np.asarray(transform) - 0.5)
    return (distance[None] <= np.asarray(levels)[:, None, None]).mean(axis=1)


def error_bars(
    table: Sequence[Mapping[str, Any]],
    values: Mapping[str, str],
    *,
    label: str = "object",
    group: str | None = None,
    targets: Mapping[str, float] | None = None,
    colours: Mapping[str, str] | None = None,
) -> Figure:
    """Draw errors of many objects as horizontal bars, one panel for each kind of error.

    `table` has one mapping for each object; `values` maps its columns to axis labels with
    units (`{"x_mm": "error of x [mm]"}`); `label` names the column with the object's name,
    `group` one that tells bars apart by colour (the prior); `targets` adds a line for a
    column; `colours` may give the groups colours of their own. Objects are ordered by the first
    column. Missing values leave a gap.
    """
    if not table or not values:
        raise ValueError("nothing to draw: the table or the choice of columns is empty")
    groups = list(dict.fromkeys(str(row[group]) for row in table)) if group else [""]
    first = next(iter(values))
    worst: dict[str, float] = {}
    for row in table:
        value = row.get(first)
        worst[str(row[label])] = max(
            worst.get(str(row[label]), -np.inf), -np.inf if value is None else float(value)
        )
    objects = sorted(worst, key=worst.__getitem__)
    height = 0.8 / len(groups)
    figure, axes = panels(
        1, len(values), max(2.2, 9.5 / len(values)), 1.0 + 0.24 * len(objects) * max(1, len(groups))
    )
    entries: dict[str, LegendKey] = {}
    for column, (panel, (key, text)) in enumerate(zip(axes, values.items(), strict=True)):
        for i, name in enumerate(groups):
            chosen = {
                str(row[label]): row.get(key)
                for row in table
                if not group or str(row[group]) == name
            }
            lengths = np.array([chosen.get(entry) for entry in objects], dtype=float)
            offset = (i - (len(groups) - 1) / 2) * height
            colour = colours[name] if colours else SERIES[i % 6]
            places = np.arange(len(objects)) - offset
            entries[name] = panel.barh(places, lengths, 0.9 * height, color=colour)
        if targets and key in targets:
            panel.axvline(targets[key], color=TRUTH, linestyle="--", linewidth=1.2)
            entries["target"] = Line2D([], [], color=TRUTH, linestyle="--", linewidth=1.2)
        panel.set_xlabel(text)
        panel.xaxis.set_major_locator(MaxNLocator(4))
        panel.set_yticks(np.arange(len(objects)), objects if column == 0 else [])
        panel.set_ylim(-0.6, len(objects) - 0.4)
        panel.grid(False, axis="y")
    entries.pop("", None)
    if entries:
        legend_below(figure, entries)
    return figure
