"""Result folders: never mixed, never half-written, never silently not finite."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tpcd.errors import FileError, RunError
from tpcd.files import read_json, write_json
from tpcd.results import format_table, run_folder, write_results
from tpcd.targets import check_target


@dataclass(frozen=True)
class Settings:
    prior: Path
    seeds: tuple[int, ...] = (1, 2)


def open_run(*arguments: object, **named: object) -> Path:
    """A run whose work is done at once."""
    with run_folder(*arguments, **named) as folder:  # type: ignore[arg-type]
        return folder


def test_an_opened_run_holds_configuration_and_versions(tmp_path: Path) -> None:
    folder = open_run(tmp_path / "deep" / "run", "scripts/x.py", Settings(Path("p.safetensors")))
    saved = yaml.safe_load((folder / "config.yaml").read_text())
    assert saved == {"prior": "p.safetensors", "seeds": [1, 2]}
    versions = read_json(folder / "versions.json")
    assert versions["command"] == "scripts/x.py"
    assert versions["packages"]["numpy"] == np.__version__
    assert {"tpcd", "git", "python", "hardware", "date_utc"} <= versions.keys()


def test_a_folder_with_content_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("do not lose me")
    for overwrite in (False, True):
        with pytest.raises(RunError, match="not"):
            open_run(tmp_path, "x", {}, overwrite=overwrite)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("named", ["explore.csv", "explore", "raw/log.csv", "raw", "."])
def test_a_run_that_holds_what_the_command_reads_is_not_overwritten(
    tmp_path: Path, named: str
) -> None:
    run = open_run(tmp_path / "run", "x", {})
    (run / "raw").mkdir()
    for file in ("explore.csv", "raw/log.csv"):
        (run / file).write_text("measured once")
    for config in ({"out": run, "episode": run / named}, {"out": run, "logs": (str(run / named),)}):
        with pytest.raises(RunError, match="which would be removed"):
            open_run(run, "x", config, overwrite=True)
        assert (run / "explore.csv").is_file() and (run / "raw" / "log.csv").is_file()
    open_run(run, "x", {"out": run, "episode": tmp_path / "elsewhere.csv"}, overwrite=True)
    assert not (run / "explore.csv").exists()


def test_a_target_is_no_file_that_is_read(tmp_path: Path) -> None:
    file = tmp_path / "test_0.csv"
    file.write_text("measured once")
    check_target(file, overwrite=True, inputs=[tmp_path / "other.csv"])
    with pytest.raises(RunError, match="is what the command reads"):
        check_target(file, overwrite=True, inputs=[tmp_path / "x" / ".." / "test_0.csv"])


def test_overwriting_leaves_nothing_of_the_earlier_run(tmp_path: Path) -> None:
    folder = open_run(tmp_path / "run", "x", {})
    (folder / "old.png").write_bytes(b"")
    with pytest.raises(RunError, match="--overwrite"):
        open_run(folder, "x", {})
    open_run(folder, "x", {}, overwrite=True)
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "versions.json"}


def test_a_file_in_the_way_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.write_text("")
    with pytest.raises(RunError, match="is a file"):
        open_run(path, "x", {}, overwrite=True)


@pytest.mark.parametrize("reason", [ValueError, KeyboardInterrupt])
def test_a_run_that_does_not_end_leaves_what_was_there_before(tmp_path: Path, reason) -> None:
    new, earlier = tmp_path / "deep" / "run", tmp_path / "earlier"
    (open_run(earlier, "x", {}) / "belief").write_text("kept")
    for folder, overwrite in ((new, False), (earlier, True)):
        with pytest.raises(reason), run_folder(folder, "x", {}, overwrite) as inside:
            (inside / "half").write_text("")
            raise reason
    assert [path.name for path in tmp_path.iterdir()] == ["earlier"]
    names = {"belief", "config.yaml", "versions.json"}
    assert {path.name for path in earlier.iterdir()} == names


def test_what_is_interrupted_says_where_it_stands_and_how_it_goes_on(tmp_path: Path) -> None:
    def stopped(*said: str) -> str:
        with (
            pytest.raises(KeyboardInterrupt) as caught,
            run_folder(tmp_path / "run", "x", {}, overwrite=True, resumable="kept") as inside,
        ):
            (inside / "kept").write_text("")
            raise KeyboardInterrupt(*said)
        return str(caught.value)

    goes_on = f"{tmp_path / 'run'} goes on with --resume"
    assert stopped() == goes_on
    assert stopped("the arm has retreated") == f"the arm has retreated; {goes_on}"


def test_a_run_that_ends_replaces_the_earlier_one(tmp_path: Path) -> None:
    (open_run(tmp_path / "run", "x", {}) / "old").write_text("")
    with run_folder(tmp_path / "run", "x", {}, overwrite=True) as folder:
        write_results(folder, [{"a": 1}])
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    names = {"config.yaml", "versions.json", "results.json"}
    assert {path.name for path in folder.iterdir()} == names


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path, problem in (
        (tmp_path / "file", "exists already; choose another name or pass --overwrite"),
        (tmp_path / "folder", "is a folder"),
        (tmp_path / "file" / "below.csv", "is a file; name another folder"),
    ):
        with pytest.raises(RunError, match=problem):
            check_target(path)
    check_target(tmp_path / "file", overwrite=True)
    check_target(tmp_path / "new" / "deep.csv")
    assert not (tmp_path / "new").exists()
    with pytest.raises(RunError, match="is a file"), run_folder(tmp_path / "file" / "x", "x", {}):
        pass


def test_results_hold_table_configuration_versions_and_seeds(tmp_path: Path) -> None:
    folder = open_run(tmp_path / "run", "eval.x", {"particles": 10})
    table = [{"object": "mug", "error": np.float64(0.5)}, {"object": "bowl", "error": 1.5}]
    content = read_json(write_results(folder, table, seeds=(7,), seconds=torch.tensor(2.0)))
    assert content["table"] == [{"object": "mug", "error": 0.5}, {"object": "bowl", "error": 1.5}]
    assert content["config"] == {"particles": 10}
    assert (content["seeds"], content["seconds"], content["command"]) == ([7], 2.0, "eval.x")
    assert "non_finite" not in content and "hardware" in content["versions"]


def test_results_need_an_opened_run(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="run_folder"):
        write_results(tmp_path, [])


def test_values_that_are_not_finite_are_flagged(tmp_path: Path) -> None:
    path = write_json(
        tmp_path / "a.json", {"table": [{"mae": math.nan}, {"mae": 1.0}], "b": -math.inf}
    )
    content = json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(name))
    assert content["table"] == [{"mae": None}, {"mae": 1.0}]
    assert content["non_finite"] == ["table[0].mae", "b"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.json", {"kept": True})
    with pytest.raises(TypeError, match="inner.thing"):
        write_json(path, {"inner": {"thing": object()}})
    assert read_json(path) == {"kept": True}
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


def test_reading_names_the_file_and_the_problem(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="nowhere.json: does not exist"):
        read_json(tmp_path / "nowhere.json")
    (tmp_path / "half.json").write_text('{"a": ')
    with pytest.raises(FileError, match="half.json: is not JSON"):
        read_json(tmp_path / "half.json")


def test_a_table_is_aligned_and_keeps_its_units() -> None:
    rows = [
        {"object": "mug", "error [mm]": 0.51234, "closed": True},
        {"object": "bleach bottle", "error [mm]": 12.0, "steps": 3},
    ]
    assert format_table(rows, formats={"error [mm]": ".2f"}).splitlines() == [
        "object         error [mm]  closed  steps",
        "-------------  ----------  ------  -----",
        "mug                  0.51     yes      -",
        "bleach bottle       12.00       -      3",
    ]


def test_a_table_shows_only_the_columns_asked_for() -> None:
    assert format_table([{"a": 1, "b": 2}], columns=["b"]).splitlines()[-1] == "2"
