"""How often effects are found against their size, and how honest sizes and stated limits are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.stats import norm

from eval.blind.score import Score, rate, share_interval
from eval.blind.suites import SUITES
from tpcd.figures.quality import calibration
from tpcd.figures.style import SERIES, TRUTH, legend_below, panels, title

SIZES = (0.25, 0.35, 0.5, 0.9, 1.1, 1.3)
"""Ends of bins of sizes relative to the medium one."""
LIMITS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, math.inf)
"""Ends of bins of sizes relative to the detection limit that the report states."""
SHOWN_ENDS = (0.25, 32.0)
"""Where open bins end in the figure."""
BY_SIZE = ("small", "medium")
"""Suites that differ in nothing but the size."""


def single_effects(scores: Sequence[Score]) -> list[Score]:
    """Cases of one effect of the catalogue, by the whole workflow."""
    return [s for s in whole_workflow(scores) if math.isfinite(s.size)]


def whole_workflow(scores: Sequence[Score]) -> list[Score]:
    """Those of suites in which nothing is switched off."""
    return [s for s in scores if not SUITES[s.suite].without]


def detection_table(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Share named exactly by size: relative to medium in the suites that differ in nothing else,
    and relative to the limit that the report states in all."""
    chosen = single_effects(scores)
    alike = [s for s in chosen if s.suite in BY_SIZE]
    rows = _binned(alike, "medium", SIZES, lambda s: s.size)
    rows += _binned(chosen, "limit stated", LIMITS, lambda s: s.over_limit)
    return [
        {
            "size relative to": what,
            "from": low,
            "to": high,
            "runs": runs,
            "exact": count / runs,
            "90 %": "{:.2f}-{:.2f}".format(*share_interval(count, runs)),
            "of them nothing named": nothing / runs,
        }
        for what, low, high, count, nothing, runs in rows
    ]


def detection_figure(scores: Sequence[Score]) -> Figure | None:
    """The share named exactly against size, with 90 % intervals; None without single effects."""
    chosen = single_effects(scores)
    if not chosen:
        return None
    figure, axes = panels(1, 2, 4.2, 3.2)
    alike = [s for s in chosen if s.suite in BY_SIZE]
    sizes = ("size of the effect relative to medium", alike, SIZES, lambda s: s.size)
    limits = ("size relative to the detection limit stated", chosen, LIMITS, lambda s: s.over_limit)
    for panel, (label, some, ends, value) in zip(axes, (sizes, limits), strict=True):
        for _, low, high, count, _, runs in _binned(some, "", ends, value):
            low, high = max(low, SHOWN_ENDS[0]), min(high, SHOWN_ENDS[1])
            share, between = count / runs, share_interval(count, runs)
            panel.plot([low, high], [share, share], color=SERIES[0], linewidth=2)
            middle = math.sqrt(low * high)
            panel.plot([middle, middle], between, color=SERIES[0], linewidth=1)
            panel.annotate(
                str(runs), (middle, share), (3, 3), textcoords="offset points", fontsize=7
            )
        panel.set_xscale("log")
        ticks = [end for end in ends if SHOWN_ENDS[0] <= end <= SHOWN_ENDS[1]]
        panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        panel.set_xticks([], minor=True)
        panel.set_ylim(-0.03, 1.08)
        panel.set_xlabel(label)
    axes[1].axvline(1.0, color=TRUTH, linestyle="--", linewidth=1.0)
    axes[0].set_ylabel("share named exactly")
    title(axes[0], f"suites small and medium ({len(alike)} cases)")
    title(axes[1], f"all suites ({len(chosen)} cases)")
    entries = {
        "share, with the number of cases": Line2D([], [], color=SERIES[0], linewidth=2),
        "90 % interval": Line2D([], [], color=SERIES[0], linewidth=1),
        "limit": Line2D([], [], color=TRUTH, linestyle="--", linewidth=1.0),
    }
    legend_below(figure, entries, columns=3)
    return figure


def size_calibration(scores: Sequence[Score]) -> Figure | None:
    """Coverage of the intervals of effect sizes, as normal ones, where the effects are exact."""
    deviations = np.array([one for s in whole_workflow(scores) for one in s.size_scores])
    deviations = deviations[np.isfinite(deviations)]
    if not len(deviations):
        return None
    return calibration(norm.cdf(deviations)[:, None], ["normal intervals"], "sizes")


def _binned(
    scores: Sequence[Score], what: str, ends: Sequence[float], value: Callable[[Score], float]
) -> list[tuple[str, float, float, int, int, int]]:
    """Bins that are not empty: ends, how many are exact, nothing and all."""
    rows = []
    for low, high in zip(ends, ends[1:], strict=False):
        inside = [s for s in scores if low <= value(s) < high]
        if inside:
            nothing = rate(inside, lambda s: not s.names)[0]
            rows.append(
                (what, low, high, *rate(inside, lambda s: s.is_exact)[:1], nothing, len(inside))
            )
    return rows
