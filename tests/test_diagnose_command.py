"""scripts/diagnose.py: what it writes, its exit codes, and runs side by side."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from command_calls import PRIOR, call

from tpcd.commands.diagnosing import fits_of
from tpcd.discrepancy.coverage import NEEDED
from tpcd.discrepancy.diagnosis import (
    Candidate,
    Cell,
    Diagnosis,
    Estimate,
    Gap,
    Limit,
    NamedEffect,
)
from tpcd.discrepancy.memory import Memory


def a_gap(contact: str, rows: int) -> Gap:
    """Of z, closed."""
    before, after = (4e-4, 3e-4, 5e-4), (2e-4, 1.8e-4, 2.4e-4)
    return Gap("z", "m", contact, rows, *before, *after, 2e-4, 1.0, 0.9, 1.0)


def a_diagnosis() -> Diagnosis:
    """A soft floor, named."""
    size = Estimate("compliance", 2e-4, 1e-5, 1.8e-4, 2.2e-4, "m/N", "2.00 ± 0.10 mm per 10 N")
    cells = tuple(Cell("floor, stick", channel, "mean", 1.5, 9) for channel in ("x", "z", "phi"))
    return Diagnosis(
        "named",
        "the floor yields 2.00 ± 0.10 mm per 10 N",
        effects=(NamedEffect("floor_compliance", (size,), "the floor yields"),),
        candidates=(
            Candidate("floor_compliance", 1, 30.0, (1.0, 2.0), "accepted: gain 30.0"),
            Candidate("adhesion", 1, float("nan"), (), "not excited: lift-off"),
        ),
        gap=(a_gap("all", 50),),
        gap_by_contact=(a_gap("floor and wall", 7),),
        share_closed=0.95,
        share_closed_low=0.9,
        share_closed_high=0.99,
        share_closed_typical=0.5,
        held_out="fresh episodes",
        cells_before=cells,
        cells_after=cells,
        unexplained_before=0.1,
        unexplained_after=0.0,
        theta_before=(Estimate("friction", 0.3, 0.01, 0.28, 0.32, "1"),),
        theta_after=(Estimate("friction", 0.32, 0.02, 0.29, 0.35, "1"),),
        detection_limits=(Limit("adhesion", "force", float("inf"), "none", "needs lift-off"),),
        coverage=dict.fromkeys(NEEDED, 1.0),
    )


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An episode too short for a diagnosis."""
    folder = tmp_path_factory.mktemp("short")
    words = ("--outline", "mug", "--truth", "quasistatic", "--policy", "diagnosis", "--steps", "6")
    assert call("simulate", *words, "--name", "a", "--out", str(folder)) == 0
    return folder


