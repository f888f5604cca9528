"""Figures of the table: what each object's exploration taught, and the table's curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.table.cells import Cell, Outcome
from eval.table.summary import Row, curves, label, summarise
from tpcd.commands.drawing import KnownTruth, draw_estimation
from tpcd.commands.estimation import step_row
from tpcd.commands.prediction import measured_rows, predict_rows
from tpcd.figures.predictions import prediction as prediction_figure
from tpcd.figures.quality import calibration, error_bars
from tpcd.figures.sinks import ImageWriter, save_figure
from tpcd.figures.style import SERIES, legend_below, panels
from tpcd.predict import ContactPredictor
from tpcd.prediction import CHANNELS

POLICIES = ("active", "random", "expert", "lookahead", "grid", "rich")
"""Each has a colour of its own, whoever estimates."""
PAPER_ERROR = 6.8
"""Middle of what the paper reports for x and z [mm]."""


def draw_cell(outcome: Outcome, cell: Cell, folder: Path, writer: ImageWriter) -> None:
    """Estimation progress, outline, scene, exploration and one test of an object."""
    prefix = f"{cell.truth}-{cell.object}-{cell.estimator}-{cell.policy}-"
    belief = outcome.steps[-1].belief
    known = KnownTruth(outcome.scene.vertices_ee, outcome.scene.theta)
    history = [step_row(step) for step in outcome.steps]
    explored = outcome.exploration
    heading = f"{cell.object}, {cell.truth}"
    draw_estimation(belief, history, explored.measured, folder, writer, known, prefix, heading)
    predictor = ContactPredictor(belief)
    for name, recording, text in (
        ("exploration", explored, "exploration moves, explained by the final belief"),
        ("test", outcome.test, "held-out trajectory, predicted one step ahead"),
    ):
        rows = predict_rows(predictor, recording.measured, of="true", reference=recording.true)
        figure = prediction_figure(
            measured_rows(recording.true)[1:].numpy(),
            rows.mean.numpy(),
            rows.low.numpy(),
            rows.high.numpy(),
            f"{cell.object}: {text}",
            rows_are="true",
        )
        save_figure(figure, folder, f"{prefix}{name}", writer, heading=heading)


def draw_summary(cells: Sequence[Row], folder: Path, writer: ImageWriter) -> None:
    """Errors against moves, errors of each object, and calibration, for every truth."""
    for truth in dict.fromkeys(row["truth"] for row in cells):
        save_figure(_curve_figure(cells, truth), folder, f"{truth}-curves", writer)
        chosen = [row for row in cells if row["truth"] == truth]
        ours = [row for row in chosen if row["estimator"] == "default"]
        if ours:
            bars = [_bar(ours, name, kind) for name, kind in _places(ours)]
            labels = {"xz_mm": "error of x and z [mm]", "F_N": "error of force [N]"}
            colours = {label(row): _colour(row["policy"]) for row in ours}
            figure = error_bars(bars, labels, group="row", colours=colours)
            save_figure(figure, folder, f"{truth}-objects", writer)
        for kind in dict.fromkeys(label(row) for row in chosen):
            rows = [one for row in chosen if label(row) == kind for one in row["contact_transform"]]
            name = f"{truth}-calibration-{kind.replace(' / ', '-')}"
            figure = calibration(np.array(rows), CHANNELS, "rows in contact")
            save_figure(figure, folder, name, writer)
    for line in summarise(cells):
        for key in ("x_mm", "z_mm", "F_x_N", "F_z_N", "tau_Nm", "coverage_90"):
            tag = f"{line['truth']}/{key}/{line['row'].replace(' / ', '-')}"
            writer.add_scalar(tag, line[key])  # type: ignore[attr-defined]


def _curve_figure(cells: Sequence[Row], truth: str) -> Any:
    figure, (panel,) = panels(1, 1, 6.0, 4.0)
    entries = {}
    for name, (moves, errors) in curves(cells, truth).items():
        estimator, policy = name.split(" / ")
        style = "--" if estimator == "paper" else "-"
        (entries[name],) = panel.plot(
            moves, errors, style, color=_colour(policy), marker=".", linewidth=1.6
        )
    entries["what the paper reports, 15 moves"] = panel.axhline(
        PAPER_ERROR, color="0.5", linestyle=":"
    )
    panel.set_yscale("log")
    panel.set_xlabel("exploration moves")
    panel.locator_params("x", integer=True)
    panel.set_ylabel("mean error of x and z [mm]")
    legend_below(figure, entries, columns=3)
    return figure


def _colour(policy: str) -> str:
    return SERIES[POLICIES.index(policy)]


def _places(rows: Sequence[Row]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((row["object"], label(row)) for row in rows))


def _bar(rows: Sequence[Row], name: str, kind: str) -> Row:
    errors = np.array([r["mae"][-1] for r in rows if r["object"] == name and label(r) == kind])
    return {
        "object": name,
        "row": kind,
        "xz_mm": 1e3 * float(errors[:, :2].mean()),
        "F_N": float(errors[:, 3:5].mean()),
    }
