"""What a diagnosis writes: verdict.json, figures, the page, and runs side by side."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

from command_calls import PRIOR
from made_diagnosis import a_diagnosis
from torch.utils.tensorboard import SummaryWriter

from tpcd.commands.diagnosing import compare_runs, write_diagnosis
from tpcd.commands.diagnosis_figures import draw_diagnosis, shown_candidates
from tpcd.discrepancy.diagnosis import Candidate, Diagnosis, NamedEffect
from tpcd.discrepancy.variants import FINER_STEPS
from tpcd.figures.sinks import save_figure


def written(found: Diagnosis, folder: Path) -> str:
    """The page of a diagnosis without beliefs, with all else written beside it."""
    folder.mkdir(exist_ok=True)
    with SummaryWriter(folder / "tensorboard") as writer:
        return write_diagnosis(found, [], 6.0, PRIOR, folder, writer).read_text()


def test_what_was_added_later_is_shown_as_it_was_then() -> None:
    candidates = (
        Candidate("finer_steps", 0, 40.0),
        Candidate("floor_compliance", 1, 119.0, (), "accepted: gain 119.0"),
        Candidate("wall_compliance", 1, 28.6),
        Candidate("grasp_slip", 1, -math.inf),
        Candidate("wall_compliance", 2, 31.5, (), "accepted: gain 31.5"),
        Candidate("floor_tilt", 2, 9.0, (), "rejected: gain 9.0"),
    )
    shown = shown_candidates(replace(a_diagnosis(), candidates=candidates))
    assert [(c.name, c.round) for c in shown] == [("floor_compliance", 1), ("wall_compliance", 2)]


def test_the_page_holds_everything_in_one_file(tmp_path: Path) -> None:
    found = a_diagnosis()
    figures = draw_diagnosis(found, [], 6.0)
    assert set(figures) == {"residuals", "evidence", "gap", "theta"}
    for name, (figure, caption) in figures.items():
        assert caption and save_figure(figure, tmp_path, name).stat().st_size > 5000
    page = written(found, tmp_path)
    for text in (
        *(
            "2.00 ± 0.10 mm per 10 N",
            "all channels: 95 % (90 to 99); in typical rows 50 %",
            "needs lift-off",
            "30.0",
            "120.0 (seeds: 120.1, 119.9) before, 150.0 (seeds: 150.5, 149.2, 150.1) after [nats]",
        ),
        *("floor and wall (7)", "z [mm]", "0.400 (0.300 to 0.500)", "100 % (90 to 100)"),
    ):
        assert text in page
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    evidence = verdict["evidence"]
    assert evidence["before_by_seed"] == list(found.log_evidence_base_by_seed)
    assert evidence["after_by_seed"] == list(found.log_evidence_by_seed)
    assert evidence["candidates"][0]["name"] == "floor_compliance"
    assert verdict["gap_by_contact"][0]["contact"] == "floor and wall"
    assert "http" not in page.replace("http-equiv", "")


def test_an_effect_without_parameters_is_shown_by_its_name(tmp_path: Path) -> None:
    numerics = NamedEffect("numerics", (), FINER_STEPS.note)
    effects = (numerics, *a_diagnosis().effects)
    page = written(replace(a_diagnosis(), effects=effects), tmp_path)
    assert f'<td>numerics</td><td colspan="3">{FINER_STEPS.note}</td>' in page
    (row,) = compare_runs([tmp_path])
    shown = effects[1].parameters[0].shown
    assert row["effects"] == f"numerics; floor_compliance.compliance {shown}"
