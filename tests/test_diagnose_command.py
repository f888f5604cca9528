"""scripts/diagnose.py: its exit codes, runs side by side, and runs that were stopped."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from command_calls import PRIOR, call
from made_diagnosis import a_diagnosis

from tpcd.commands.diagnosing import fits_of
from tpcd.commands.gap_rows import shown_data
from tpcd.discrepancy.diagnosis import BLOCKS, Candidate, Diagnosis
from tpcd.discrepancy.memory import Memory


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


def test_blocks_held_out_are_said_to_be_optimistic() -> None:
    fresh, blocks = a_diagnosis(), replace(a_diagnosis(), held_out=BLOCKS)
    assert shown_data(fresh) == fresh.held_out
    told = shown_data(blocks)
    assert told.startswith(blocks.held_out) and "optimistic" in told and "--fresh" in told
