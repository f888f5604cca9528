"""A run finds the prior that it was made with: from any folder, after a move, by its weights."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from command_calls import PRIOR, call
from short_episode import short_episode

from tpcd.data.files import write_episode
from tpcd.errors import CheckpointError, RunError
from tpcd.files import read_json
from tpcd.results import resumed_run, run_folder
from tpcd.shape.checkpoint import find_prior, load_prior, prior_record, recorded_prior


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with a prior of its own and a folder for runs."""
    shutil.copytree(PRIOR, tmp_path / "project" / "priors" / "mine")
    (tmp_path / "project" / "runs" / "mug").mkdir(parents=True)
    return tmp_path / "project"


def test_a_prior_named_from_one_folder_is_found_from_another(
    project: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run = project / "runs" / "mug"
    for folder, name in ((project, "priors/mine"), (run, "../../priors/mine")):
        monkeypatch.chdir(folder)
        record = prior_record(name, Path("."))
        monkeypatch.chdir(tmp_path)
        assert recorded_prior(record, folder) == project / "priors" / "mine"


def test_what_lies_in_checkpoints_of_a_folder_is_found_from_elsewhere(
    project: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (project / "priors").rename(project / "checkpoints")
    monkeypatch.chdir(project)
    record = prior_record("mine", Path("runs/mug"))
    monkeypatch.chdir(tmp_path)
    assert recorded_prior(record, project / "runs" / "mug") == project / "checkpoints" / "mine"


def test_a_prior_that_was_moved_with_the_run_is_found(project: Path) -> None:
    record = prior_record(project / "priors" / "mine", project / "runs" / "mug")
    moved = project.rename(project.with_name("elsewhere"))
    found = recorded_prior(record, moved / "runs" / "mug")
    assert found.resolve() == moved / "priors" / "mine"


def test_a_shipped_prior_is_its_name_and_no_other_of_that_name_is_taken_for_it(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = prior_record(PRIOR, project / "runs" / "mug")
    assert record["prior"] == "ycb21-z2"
    shutil.copytree(find_prior("ycb-rich"), project / "ycb21-z2")
    monkeypatch.chdir(project)
    found = recorded_prior({**record, "prior_from_here": "nowhere"}, project / "runs" / "mug")
    assert found == Path(PRIOR)


def test_a_prior_that_is_gone_or_has_changed_is_refused(project: Path) -> None:
    run, prior = project / "runs" / "mug", project / "priors" / "mine"
    record = prior_record(prior, run)
    shutil.rmtree(prior)
    gone = f"^{prior}: holds no prior any more, but {run} was made with it; put the prior back"
    with pytest.raises(CheckpointError, match=gone):
        recorded_prior(record, run)
    shutil.copytree(find_prior("ycb-rich"), prior)
    with pytest.raises(CheckpointError, match=f"{prior}.*: has other weights than when {run} was"):
        recorded_prior(record, run)


def test_predict_finds_the_prior_from_another_folder_and_a_stopped_run_goes_on_from_there(
    project: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys
) -> None:
    write_episode(short_episode(3), project / "mug")
    monkeypatch.chdir(project)
    words = ("--particles", "50", "--out")
    assert call("estimate", "mug.csv", "--prior", "priors/mine", *words, "runs/it") == 0
    assert read_json(project / "runs" / "it" / "versions.json")["folder"] == str(project)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    run = str(project / "runs" / "it")
    assert call("predict", run, "../project/mug.csv", "--out", "p.csv") == 0
    (project / "runs" / "it" / "results.json").unlink()
    again = ("../project/mug.csv", "--prior", "../project/priors/mine", *words, run, "--resume")
    assert call("estimate", *again) == 0
    capsys.readouterr()
    (project / "runs" / "it" / "results.json").unlink()
    other = ("../project/mug.csv", "--prior", "ycb21-z2", *words, run, "--resume")
    assert call("estimate", *other) == 2
    assert "holds a run whose prior is not the same" in capsys.readouterr().err
    moved = project.rename(tmp_path / "moved")
    assert (
        call("predict", str(moved / "runs" / "it"), str(moved / "mug.csv"), "--out", "q.csv") == 0
    )
    assert (elsewhere / "p.csv").read_bytes() == (elsewhere / "q.csv").read_bytes()


def test_entries_that_name_the_same_files_from_two_folders_are_the_same(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        (project / name).write_text("")
    monkeypatch.chdir(project)
    with run_folder("run", "x", {"files": [Path("a"), Path("b")], "name": "a"}):
        pass
    monkeypatch.chdir(project / "runs")
    with resumed_run("../run", {"files": [Path("../a"), Path("../b")], "name": "../a"}):
        pass
    monkeypatch.chdir(project)
    with resumed_run("run", {"files": [Path("a"), Path("b")], "name": "a"}):
        pass
    for files in (["a"], ["b", "a"], ["a", "nowhere"]):
        with (
            pytest.raises(RunError, match="whose files is not the same"),
            resumed_run("run", {"files": files, "name": "a"}),
        ):
            pass


def test_a_belief_is_read_with_its_prior(project: Path) -> None:
    place = recorded_prior(prior_record(PRIOR, project), project)
    assert load_prior(place).card["weights_sha256"] == load_prior(PRIOR).card["weights_sha256"]
