"""What `scripts/diagnose.py` writes: verdict, model, figures, one page of HTML, TensorBoard."""

from __future__ import annotations

import base64
import math
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import tpcd
from tpcd.belief.augmented import found_effects
from tpcd.belief.storage import save_belief
from tpcd.commands.diagnosis_figures import draw_diagnosis
from tpcd.commands.diagnosis_rows import shown_coverage, shown_evidence, shown_tests
from tpcd.commands.gap_rows import shown_data, shown_gaps, shown_share
from tpcd.commands.plausibility import keep_rows
from tpcd.data.episode import Episode
from tpcd.discrepancy.diagnosis import Diagnosis
from tpcd.discrepancy.memory import Memory, digest
from tpcd.effects.model import Model, write_model
from tpcd.effects.shape_change import UNCHANGED, ShapeChange
from tpcd.errors import RunError
from tpcd.figures.sinks import save_figure
from tpcd.files import write_json, write_text
from tpcd.records import fitting, read_entries
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
    shape: ShapeChange = UNCHANGED,
) -> Path:
    """Write all of it, with the shape of its model, into a run folder; returns the page."""
    write_json(folder / "verdict.json", diagnosis.to_plain())
    figures: dict[str, tuple[Figure, str]] = {}
    if diagnosis.belief is not None:
        belief = diagnosis.belief
        model = Model(belief.prior.effects, belief.step, found_effects(belief), shape)
        write_model(model, folder / "model.yaml", diagnosis.sentence)
        save_belief(belief, folder, prior)
        keep_rows(episodes, folder)
        figures = draw_diagnosis(diagnosis, episodes, least_gain)
    images = {}
    for name, (figure, caption) in figures.items():
        path = save_figure(figure, folder / "figures", name, writer, heading="diagnosis")
        images[name] = (caption, base64.b64encode(path.read_bytes()).decode("ascii"))
    page = folder / "report.html"
    write_text(page, render_page(diagnosis, images, [e.path for e in episodes]))
    writer.add_text("verdict", f"**{diagnosis.verdict.replace('_', ' ')}**: {diagnosis.sentence}")
    return page


def compare_runs(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """One row for each run: its verdict, effects and gap. Raises `RunError`."""
    rows = []
    for folder in folders:
        path = folder / "verdict.json"
        if not path.is_file():
            raise RunError(path, "no such file", "give folders that diagnose wrote")
        found = read_entries(path, "diagnose again")
        with fitting(path, "diagnose again"):
            effects = [size for effect in found["effects"] for size in _sizes(effect)]
            share = found["share_closed"]
            rows.append(
                {
                    "run": folder.name,
                    "verdict": found["verdict"].replace("_", " "),
                    "effects": "; ".join(effects) or "none",
                    "gap closed": "" if share is None else f"{share:.0%}",
                    "unexplained": _percent(
                        found["unexplained_before"], found["unexplained_after"]
                    ),
                }
            )
    return rows


def _sizes(effect: dict[str, Any]) -> list[str]:
    """The parameters of an effect as text, or its name where it has none, as numerics has."""
    return [f"{effect['name']}.{p['name']} {p['shown']}" for p in effect["parameters"]] or [
        effect["name"]
    ]


def _percent(before: float | None, after: float | None) -> str:
    return "" if before is None or after is None else f"{before:.0%} to {after:.0%}"


def render_page(
    diagnosis: Diagnosis, images: dict[str, tuple[str, str]], paths: Sequence[Path | None]
) -> str:
    """One self-contained page of HTML; `images` are captions and PNG files in base 64."""
    import jinja2

    template = (Path(__file__).parent / "diagnosis.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(template).render(
        d=diagnosis,
        measured_on=shown_data(diagnosis),
        share=shown_share(diagnosis),
        tables=[shown_gaps(diagnosis.gap), shown_gaps(diagnosis.gap_by_contact, by_contact=True)],
        evidence=[
            shown_evidence(diagnosis.log_evidence_base, diagnosis.log_evidence_base_by_seed),
            shown_evidence(diagnosis.log_evidence, diagnosis.log_evidence_by_seed),
        ],
        tests=shown_tests(diagnosis.tests),
        coverage=shown_coverage(diagnosis.coverage),
        images=images,
        episodes=[str(path) for path in paths if path is not None],
        finite=math.isfinite,
    )
