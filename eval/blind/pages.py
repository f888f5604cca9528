"""Tables and figures of the benchmark: marks, suites, effects, and what was taken for what."""

from __future__ import annotations

import csv
import io
import math
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter

from eval.blind.cases import outlines
from eval.blind.detection import detection_figure, detection_table, size_calibration
from eval.blind.marks import is_falsely_named, mark_table
from eval.blind.score import Score, confusion, median_interval, rate, share_interval
from eval.blind.suites import CLEAN, SUITES
from eval.blind.trial import load_shape
from tpcd.figures.sinks import save_figure
from tpcd.figures.style import TEXT, panels, title
from tpcd.files import write_text
from tpcd.results import format_table, write_results

Row = dict[str, Any]


LETTER = 0.085
"""Width of a letter of a name in a figure [in]."""


def write_report(
    scores: Sequence[Score],
    failed: Sequence[Mapping[str, Any]],
    folder: Path,
    prior: str,
    seeds: Sequence[int],
    **extra: Any,
) -> None:
    """Print, draw and write what scores come to into a run folder; `failed` are the lines of cases
    without a verdict, `prior` is the shape prior of all cases."""
    note = _known_objects(load_shape(prior))
    with SummaryWriter(folder / "tensorboard") as writer:
        tables = report(scores, folder, writer)
    others = {name: tables[name] for name in ("suites", "effects", "detection")}
    write_results(
        folder,
        tables["marks"],
        seeds=seeds,
        **others,
        cases=scores,
        failed=failed,
        note=note,
        **extra,
    )
    if note:
        print(f"\n{note}")
    for line in failed:
        print(f"failed: {line['case']}: {line['failed']}", file=sys.stderr)
    print(f"results in {folder}")


def report(scores: Sequence[Score], folder: Path, writer: Any) -> dict[str, list[Row]]:
    """Print all tables, log them, draw the figures; the tables by name."""
    tables = {
        "suites": suite_table(scores),
        "effects": effect_table(scores),
        "detection": detection_table(scores),
        "marks": mark_table(scores),
    }
    texts = {name: format_table(rows) for name, rows in tables.items() if rows}
    print("\n\n".join(texts.values()))
    for name, text in texts.items():
        writer.add_text(name, f"```\n{text}\n```")
    for row in tables["suites"]:
        tag = f"{row['suite']}/{row['hidden'].replace(' ', '_')}"
        writer.add_scalar(f"{tag}/exact", row["exact"])
        writer.add_scalar(f"{tag}/wrong_name", row["wrong name"])
    for suite in dict.fromkeys(score.suite for score in scores):
        chosen = [score for score in scores if score.suite == suite]
        write_text(folder / f"confusion-{suite}.csv", confusion_csv(chosen))
        figure = confusion_figure(chosen, f"{suite}: {len(chosen)} runs")
        save_figure(figure, folder / "figures", f"confusion-{suite}", writer)
    for name, drawn in (("detection", detection_figure), ("sizes", size_calibration)):
        figure = drawn(scores)
        if figure is not None:
            save_figure(figure, folder / "figures", name, writer)
    return tables


def suite_table(scores: Sequence[Score]) -> list[Row]:
    """One row for each suite; clean cases of mixed suites have their own."""
    table = []
    for suite in (name for name in SUITES if any(s.suite == name for s in scores)):
        for is_clean in (True, False):
            chosen = [s for s in scores if s.suite == suite and (s.label == CLEAN) == is_clean]
            if chosen:
                table.append({"suite": suite, **_rates(chosen, is_clean)})
    return table


def effect_table(scores: Sequence[Score]) -> list[Row]:
    """One row for each suite and what was hidden, with what it was mostly taken for."""
    table = []
    for suite, label in dict.fromkeys((s.suite, s.label) for s in scores):
        chosen = [s for s in scores if (s.suite, s.label) == (suite, label)]
        others = Counter(s.found for s in chosen if not s.is_exact).most_common(2)
        count, runs = rate(chosen, lambda s: s.is_exact)
        errors = median_interval([e for s in chosen for e in s.size_errors])
        row: Row = {"suite": suite, "hidden": label, "runs": runs, "exact": count / runs}
        row["90 %"] = _interval(count, runs)
        row["size error"] = errors[0] if math.isfinite(errors[0]) else None
        row["otherwise"] = ", ".join(f"{name} ({n})" for name, n in others) or None
        table.append(row)
    return table


def confusion_csv(scores: Sequence[Score]) -> str:
    """The confusion matrix, truths down and findings across."""
    truths, columns, counts = confusion(scores)
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(["truth", *columns])
    lines.writerows([truth, *row] for truth, row in zip(truths, counts, strict=True))
    return text.getvalue()


def confusion_figure(scores: Sequence[Score], heading: str) -> Figure:
    """The confusion matrix as shares of each truth, with counts."""
    truths, columns, counts = confusion(scores)
    numbers = np.array(counts)
    shares = numbers / numbers.sum(1, keepdims=True)
    # Names need room of their own, however few there are; columns are turned by 60 degrees.
    across, up = (max(map(len, names)) * LETTER for names in (truths, columns))
    width = 1.0 + max(across, 0.5 * up) + 0.32 * max(len(columns), 3)
    height = 1.2 + 0.87 * up + 0.24 * max(len(truths), 3)
    figure, (panel,) = panels(1, 1, width, height)
    panel.grid(False)
    panel.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    panel.set_xticks(range(len(columns)), columns, rotation=60, ha="right")
    panel.set_yticks(range(len(truths)), truths)
    panel.set_xlabel("verdict")
    panel.set_ylabel("hidden")
    for i, j in np.argwhere(numbers):
        colour = "white" if shares[i, j] > 0.5 else "black"
        panel.text(j, i, str(numbers[i, j]), ha="center", va="center", color=colour,
                   fontsize=TEXT - 2)  # fmt: skip
    title(panel, heading)
    return figure


def _rates(scores: Sequence[Score], is_clean: bool) -> Row:
    count, runs = rate(scores, lambda s: s.is_exact)

    def share(what: Any) -> float:
        return rate(scores, what)[0] / runs

    closed = median_interval([s.closed for s in scores])[0]
    row: Row = {"hidden": "nothing" if is_clean else "effects", "runs": runs}
    row |= {"exact": count / runs, "90 %": _interval(count, runs)}
    row["within ambiguity"] = share(lambda s: s.is_within)
    row["wrong name"] = share(is_falsely_named if is_clean else lambda s: s.is_wrong)
    row["unknown"] = share(lambda s: s.verdict == "unknown_remains")
    row["nothing"] = share(lambda s: s.verdict == "nothing_missing")
    row["below limit"] = share(lambda s: s.is_below_limit)
    row["too little"] = share(lambda s: s.verdict == "not_enough_information")
    row["failed"] = share(lambda s: s.verdict == "failed")
    row["gap closed"] = closed if math.isfinite(closed) else None
    row["seconds"] = median_interval([s.seconds for s in scores])[0]
    return row


def _interval(count: int, runs: int) -> str:
    low, high = share_interval(count, runs)
    return f"{low:.2f}-{high:.2f}"


def _known_objects(shape: Any) -> str:
    """What to say of objects that the prior was trained on."""
    trained = [str(name) for name in getattr(shape, "names", ())]
    seen = [n for n in outlines() if any(t == n or t.startswith(f"{n}/") for t in trained)]
    if not seen:
        return ""
    return f"The shape prior was trained on {len(seen)} of the {len(outlines())} objects."
