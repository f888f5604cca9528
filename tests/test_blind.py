"""Whole runs of the blind benchmark, with a workflow that is made up."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from eval.blind.__main__ import Blind, case_seed, cases_of, run_blind, score
from eval.blind.combine import Combine, combine
from eval.blind.sealing import key_path
from eval.blind.suites import Case
from eval.blind.trial import read_verdicts
from tpcd.discrepancy.diagnosis import Diagnosis, Estimate, NamedEffect
from tpcd.errors import RunError

SEED = 10000


@dataclass(frozen=True)
class Calls:
    """What the made-up workflow was asked, and whether it is to fail."""

    asked: list
    fails: list


@dataclass(frozen=True)
class FakeSettings:
    seed: int = 0
    base_refit: bool = True
    parity: bool = True


@pytest.fixture
def workflow(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """A workflow that always names a force bias, but fails on request."""
    import sys

    calls = Calls([], [])

    def diagnose(episodes, shape, settings=None, fresh=()) -> Diagnosis:
        calls.asked.append((episodes, settings, fresh))
        if len(calls.asked) in calls.fails:
            raise RuntimeError("no luck")
        bias = tuple(Estimate(n, 0.6, 0.1, 0.4, 0.8, "N") for n in ("F_x", "F_z"))
        named = NamedEffect("force_bias", bias, "the wrench is read too high")
        return Diagnosis("named", "a bias", effects=(named,), share_closed=0.95)

    module = SimpleNamespace(DiagnosisSettings=FakeSettings, diagnose=diagnose)
    monkeypatch.setitem(sys.modules, "tpcd.discrepancy.search", module)
    for place in ("trial", "pages"):
        monkeypatch.setattr(f"eval.blind.{place}.load_shape", lambda prior: None)
    return calls


def quick(tmp_path: Path) -> Blind:
    return Blind(out=tmp_path / "blind", quick=True)


def results(config: Blind | Combine) -> dict:
    return json.loads((config.out / "results.json").read_text())


def test_a_run_is_scored_from_its_files_and_seals(tmp_path: Path, workflow: Calls) -> None:
    config = quick(tmp_path)
    run_blind(config)
    assert len(workflow.asked) == 3
    episodes, settings, fresh = workflow.asked[0]
    assert episodes[0].object is None and (len(episodes[0]), len(fresh[0])) == (21, 31)
    assert settings.seed not in (0, config.seed) and settings.parity
    (clean, effects) = results(config)["suites"]
    assert (clean["exact"], clean["wrong name"], clean["runs"]) == (0.0, 1.0, 1)
    assert (effects["exact"], effects["wrong name"], effects["runs"]) == (0.5, 0.5, 2)
    assert {row["outcome"] for row in results(config)["table"]} == {"not run"}
    assert (config.out / "figures" / "confusion-quick.png").stat().st_size > 3000
    assert "force_bias" in (config.out / "confusion-quick.csv").read_text()
    (lines, failed) = read_verdicts(config.out)
    assert failed == [] and all(len(line["key_sha256"]) == 64 for line in lines)
    assert not any("hidden" in line or "label" in line for line in lines)


def test_switches_of_the_workflow_follow_the_suite(tmp_path: Path, workflow: Calls) -> None:
    from eval.blind.trial import run_case

    line = run_case(Case("no_parity", "clean", 0), SEED, "", tmp_path)
    assert "failed" not in line
    assert workflow.asked[0][1] == FakeSettings(seed=workflow.asked[0][1].seed, parity=False)


def test_a_key_that_was_changed_is_found_out(tmp_path: Path, workflow: Calls) -> None:
    config = quick(tmp_path)
    run_blind(config)
    token = cases_of(config)[0].token(case_seed(config))
    path = key_path(config.out, token)
    sealed = path.read_text()
    path.write_text(sealed.replace('"hidden": {}', '"hidden": {"force_bias": {"F_x": 0.6}}'))
    with pytest.raises(RunError, match="not the key that was sealed"):
        score(config)
    path.write_text(sealed)
    score(config)
    episode = config.out / "episodes" / token / "main.csv"
    episode.write_text(episode.read_text() + "\n")
    with pytest.raises(RunError, match="other episodes"):
        score(config)
    path.unlink()
    with pytest.raises(RunError, match="is missing"):
        score(config)


def test_a_failing_case_costs_no_other_and_is_tried_again(
    tmp_path: Path, workflow: Calls, capsys: pytest.CaptureFixture
) -> None:
    config = quick(tmp_path)
    workflow.fails.append(2)
    run_blind(config)
    assert "RuntimeError: no luck" in capsys.readouterr().err
    effects = results(config)["suites"][1]
    assert (effects["runs"], effects["exact"], effects["failed"]) == (2, 0.0, 0.5)
    assert len(results(config)["failed"]) == 1
    run_blind(replace(config, resume=True))
    assert len(workflow.asked) == 4
    assert results(config)["failed"] == []
    assert results(config)["suites"][1]["exact"] == 0.5


def test_a_stopped_run_goes_on_and_more_suites_may_follow(tmp_path: Path, workflow: Calls) -> None:
    config = quick(tmp_path)
    run_blind(config)
    path = config.out / "verdicts-0.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]) + lines[-1][:50])
    run_blind(replace(config, resume=True))
    assert len(workflow.asked) == 4 and len(read_verdicts(config.out)[0]) == 3
    run_blind(replace(config, resume=True, quick=False, suites=("clean",), runs=1))
    assert len(workflow.asked) == 5
    assert {row["suite"] for row in results(config)["suites"]} == {"quick", "clean"}
    with pytest.raises(RunError, match="whose seed is not the same"):
        run_blind(replace(config, resume=True, seed=1))


def test_folders_are_scored_together_and_no_case_counts_twice(
    tmp_path: Path, workflow: Calls, capsys: pytest.CaptureFixture
) -> None:
    first = quick(tmp_path)
    workflow.fails.append(2)
    run_blind(first)
    second = Blind(out=tmp_path / "more", suites=("clean",), runs=1, seed=SEED)
    run_blind(second)
    again = replace(first, out=tmp_path / "again")  # the case that failed has a verdict here
    run_blind(again)
    both = Combine((first.out, second.out, again.out, first.out), tmp_path / "both")
    capsys.readouterr()
    combine(both)
    assert "3 cases are in several folders" in capsys.readouterr().err
    assert len(workflow.asked) == 7  # nothing is diagnosed again
    found = results(both)
    assert [row["runs"] for row in found["suites"]] == [1, 1, 2]
    assert found["seeds"] == [SEED] and len(found["cases"]) == 4 and found["failed"] == []
    assert all(row["failed"] == 0.0 for row in found["suites"])
    assert [Path(run["folder"]).name for run in found["runs"]] == ["blind", "more", "again"]
    assert all("git" in json.dumps(run["versions"]) for run in found["runs"])
    for name in ("detection", "sizes", "confusion-quick", "confusion-clean"):
        assert (both.out / "figures" / f"{name}.png").stat().st_size > 3000


def test_what_cannot_be_scored_together_is_refused(tmp_path: Path, workflow: Calls) -> None:
    one = quick(tmp_path)
    run_blind(one)
    other = Blind(out=tmp_path / "more", suites=("clean",), runs=1, prior="ycb21-z2")
    run_blind(other)
    out = tmp_path / "none"
    for folders, expected in (
        ((one.out, tmp_path), "is no run of python -m eval.blind"),
        ((one.out, other.out), "has the prior ycb21-z2"),
    ):
        with pytest.raises(RunError, match=expected):
            combine(Combine(folders, out))
    path = one.out / "verdicts-0.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(RunError, match="lacks 1 of 3 verdicts"):
        combine(Combine((one.out,), out))
    with pytest.raises(ValueError, match="folders is empty"):
        Combine()
    assert not out.exists()


@pytest.mark.parametrize(
    "wrong",
    [{"suites": ("large",)}, {"suites": ()}, {"runs": 0}],
)
def test_bad_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        Blind(**wrong)
