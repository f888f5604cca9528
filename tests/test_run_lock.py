"""A run owns its folder: no other process gets it while work in it goes on, and none is held up by
a process that is gone."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from command_calls import PRIOR, ROOT, call
from short_episode import short_episode

from eval.opened import shared_run
from tpcd.commands.estimation import EstimationRun
from tpcd.data.files import write_episode
from tpcd.errors import RunError
from tpcd.ownership import owned
from tpcd.results import resumed_run, run_folder, write_results

HOLD = """
import sys
from pathlib import Path
from tpcd.results import resumed_run, run_folder
folder, how = sys.argv[1:]
opened = resumed_run(folder, {}) if how == "resume" else run_folder(
    folder, "scripts/held.py", {}, overwrite=True, resumable="state")
with opened as run:
    (run / "mine").write_text("half")
    print("begun", flush=True)
    sys.stdin.readline()
print("done", flush=True)
"""
SLOW_ESTIMATE = """
import sys
sys.path[:0] = ["tests"]
from command_calls import call
from tpcd.commands.estimation import EstimationRun
add, EstimationRun._close = EstimationRun.add, lambda *_: None
def slowly(self, step, *rest):
    if step.index == 1:
        print("begun", flush=True)
        sys.stdin.readline()
    add(self, step, *rest)
EstimationRun.add = slowly
sys.exit(call("estimate", *sys.argv[1:]))
"""


@contextmanager
def working(*arguments: str, code: str = HOLD) -> Iterator[subprocess.Popen[str]]:
    """A process that has a folder, until a line is written to it."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment,
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line == "begun\n", process.communicate()
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str]) -> int:
    """The exit code of a process that may end now."""
    process.communicate("\n", timeout=300)
    return process.returncode


def finished_run(folder: Path) -> Path:
    with run_folder(folder, "x", {}) as run:
        (run / "belief").write_text("whole")
        write_results(run, [])
    return run


def test_of_two_estimates_into_one_folder_the_second_is_refused_and_the_first_is_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EstimationRun, "_close", lambda *_: None)  # as in the other process
    write_episode(short_episode(3), tmp_path / "mug")
    run, alone = tmp_path / "run", tmp_path / "alone"
    words = (str(tmp_path / "mug.csv"), "--prior", PRIOR, "--particles", "50")
    finished_run(run)
    first = (*words, "--seed", "1", "--overwrite", "--out", str(run))
    with working(*first, code=SLOW_ESTIMATE) as process:
        for second in ("--overwrite", "--resume"):
            assert call("estimate", *words, "--seed", "2", second, "--out", str(run)) == 2
            *_, told = capsys.readouterr().err.splitlines()
            assert f"{run}: is in use by scripts/estimate.py (process {process.pid} on " in told
            assert "wait until it is done, or name another folder" in told
        assert ended(process) == 0
    assert call("estimate", *words, "--seed", "1", "--out", str(alone)) == 0
    results = [json.loads((folder / "results.json").read_text()) for folder in (run, alone)]
    assert results[0]["seeds"] == [1] and results[0]["table"] == results[1]["table"]
    assert yaml.safe_load((run / "config.yaml").read_text())["seed"] == 1
    assert len((run / "steps.jsonl").read_text().splitlines()) == 3
    beliefs = [(folder / "belief.safetensors").read_bytes() for folder in (run, alone)]
    assert beliefs[0] == beliefs[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "alone",
        "mug.csv",
        "mug.yaml",
        "run",
    ]


@pytest.mark.parametrize("how", ["new", "resume"])
def test_a_run_that_goes_on_is_not_gone_on_with_by_another(tmp_path: Path, how: str) -> None:
    run = tmp_path / "run"
    if how == "resume":
        (finished_run(run) / "results.json").unlink()
    with working(str(run), how) as process:
        with pytest.raises(RunError, match="is in use by"), resumed_run(run, {}):
            pass
        assert ended(process) == 0
    with resumed_run(run, {}):
        pass


@pytest.mark.parametrize("name", ["run", "../deep/run", "link", "link/../run"])
def test_a_folder_is_the_same_by_all_its_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "link").symlink_to("run")
    monkeypatch.chdir(tmp_path / "deep")
    with (
        working(str(tmp_path / "deep" / "run"), "new"),
        pytest.raises(RunError, match=f"^{name}: is in use by scripts/held.py"),
        run_folder(name, "x", {}, overwrite=True),
    ):
        pass