def test_too_little_data_has_a_verdict_and_an_exit_code_of_its_own(
    world: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = world / "run"
    words = (str(world / "a.csv"), "--prior", PRIOR, "--out", str(out))
    assert call("diagnose", *words) == 14
    assert "verdict: not enough information: 6 transitions" in capsys.readouterr().out
    verdict = json.loads((out / "verdict.json").read_text())
    assert verdict["verdict"] == "not_enough_information" and verdict["effects"] == []
    assert "not enough information" in (out / "report.html").read_text()
    assert (out / "config.yaml").is_file() and (out / "versions.json").is_file()
    assert call("diagnose", "--compare", str(out), str(out)) == 0
    assert capsys.readouterr().out.count("not enough information") == 2
    kept = world / "side by side"
    assert call("diagnose", "--compare", str(out), str(out), "--out", str(kept)) == 0
    table = json.loads((kept / "results.json").read_text())["table"]
    assert [row["verdict"] for row in table] == 2 * ["not enough information"]
    assert call("diagnose", "--compare", str(out), "--out", str(kept)) == 2
    assert "is not empty" in capsys.readouterr().err


def test_bad_input_is_one_line(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episode = str(world / "a.csv")
    for words, expected in (
        ((), "give episodes to diagnose, or runs to --compare"),
        ((episode, "--model", str(world / "none.yaml")), "none.yaml: no such file"),
        ((episode, "--candidates", str(world / "none.py")), "none.py: no such file"),
        (("--compare", str(world)), "verdict.json: no such file"),
    ):
        assert call("diagnose", *words, "--out", str(world / "bad")) == 2
        error = capsys.readouterr().err.strip()
        assert expected in error and "\n" not in error
    assert not (world / "bad").exists()


def test_a_stopped_run_keeps_its_fits_and_goes_on(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Memory] = []

    def stopped(*arguments: object) -> Diagnosis:
        memory = arguments[-1]
        assert isinstance(memory, Memory) and memory.folder is not None
        told.append(memory)
        if len(told) == 1:
            memory.recall("a fit", ("one",), Candidate, lambda: Candidate("a", 1, 2.0))
            raise KeyboardInterrupt
        assert (
            memory.recall("a fit", ("one",), Candidate, lambda: Candidate("b", 1, 2.0)).name == "a"
        )
        return replace(a_diagnosis(), gap=())

    monkeypatch.setattr("tpcd.discrepancy.search.diagnose", stopped)
    out = tmp_path / "run"
    words = (str(world / "a.csv"), "--prior", PRIOR, "--out", str(out))
    assert call("diagnose", *words) == 130
    assert "goes on with --resume" in capsys.readouterr().err
    assert call("diagnose", *words, "--resume", "--seed", "5") == 2
    assert "whose seed is not the same" in capsys.readouterr().err
    assert call("diagnose", *words, "--resume") == 10
    assert told[0].salt == told[1].salt and not (out / "fits").exists()
    # Code that was changed made other fits, committed or not.
    monkeypatch.setattr("tpcd.commands.diagnosing.tpcd.__file__", str(tmp_path / "__init__.py"))
    (tmp_path / "sampler.py").write_text("DRAWS = 1\n")
    salt = fits_of(out, ()).salt
    (tmp_path / "sampler.py").write_text("DRAWS = 2\n")
    assert len({salt, fits_of(out, ()).salt, told[0].salt}) == 3
    assert call("diagnose", *words, "--resume") == 2
    assert "has its verdict" in capsys.readouterr().err


def test_what_was_added_later_is_shown_as_it_was_then() -> None:
    from tpcd.commands.diagnosis_figures import shown_candidates

    candidates = (
        Candidate("finer_steps", 0, 40.0),
        Candidate("floor_compliance", 1, 119.0, (), "accepted: gain 119.0"),
        Candidate("wall_compliance", 1, 28.6),
        Candidate("grasp_slip", 1, float("nan"), (), "not excited: places"),
        Candidate("wall_compliance", 2, 31.5, (), "accepted: gain 31.5"),
        Candidate("floor_tilt", 2, 9.0, (), "rejected: gain 9.0"),
    )
    shown = shown_candidates(replace(a_diagnosis(), candidates=candidates))
    assert [(c.name, c.round) for c in shown] == [("floor_compliance", 1), ("wall_compliance", 2)]


def test_the_page_holds_everything_in_one_file(tmp_path: Path) -> None:
    from torch.utils.tensorboard import SummaryWriter

    from tpcd.commands.diagnosing import write_diagnosis
    from tpcd.commands.diagnosis_figures import draw_diagnosis
    from tpcd.figures.sinks import save_figure

    found = a_diagnosis()
    figures = draw_diagnosis(found, [], 6.0)
    assert set(figures) == {"residuals", "evidence", "gap", "theta"}
    for name, (figure, caption) in figures.items():
        assert caption and save_figure(figure, tmp_path, name).stat().st_size > 5000
    with SummaryWriter(tmp_path / "tensorboard") as writer:
        page = write_diagnosis(found, [], 6.0, PRIOR, tmp_path, writer).read_text()
    for text in (
        *(
            "2.00 ± 0.10 mm per 10 N",
            "all channels: 95 % (90 to 99); in typical rows 50 %",
            "needs lift-off",
            "30.0",
        ),
        *("floor and wall (7)", "z [mm]", "0.400 (0.300 to 0.500)", "100 % (90 to 100)"),
    ):
        assert text in page
    written = json.loads((tmp_path / "verdict.json").read_text())
    assert set(written["evidence"]) == {"before", "after", "candidates"}
    assert written["evidence"]["candidates"][0]["name"] == "floor_compliance"
    assert written["gap_by_contact"][0]["contact"] == "floor and wall"
    assert "http" not in page.replace("http-equiv", "")
