"""What `scripts/diagnose.py` writes: verdict, model, figures, one page of HTML, TensorBoard."""

from __future__ import annotations

import base64
import math
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

import tpcd
from tpcd.belief.augmented import found_effects
from tpcd.belief.storage import save_belief
from tpcd.commands.gap_rows import shown_gaps, shown_share
from tpcd.data.episode import Episode
from tpcd.discrepancy.diagnosis import Candidate, Cell, Diagnosis
from tpcd.discrepancy.memory import Memory, digest
from tpcd.effects.model import Model, write_model
from tpcd.errors import RunError
from tpcd.figures.diagnosis import evidence_bars, gap_bars, residual_map, theta_shift, worst_stretch
from tpcd.figures.sinks import save_figure
from tpcd.files import read_json, write_json
from tpcd.predict import ContactPredictor
from tpcd.results import RESULTS_FILE, resumed_run, run_folder
from tpcd.versions import versions

EXIT_CODES = {
    "nothing_missing": 0,
    "named": 10,
    "ambiguous": 11,
    "formula": 12,
    "unknown_remains": 13,
    "not_enough_information": 14,
}
"""What the command returns for each verdict; 1 and 2 are errors, as everywhere."""
_TIMES = ("before", "after")
STRETCH = 20
"""Rows of the worst stretch."""
FITS_FOLDER = "fits"
"""Where a run keeps its fits until it is done."""


def open_diagnosis(
    config: Any, folder: Path, overwrite: bool, resume: bool
) -> AbstractContextManager[Path]:
    """A new run folder, or with `resume` that of a run that was stopped. Raises `RunError`."""
    if not resume:
        return run_folder(folder, "scripts/diagnose.py", config, overwrite, resumable=FITS_FOLDER)
    if (folder / RESULTS_FILE).is_file():
        raise RunError(folder, "has its verdict", "leave out --resume")
    return resumed_run(folder, config, ("out",))


def fits_of(folder: Path, code: Sequence[Path]) -> Memory:
    """The fits of a run; those made by other code, that of the files `code` and of other packages
    included, do not count."""
    own = sorted(Path(tpcd.__file__).parent.rglob("*.py"))
    texts = (path.read_text(encoding="utf-8") for path in (*own, *code))
    return Memory(folder / FITS_FOLDER, digest(versions()["packages"], *texts))


def forget_fits(folder: Path) -> None:
    """Remove the fits of a run that is done."""
    shutil.rmtree(folder / FITS_FOLDER, ignore_errors=True)


def write_diagnosis(
    diagnosis: Diagnosis,
    episodes: Sequence[Episode],
    least_gain: float,
    prior: str,
    folder: Path,
    writer: Any,
) -> Path:
    """Write all of it into a run folder; returns the page."""
    write_json(folder / "verdict.json", diagnosis.to_plain())
    figures: dict[str, tuple[Figure, str]] = {}
    if diagnosis.belief is not None:
        belief = diagnosis.belief
        model = Model(belief.prior.effects, belief.step, found_effects(belief))
        write_model(model, folder / "model.yaml", diagnosis.sentence)
        save_belief(belief, folder, prior)
        figures = draw_diagnosis(diagnosis, episodes, least_gain)
    images = {}
    for name, (figure, caption) in figures.items():
        path = save_figure(figure, folder / "figures", name, writer, heading="diagnosis")
        images[name] = (caption, base64.b64encode(path.read_bytes()).decode("ascii"))
    page = folder / "report.html"
    page.write_text(render_page(diagnosis, images, [e.path for e in episodes]), encoding="utf-8")
    writer.add_text("verdict", f"**{diagnosis.verdict.replace('_', ' ')}**: {diagnosis.sentence}")
    return page


