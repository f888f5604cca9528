"""Pictures of the benchmarks: seconds by solver and size, and the cost of a filter step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from tpcd.figures.style import SERIES, TRUTH, LegendKey, legend_below, panels, title

MARKERS = "osD^vP*X"
Rows = Sequence[Mapping[str, Any]]


def solver_seconds(table: Rows, problems: int, clock: str) -> Figure:
    """Seconds each contact solver takes for `problems` problems, over their number of rows.

    `table` has the columns `solver`, `rows`, `seconds` and `wrong`; lines of several sizes
    together (`rows` 'all') are left out. A solver with wrong answers is drawn dashed.
    """
    own = [line for line in table if line["rows"] != "all"]
    figure, (panel,) = panels(1, 1, 6.0, 4.2)
    entries: dict[str, LegendKey] = {}
    # From the slowest to the fastest, as the lines lie above each other.
    total: dict[str, float] = {}
    for line in own:
        total[line["solver"]] = total.get(line["solver"], 0.0) + line["seconds"]
    for i, solver in enumerate(sorted(total, key=total.__getitem__, reverse=True)):
        lines = [line for line in own if line["solver"] == solver]
        wrong = sum(line["wrong"] for line in lines)
        (drawn,) = panel.plot(
            [line["rows"] for line in lines],
            [line["seconds"] for line in lines],
            color=SERIES[i % len(SERIES)],
            marker=MARKERS[i % len(MARKERS)],
            linestyle="--" if wrong else "-",
        )
        entries[f"{solver} ({wrong} wrong)" if wrong else solver] = drawn
    panel.set_yscale("log")
    panel.set_xticks(sorted({line["rows"] for line in own}))
    panel.set_xlabel("rows of a problem, two for each contact [–]")
    panel.set_ylabel(f"{clock} time for {problems:,} problems [s]")
    title(panel, "lower is faster; dashed: some claimed solutions are wrong")
    legend_below(figure, entries, columns=3)
    return figure


def step_seconds(table: Rows, target: tuple[int, float] | None = None) -> Figure:
    """Wall and CPU seconds of a filter step over its number of particles.

    `table` holds the rows of the curve with `particles`, `wall_s` and `cpu_s`; `target` is
    a number of particles and the wall seconds [s] they should stay below.
    """
    rows = sorted(table, key=lambda row: row["particles"])
    figure, (panel,) = panels(1, 1, 5.2, 4.0)
    sizes = [row["particles"] for row in rows]
    entries: dict[str, LegendKey] = {}
    for i, (key, name) in enumerate((("wall_s", "wall time"), ("cpu_s", "CPU time, all threads"))):
        (entries[name],) = panel.plot(
            sizes, [row[key] for row in rows], color=SERIES[i], marker=MARKERS[i]
        )
    if target is not None and sizes[0] <= target[0] <= sizes[-1]:
        panel.plot(*target, marker="_", markersize=16, markeredgewidth=2.0, color=TRUTH)
        entries[f"target, wall: {target[1]:g} s at {target[0]:,}"] = Line2D(
            [], [], color=TRUTH, marker="_", linestyle="", markersize=12, markeredgewidth=2.0
        )
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xticks(sizes, [f"{size:,}" for size in sizes], rotation=30)
    panel.minorticks_off()
    panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    panel.yaxis.set_major_formatter("{x:g}")
    panel.set_xlabel("particles [–]")
    panel.set_ylabel("time of one filter step [s]")
    title(panel, f"cost of a filter step, {rows[0]['transitions'] // sizes[0]} transitions each")
    legend_below(figure, entries, columns=2)
    return figure


def part_seconds(table: Rows) -> Figure:
    """Wall seconds of each part of a filter step as horizontal bars, in the table's order."""
    figure, (panel,) = panels(1, 1, 6.0, 1.0 + 0.3 * len(table))
    names = [row["part"] for row in table]
    bars = panel.barh(names, [row["wall_s"] for row in table], color=SERIES[0], height=0.7)
    panel.bar_label(bars, [f"{row['wall_s']:.3g} s" for row in table], padding=3, fontsize=8)
    panel.invert_yaxis()
    panel.margins(x=0.15)
    panel.grid(False, axis="y")
    panel.set_xlabel("wall time [s]")
    title(panel, f"{table[0]['particles']:,} particles, {table[0]['transitions']:,} transitions")
    return figure


def growth(table: Rows, axis: str, targets: Mapping[int, float]) -> Figure:
    """Wall seconds of choosing a command over the number of particles or commands.

    `table` has the columns `axis` and `wall_s`; `targets` are seconds by the value of `axis`.
    """
    rows = sorted(table, key=lambda row: row[axis])
    figure, (panel,) = panels(1, 1, 5.2, 3.8)
    entries: dict[str, LegendKey] = {}
    values = [row[axis] for row in rows]
    (entries["Algorithm 2"],) = panel.plot(
        values, [row["wall_s"] for row in rows], color=SERIES[0], marker="o"
    )
    if targets:
        (entries["target"],) = panel.plot(
            list(targets), list(targets.values()), "v", color=TRUTH, linestyle="none"
        )
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xticks(values, [str(value) for value in values])
    panel.minorticks_off()
    panel.set_xlabel(f"{axis} [–]")
    panel.set_ylabel("wall time of a choice [s]")
    legend_below(figure, entries)
    return figure
