"""What the runs come to, and its page: every figure there comes from `results.json`.

python -m eval.checks.page runs/checks puts page and results of a run beside this file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from tpcd.cli import run
from tpcd.files import read_json, write_json, write_text

Row = dict[str, Any]
HEAD = """# Checks of recordings, on simulated ones

`python -m eval.checks --out runs/checks` measures, and `python -m eval.checks.page runs/checks`
writes this page from the `results.json` beside it. All of it is simulated, so that what is true is
known. Low and high are the exact 95 % interval of the share (Clopper and Pearson).
"""
TABLES = {
    "identification": "Arm and sensor from 60 s of motion and contact, or from seven rests: how"
    " often a quantity is told, and how many of those intervals hold the truth, 0.95 of which"
    " should; half an interval in the median. Axes of one recording are not independent. Intervals"
    " of biases, centre of mass, place and rotation of the sensor hold both ends of the stiffness,"
    " and so are wider than they need to be. By axis they are in `results.json`.",
    "untold": "Quantities that a recording cannot show, and how often they are told all the same.",
    "conventions": "How often what mends each mistake in reading is told; `others` are told with"
    " the remedy of a mistake that was not made.",
    "channels": "Faults of single channels; `others` are alarms elsewhere in these recordings.",
    "delays": "Streams apart, of an arm of 30 to 1000 N/m and 3 to 6 kg: how often the delay is"
    " known, how many intervals hold it, and its error in the median [s].",
    "doubts": "How often these are doubted: no filter of a sensor takes 0.1 s, nor one before a set"
    " point 0.15 s.",
    "fit": "How often a recording is told not to fit a belief from six moves (`ycb21-z2`, 100"
    " particles).",
    "steps": "Moves of the simulator over friction of 0.001 to 100, springs of 1e-3 to 1e9,"
    " commands up to ten sizes of the object away, and terrain that yields: depth in it, and"
    " distance from rest, of what is told to be converged [m], at worst.",
}


def tables_of(lines: Iterable[Mapping[str, Any]]) -> dict[str, list[Row]]:
    """The tables by name, of the lines of all runs; and the intervals by axis."""
    groups: dict[str, dict[tuple[str, ...], list[Row]]] = {}
    for line in lines:
        for row in line["rows"]:
            table = row.get("table", line["part"])
            groups.setdefault(table, {}).setdefault(tuple(row["of"]), []).append(row)
            if "name" in row:
                key = (row["of"][0], row["name"])
                groups.setdefault("by_axis", {}).setdefault(key, []).append(row)
    return {
        table: [{"of": ", ".join(of), **_summed(rows)} for of, rows in found.items()]
        for table, found in groups.items()
    }


def _summed(rows: Sequence[Row]) -> Row:
    found: Row = {}
    if "told" in rows[0]:
        found |= {"asked": len(rows)} | _share("told", [row["told"] for row in rows])
        held = [row["held"] for row in rows if row.get("held") is not None]
        found |= _share("held", held) if held else {}
        sizes = [row["size"] for row in rows if row.get("size") is not None]
        found |= {"median": float(np.median(sizes))} if sizes else {}
    for name in ("others", "steps", "good"):
        if name in rows[0]:
            found[name] = sum(row[name] for row in rows)
    for name in ("depth", "residual"):
        if name in rows[0]:
            found[name] = max(row[name] for row in rows)
    return found


def _share(name: str, happened: Sequence[bool]) -> Row:
    low, high = binomtest(sum(happened), len(happened)).proportion_ci(0.95)
    return {name: sum(happened), f"{name}, low": float(low), f"{name}, high": float(high)}


def page_text(results: Mapping[str, Any]) -> str:
    """The page as Markdown."""
    parts = [HEAD]
    for name, told in TABLES.items():
        rows = results["table"] if name == "identification" else results.get(name)
        if rows:
            parts.append(f"## {name.capitalize()}\n\n{told}\n\n{_markdown(rows)}\n")
    git, runs = results["versions"]["git"] or {}, results["runs_of_parts"]
    told = ", ".join(f"{count} of {part}" for part, count in runs.items())
    parts.append(
        f"Runs: {told}; run r has seed {results['seeds'][0]} + r. Revision {git.get('revision')},"
        f" {results['versions']['date_utc']}.\n"
    )
    return "\n".join(parts)


def _markdown(rows: Sequence[Row]) -> str:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for row in rows:
        lines.append(f"| {' | '.join(_cell(row.get(name)) for name in columns)} |")
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Page:
    """Settings of the command."""

    run: Path
    """Run folder that python -m eval.checks wrote."""


def publish(config: Page) -> None:
    """Put page and results of a run beside this file, without places of the machine."""
    results, folder = read_json(config.run / "results.json"), Path(__file__).parent
    results["config"].pop("out", None)
    results["versions"].pop("folder", None)
    write_json(folder / "results.json", results)
    write_text(folder / "README.md", page_text(results))


if __name__ == "__main__":
    run(publish, Page, positional=("run",), prog="python -m eval.checks.page")