def test_the_lock_of_a_killed_process_holds_nobody_up(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with working(str(run), "new") as process:
        process.kill()
        process.wait()
        assert (tmp_path / ".run.lock").is_file()
    with run_folder(run, "x", {}, overwrite=True) as folder:
        assert not (folder / "mine").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_a_killed_process_was_about_to_replace_comes_back(tmp_path: Path) -> None:
    run = finished_run(tmp_path / "run")
    with working(str(run), "new") as process:
        process.kill()
    assert (run / "mine").is_file() and not (run / "belief").exists()
    with pytest.raises(RunError, match="is not empty"), run_folder(run, "x", {}):
        pass
    assert (run / "belief").read_text() == "whole" and not (run / "mine").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("left", ["state", "results.json"])
def test_what_a_killed_process_replaced_is_gone_once_the_new_run_can_go_on(
    tmp_path: Path, left: str
) -> None:
    run = finished_run(tmp_path / "run")
    with working(str(run), "new") as process:
        (run / left).write_text("{}")
        process.kill()
    if left == "state":
        with resumed_run(run, {}):
            pass
    else:
        with pytest.raises(RunError, match="is not empty"), run_folder(run, "x", {}):
            pass
    assert (run / "mine").is_file() and not (run / "belief").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_folder_within_one_in_use_or_around_one_is_refused(tmp_path: Path) -> None:
    outer = finished_run(tmp_path / "outer")
    inner = outer / "deep" / "inner"
    with (
        working(str(outer), "new"),
        pytest.raises(RunError, match=f"lies in {outer}, which is in use by scripts/held.py"),
        run_folder(inner, "x", {}),
    ):
        pass
    # That one was killed and has left an earlier run to come back in place of what it began.
    for _ in range(2):
        with working(str(inner), "new") as process:
            with (
                pytest.raises(RunError, match=f"holds {inner}, which is in use by"),
                run_folder(outer, "x", {}, overwrite=True),
            ):
                pass
            assert (inner / "mine").is_file() and ended(process) == 0
        with run_folder(outer, "x", {}, overwrite=True):
            pass


def test_what_a_run_starts_may_work_in_a_folder_of_its_own_within(tmp_path: Path) -> None:
    with run_folder(tmp_path / "run", "x", {}) as run:
        with working(str(run / "part"), "new") as process:
            assert ended(process) == 0
        with run_folder(run / "other", "x", {}):
            pass


def test_what_is_done_or_fails_leaves_no_lock_and_no_folder_on_the_way(tmp_path: Path) -> None:
    for reason in (None, ValueError, KeyboardInterrupt):
        with (
            pytest.raises(reason or ZeroDivisionError),
            owned(tmp_path / "deep" / "deeper" / "run", "x"),
        ):
            assert (tmp_path / "deep" / "deeper" / ".run.lock").is_file()
            raise reason or ZeroDivisionError
        assert list(tmp_path.iterdir()) == []


def test_of_many_that_start_at_once_each_has_the_folder_alone(tmp_path: Path) -> None:
    code = """
import sys, time
from tpcd.errors import RunError
from tpcd.results import run_folder
sys.stdin.readline()
try:
    with run_folder(sys.argv[1], "x", {"me": int(sys.argv[2])}, overwrite=True) as run:
        (run / "me").write_text(sys.argv[2])
        time.sleep(1.0)
        print((run / "me").read_text())
except RunError as error:
    print("refused" if "is in use by" in str(error) else error)
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", code, str(tmp_path / "new" / "run")]
    starts = [
        subprocess.Popen(
            [*words, str(i)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for i in range(6)
    ]
    time.sleep(1.0)
    for process in starts:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    told = [process.communicate(timeout=100)[0].strip() for process in starts]
    alone = [i for i, text in enumerate(told) if text == str(i)]
    assert alone and all(text == "refused" for i, text in enumerate(told) if i not in alone), told
    folder = tmp_path / "new" / "run"
    kept = yaml.safe_load((folder / "config.yaml").read_text())["me"]
    assert (folder / "me").read_text() == str(kept) and kept in alone
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["run"]


def test_where_the_system_locks_no_files_a_file_with_its_owner_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_lock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    code = f"import fcntl, errno, os\ndef no_lock(*_): raise OSError({errno.ENOLCK}, 'none')\n"
    code += "fcntl.flock = no_lock\n" + HOLD
    monkeypatch.setattr(fcntl, "flock", no_lock)
    run = tmp_path / "run"
    with working(str(run), "new", code=code) as process:
        for folder in (run, run / "inner"):
            with (
                pytest.raises(RunError, match="is in use by scripts/held.py"),
                run_folder(folder, "x", {}, overwrite=True),
            ):
                pass
        assert "the system locks no files there" in capsys.readouterr().err
        process.kill()
    with run_folder(run, "x", {}, overwrite=True):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_files_that_belong_together_are_of_one_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = """
import sys
from tpcd.ownership import owned
with owned(sys.argv[1], "scripts/simulate.py"):
    print("begun", flush=True)
    sys.stdin.readline()
"""
    words = ("--outline", "mug", "--truth", "quasistatic", "--steps", "1", "--name", "mug")
    with working(str(tmp_path / "mug"), code=code):
        assert call("simulate", *words, "--out", str(tmp_path), "--overwrite") == 2
        assert "mug: is in use by scripts/simulate.py" in capsys.readouterr().err
        assert call("simulate", *words[:-1], "other", "--out", str(tmp_path)) == 0


def test_processes_that_share_the_work_share_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Config:
        out, resume = tmp_path / "run", False

    with working(str(tmp_path / "run"), "new"):
        monkeypatch.setenv("LOCAL_RANK", "1")
        with shared_run(Config, "x", ()) as folder:
            assert folder == tmp_path / "run"
        monkeypatch.setenv("LOCAL_RANK", "0")
        with pytest.raises(RunError, match="is in use by"), shared_run(Config, "x", ()):
            pass
