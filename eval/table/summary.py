"""What the cells of the table say together: means, bootstrap intervals, paired comparisons.

Intervals are 90 % bootstrap intervals over objects: whole objects are drawn with replacement,
since seeds of one object resemble each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

DRAWS = 2000
CHANNELS = ("x", "z", "phi", "F_x", "F_z", "tau")
UNITS = ("mm", "mm", "mrad", "N", "N", "Nm")
FACTORS = np.array([1e3, 1e3, 1e3, 1.0, 1.0, 1.0])

Row = dict[str, Any]


def label(row: Row) -> str:
    """Name of a cell's row in the table."""
    return f"{row['estimator']} / {row['policy']}"


def summarise(cells: Sequence[Row]) -> list[Row]:
    """One row for each truth, estimator and policy, from the cells' last tests."""
    table = []
    for truth, name in _order(cells):
        chosen = [row for row in cells if row["truth"] == truth and label(row) == name]
        errors = np.array([row["mae"][-1] for row in chosen]) * FACTORS
        spread = np.array([row["sd"][-1] for row in chosen]) * FACTORS
        peak = np.array([row["peak_wrench"] for row in chosen])
        line: Row = {"truth": truth, "row": name, "cells": len(chosen)}
        for i, (channel, unit) in enumerate(zip(CHANNELS, UNITS, strict=True)):
            line[f"{channel}_{unit}"] = float(errors[:, i].mean())
            line[f"{channel}_sd"] = float(spread[:, i].mean())
        objects = [row["object"] for row in chosen]
        low, high = bootstrap(errors[:, :2].mean(-1), objects, np.mean)
        line["xz_low"], line["xz_high"] = low, high
        relative = errors[:, 3:5] / peak[:, :2]
        line["force_of_peak"] = float(relative.mean())
        for key in ("coverage_50", "coverage_90", "contact_90"):
            line[key] = float(np.mean([row[key][-1] for row in chosen]))
        line["choosing_s"] = float(np.mean([row["choosing_s"] for row in chosen]))
        line["learning_s"] = float(np.mean([row["learning_s"] for row in chosen]))
        line["closing_s"] = float(np.mean([row["closing_s"] for row in chosen]))
        table.append(line)
    return table


def printed(line: Row) -> Row:
    """A row of the table as people read it: mean absolute error ± its deviation over steps."""
    shown: Row = {key: line[key] for key in ("truth", "row", "cells")}
    for channel, unit in zip(CHANNELS, UNITS, strict=True):
        error, spread = line[f"{channel}_{unit}"], line[f"{channel}_sd"]
        shown[f"{channel} [{unit}]"] = f"{error:.3f} ± {spread:.3f}"
    shown["x, z 90 % [mm]"] = f"{line['xz_low']:.2f}-{line['xz_high']:.2f}"
    shown["F of peak"] = f"{line['force_of_peak']:.2%}"
    for key, name in (("coverage_50", "in 50 %"), ("coverage_90", "in 90 %")):
        shown[name] = f"{line[key]:.0%}"
    shown["in 90 %, contact"] = f"{line['contact_90']:.0%}"
    for name in ("choosing", "learning", "closing"):
        shown[f"{name} [s]"] = f"{line[f'{name}_s']:.2f}"
    return shown


def compare(cells: Sequence[Row], first: str, second: str) -> list[Row]:
    """Ratio of the mean errors of two rows over the cells that both have, for each truth."""
    table = []
    for truth in dict.fromkeys(row["truth"] for row in cells):
        pairs = paired(cells, truth, first, second)
        if not pairs:
            continue
        objects = [a["object"] for a, _ in pairs]
        line: Row = {"truth": truth, "compared": f"{first} : {second}", "pairs": len(pairs)}
        for name, columns in (("x, z", slice(0, 2)), ("F", slice(3, 5)), ("tau", slice(5, 6))):
            values = np.array(
                [[np.mean(row["mae"][-1][columns]) for row in pair] for pair in pairs]
            )
            low, high = bootstrap(values, objects, _ratio)
            line[name] = _ratio(values)
            line[f"{name} 90 %"] = f"{low:.2f}-{high:.2f}"
        table.append(line)
    return table


def paired(cells: Sequence[Row], truth: str, first: str, second: str) -> list[tuple[Row, Row]]:
    """Cells of two rows that share the world: truth, object, seed, and for decoded outlines the
    prior that they are decoded with."""
    by_place = {
        (label(row), row["object"], row["seed"]): row for row in cells if row["truth"] == truth
    }
    places = [(name, seed) for kind, name, seed in by_place if kind == first]
    return [
        (by_place[(first, *place)], by_place[(second, *place)])
        for place in places
        if (second, *place) in by_place
        and (
            truth != "decoded"
            or by_place[(first, *place)]["prior"] == by_place[(second, *place)]["prior"]
        )
    ]


def curves(cells: Sequence[Row], truth: str) -> dict[str, tuple[Array, Array]]:
    """For each row the numbers of moves and the mean error of x and z after them [mm], of the
    beliefs that the policy goes on with (without the closing draws)."""
    found = {}
    for name in dict.fromkeys(label(row) for row in cells if row["truth"] == truth):
        chosen = [row for row in cells if row["truth"] == truth and label(row) == name]
        moves = sorted({m for row in chosen for m in row["moves"]})
        errors = [
            np.mean(
                [
                    np.mean(e[:2])
                    for row in chosen
                    for m, e in zip(row["moves"], row["open_mae"], strict=True)
                    if m == count
                ]
            )  # fmt: skip
            for count in moves
        ]
        found[name] = (np.array(moves), 1e3 * np.array(errors))
    return found


def curve_rows(cells: Sequence[Row]) -> list[Row]:
    """The curves of all truths as a table."""
    return [
        {"truth": truth, "row": name} | {str(m): float(e) for m, e in zip(*curve, strict=True)}
        for truth in dict.fromkeys(row["truth"] for row in cells)
        for name, curve in curves(cells, truth).items()
    ]


def bootstrap(
    values: Float[Array, "n ..."],
    objects: Sequence[str],
    statistic: Callable[[Array], float],
    seed: int = 0,
) -> tuple[float, float]:
    """90 % interval of a statistic of cells, drawing whole objects with replacement."""
    names = list(dict.fromkeys(objects))
    places = [np.flatnonzero(np.array(objects) == name) for name in names]
    generator = np.random.default_rng(seed)
    draws = []
    for _ in range(DRAWS):
        chosen = generator.integers(len(names), size=len(names))
        draws.append(statistic(values[np.concatenate([places[i] for i in chosen])]))
    low, high = np.quantile(draws, [0.05, 0.95])
    return float(low), float(high)


def _ratio(values: Array) -> float:
    return float(values[:, 0].mean() / values[:, 1].mean())


def _order(cells: Sequence[Row]) -> list[tuple[str, str]]:
    return sorted({(row["truth"], label(row)) for row in cells})
