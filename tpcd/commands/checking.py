"""What `scripts/check.py` shows and writes: a page for the terminal, one of HTML with pictures over
time, and everything as JSON."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tpcd.commands.check_rows import (
    CLOCK_KINDS,
    channel_rows,
    clock_lines,
    known_rows,
    map_lines,
    noise_line,
    shown_names,
    unknown_lines,
    wrong_lines,
)
from tpcd.commands.checked import Checked
from tpcd.commands.verdict import verdict
from tpcd.files import write_json, write_text
from tpcd.quality.channels import ROTATIONS, UNITS, WRENCH
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.stream import Stream
from tpcd.results import format_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tpcd.figures.recording import Trace

FEWEST_DRAWN = 2
"""Samples below which nothing is drawn."""
NOTHING_TO_SEE = "nothing found"


def written_page(checked: Checked) -> str:
    """The whole check as text."""
    code, sentence = verdict(checked)
    parts = [f"{checked.path}: {sentence} (exit code {code})", *checked.notes]
    sections = (
        ("clocks", clock_lines(checked)),
        ("channels", [format_table(rows)] if (rows := channel_rows(checked)) else []),
        ("", [noise_line(checked)] if checked.kind == "recording" else []),
        ("what looks wrong", wrong_lines(checked) or [NOTHING_TO_SEE]),
        ("which columns look like what", map_lines(checked)),
        ("arm and sensor, without a contact model", _arm_lines(checked)),
    )
    for heading, lines in sections:
        if lines:
            parts += ([f"\n{heading}"] if heading else []) + lines
    return "\n".join(parts)


def write_check(checked: Checked, folder: Path) -> Path:
    """Write check.txt, check.json, pictures and check.html into a run folder; returns the page."""
    from tpcd.figures.sinks import save_figure  # figures import torch, a page of text does not

    code, sentence = verdict(checked)
    write_text(folder / "check.txt", written_page(checked) + "\n")
    content = {
        "verdict": sentence,
        "exit_code": code,
        "usable_share": 1.0 - checked.left_out,
        "findings": [plain_finding(each) for each in checked.findings],
        "channels": channel_rows(checked),
        "noise": [asdict(each) for each in checked.noises],
        "quantities": [asdict(each) for each in checked.quantities],
        "map": list(checked.mapped),
        "suggested_map": list(checked.suggestion.entries) if checked.suggestion else [],
        "notes": list(checked.notes),
    }
    write_json(folder / "check.json", content)
    images = {}
    for name, (figure, caption) in draw_check(checked).items():
        path = save_figure(figure, folder / "figures", name)
        images[name] = (caption, base64.b64encode(path.read_bytes()).decode("ascii"))
    page = folder / "check.html"
    write_text(page, render_page(checked, images))
    return page


def plain_finding(finding: Finding) -> dict[str, Any]:
    """A finding as JSON has it; times without an end are null."""
    return {**asdict(finding), "weight": finding.weight.value}


def render_page(checked: Checked, images: dict[str, tuple[str, str]]) -> str:
    """One self-contained page of HTML; `images` are captions and PNG files in base 64."""
    import jinja2

    template = (Path(__file__).parent / "check.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    code, sentence = verdict(checked)
    return environment.from_string(template).render(
        path=str(checked.path),
        code=code,
        sentence=sentence,
        notes=checked.notes,
        clocks=clock_lines(checked),
        channels=[_shown(row) for row in channel_rows(checked)],
        noise=noise_line(checked) if checked.kind == "recording" else "",
        wrong=wrong_lines(checked),
        columns=map_lines(checked),
        known=known_rows(checked),
        unknown=unknown_lines(checked),
        untold=checked.untold,
        images=images,
    )


def draw_check(checked: Checked) -> dict[str, tuple[Figure, str]]:
    """Pictures over time, each with its caption."""
    from tpcd.figures.recording import channels_over_time, clocks_over_time

    drawn: dict[str, tuple[Figure, str]] = {}
    names = shown_names(checked.streams)
    groups = {
        "pose": [n for n in names if n not in (*WRENCH, *ROTATIONS)],
        "rotation": [n for n in names if n in ROTATIONS],
        "wrench": [n for n in names if n in WRENCH],
    }
    for group, members in groups.items():
        traces = [t for n in members if (t := _trace(checked, n)) is not None]
        if traces:
            told = sum(bool(trace.marks) for trace in traces)
            caption = (
                f"The {group} over time: {told} of {len(traces)} channels have stretches that are"
                " marked."
                if told
                else f"The {group} over time: nothing is marked."
            )
            heading = f"{group.capitalize()} over time"
            drawn[group] = (channels_over_time(traces, heading), caption)
    clocks = _clocks(checked)
    if clocks and checked.kind == "recording":
        found = [f for f in checked.findings if f.kind in CLOCK_KINDS]
        marks = {n: _marks(found, stream.channels) for n, stream in clocks.items()}
        headings = {
            name: f"{name}: every {1e3 * float(np.median(np.diff(stream.times))):.3g} ms"
            + (f", {len(marks[name])} times marked" if marks[name] else "")
            for name, stream in clocks.items()
        }
        times = {name: stream.times for name, stream in clocks.items()}
        drawn["clocks"] = (
            clocks_over_time(times, marks, headings),
            "Clocks: the time from each sample to the next.",
        )
    return drawn


def _clocks(checked: Checked) -> dict[str, Stream]:
    """Streams by name; those of a table that share their times as one, with all channels."""
    clocks: dict[str, Stream] = {}
    for stream in checked.streams:
        if len(stream.times) <= FEWEST_DRAWN:
            continue
        before = clocks.get(stream.name)
        if before is not None and np.array_equal(before.times, stream.times):
            channels = (*before.channels, *stream.channels)
            clocks[stream.name] = replace(before, channels=channels)
        else:
            name = stream.name if before is None else f"{stream.name}, {stream.channels[0]}"
            clocks[name] = stream
    return clocks


def _trace(checked: Checked, name: str) -> Trace | None:
    """One channel with its set point and what was found in it."""
    from tpcd.figures.recording import Trace
    from tpcd.figures.style import display_unit

    found = _column(checked.streams, name)
    if found is None or len(found[0]) < FEWEST_DRAWN:
        return None
    own = [f for f in checked.findings if f.kind not in CLOCK_KINDS]
    names = (name, "rotation") if name in ROTATIONS else (name,)
    marks = _marks(own, names, checked.kind == "episode")
    counts = {kind: sum(mark[0] == kind for mark in marks) for kind, _, _ in marks}
    told = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in counts.items())
    if np.ptp(found[1][np.isfinite(found[1])]) == 0:
        told = told or "never changes"
    noise = {each.name: each for each in checked.noises}.get(name)
    quiet = ""
    if noise is not None and noise.sample > 0:
        factor, unit = display_unit(UNITS.get(name, ""))
        quiet = f", noise {factor * noise.sample:.2g} {unit} at rest"
    return Trace(
        name,
        UNITS.get(name, ""),
        *found,
        f"{name}: {told or NOTHING_TO_SEE}{quiet}",
        marks,
        _column(checked.streams, f"u_{name}"),
    )


def _column(streams: Sequence[Stream], name: str) -> tuple[np.ndarray, np.ndarray] | None:
    for stream in streams:
        if name in stream.channels:
            return stream.times, stream.values[:, stream.channels.index(name)]
    return None


def _marks(
    findings: Sequence[Finding], names: Sequence[str], rows: bool = False
) -> list[tuple[str, float, float]]:
    """Stretches of what was found in some channels; those of an episode are rows."""
    marks = []
    for each in findings:
        if each.weight is Weight.NOTE or not set(each.channels) & set(names):
            continue
        if rows and each.rows is not None:
            marks.append((each.kind, each.rows[0] - 0.5, each.rows[1] - 0.5))
        elif each.start is not None and each.end is not None and np.isfinite(each.start + each.end):
            marks.append((each.kind, each.start, each.end))
    return marks


def _arm_lines(checked: Checked) -> list[str]:
    lines = [format_table(rows)] if (rows := known_rows(checked)) else []
    lines += unknown_lines(checked)
    if checked.untold:
        lines.append(f"nothing can be told: {checked.untold}")
    return lines


def _shown(row: dict[str, Any]) -> dict[str, str]:
    """A row of a table as text."""
    return {
        name: "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
        for name, value in row.items()
    }