def compare_runs(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """One row for each run: its verdict, effects and gap. Raises `RunError`."""
    rows = []
    for folder in folders:
        path = folder / "verdict.json"
        if not path.is_file():
            raise RunError(path, "no such file", "give folders that diagnose wrote")
        found = read_json(path)
        try:
            parameters = [
                f"{effect['name']}.{p['name']} {p['shown']}"
                for effect in found["effects"]
                for p in effect["parameters"]
            ]
            share = found["share_closed"]
            rows.append(
                {
                    "run": folder.name,
                    "verdict": found["verdict"].replace("_", " "),
                    "effects": "; ".join(parameters) or "none",
                    "gap closed": "" if share is None else f"{share:.0%}",
                    "unexplained": _percent(
                        found["unexplained_before"], found["unexplained_after"]
                    ),
                }
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise RunError(path, f"cannot be read ({error!r})", "diagnose again") from error
    return rows


def _percent(before: float | None, after: float | None) -> str:
    if before is None or after is None:
        return ""
    return f"{before:.0%} to {after:.0%}"


def draw_diagnosis(
    diagnosis: Diagnosis, episodes: Sequence[Episode], least_gain: float
) -> dict[str, tuple[Figure, str]]:
    """The figures that the diagnosis has data for, each with its caption."""
    drawn: dict[str, tuple[Figure, str]] = {}
    rows: dict[str, int] = {}
    for cell in (*diagnosis.cells_before, *diagnosis.cells_after):
        if cell.covariate == "mean":
            rows[cell.mode] = max(rows.get(cell.mode, 0), cell.count)
    if rows:
        drawn["residuals"] = (
            residual_map(
                _largest_scores(diagnosis.cells_before),
                _largest_scores(diagnosis.cells_after),
                sorted(rows.items(), key=lambda row: (row[0] != "all", row[0])),
            ),
            "What the models leave, by contact mode (number of transitions) and channel: the"
            " largest score of residuals' mean, size, or slope with load, place, angle or time.",
        )
    tried = shown_candidates(diagnosis)
    if tried:
        drawn["evidence"] = (
            evidence_bars(
                [f"{c.name}, round {c.round}" if c.round > 1 else c.name for c in tried],
                [c.gain for c in tried],
                [c.name in diagnosis.names for c in tried],
                least_gain,
            ),
            "Candidates of the first round, and what later rounds added.",
        )
    if diagnosis.gap:
        bars = [
            (
                *(g.channel, g.unit, (g.before, g.before_low, g.before_high)),
                *((g.after, g.after_low, g.after_high), g.noise_floor),
            )
            for g in diagnosis.gap
        ]
        drawn["gap"] = (
            gap_bars(bars),
            f"Errors of one-step predictions on {diagnosis.held_out}, with 90 % intervals.",
        )
        drawn["theta"] = (
            theta_shift(
                [e.name for e in diagnosis.theta_after],
                [(e.value, e.sd) for e in diagnosis.theta_before],
                [(e.value, e.sd) for e in diagnosis.theta_after],
            ),
            "What the base model held for true, against the model found.",
        )
    if diagnosis.belief is not None and diagnosis.belief_before is not None and diagnosis.effects:
        drawn["stretch"] = (
            _stretch(diagnosis, episodes[0]),
            f"The {STRETCH} rows in a row that the base model predicts worst.",
        )
    return drawn


def render_page(
    diagnosis: Diagnosis, images: dict[str, tuple[str, str]], paths: Sequence[Path | None]
) -> str:
    """One self-contained page of HTML; `images` are captions and PNG files in base 64."""
    import jinja2

    template = (Path(__file__).parent / "diagnosis.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(template).render(
        d=diagnosis,
        share=shown_share(diagnosis),
        tables=[shown_gaps(diagnosis.gap), shown_gaps(diagnosis.gap_by_contact, by_contact=True)],
        images=images,
        episodes=[str(path) for path in paths if path is not None],
        finite=math.isfinite,
    )


def shown_candidates(diagnosis: Diagnosis) -> list[Candidate]:
    """Those of the first round; what a later round added as it was then, over the model before."""
    shown: dict[str, Candidate] = {}
    for candidate in sorted(diagnosis.candidates, key=lambda c: c.round):
        added = candidate.round > 1 and candidate.outcome.startswith("accepted")
        if math.isfinite(candidate.gain) and (candidate.round == 1 or added):
            shown[candidate.name] = candidate
    return list(shown.values())


def _largest_scores(cells: Sequence[Cell]) -> list[tuple[str, str, float]]:
    """The largest score of every mode and channel, whatever it goes with."""
    largest: dict[tuple[str, str], float] = {}
    for cell in cells:
        key = (cell.mode, cell.channel)
        if abs(cell.score) > abs(largest.get(key, 0.0)):
            largest[key] = cell.score
    return [(*key, score) for key, score in largest.items()]


def _stretch(diagnosis: Diagnosis, episode: Episode) -> Figure:
    predicted = []
    for belief in (diagnosis.belief_before, diagnosis.belief):
        assert belief is not None
        found = ContactPredictor(belief, particles=100).predict(
            episode.poses[:-1], episode.commands[1:], episode.commands[:-1]
        )
        predicted.append(found.mean)
    measured = torch.cat((episode.poses, episode.wrenches), dim=-1)[1:]
    square = ((predicted[0] - measured) / episode.sensor_std).square().nan_to_num(0.0).sum(-1)
    length = min(STRETCH, len(square))
    first = int(square.unfold(0, length, 1).sum(-1).argmax())
    part, channels = slice(first, first + length), [1, 3, 4]
    return worst_stretch(
        (torch.arange(len(measured)) + 1)[part].numpy(),
        *(value[part][:, channels].numpy() for value in (measured, *predicted)),
        episode.sensor_std[channels].numpy(),
    )
