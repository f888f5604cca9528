"""What a console cannot show or take any more costs neither the work nor its exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_calls import ROOT

COMMAND = """
import sys
from dataclasses import dataclass
from pathlib import Path
from tpcd.cli import run

@dataclass(frozen=True)
class Settings:
    done: Path
    code: int = 0

def work(config):
    \"\"\"Print much, then do the work.\"\"\"
    print("tau [N·m], 3 µm ± 2°, x² → Σ", flush=True)
    print("3 µm", file=sys.stderr, flush=True)
    for _ in range(20000):
        print("a line that a pipe has no room for")
    config.done.write_text("done")
    if config.code == 1:
        raise ValueError("30 N·m is too much")
    return config.code

run(work, Settings, prog="work")
"""


def output(
    *arguments: str, shell: str = "", **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run the command, through a line of shell in which "$@" stands for it."""
    program = Path(arguments[1]).with_name("work.py")
    program.write_text(COMMAND, encoding="utf-8")
    words = [sys.executable, str(program), *arguments]
    if shell:
        words = ["bash", "-c", shell, "bash", *words]
    own = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    return subprocess.run(
        words,
        env=own,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        timeout=100,
    )


PLAIN = {
    "encoding": {"PYTHONIOENCODING": "ascii"},
    "locale": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
}


@pytest.mark.parametrize("console", PLAIN)
def test_a_plain_console_gets_plain_characters(tmp_path: Path, console: str) -> None:
    found = output("--done", str(tmp_path / "done"), **PLAIN[console])
    assert (found.returncode, found.stderr) == (0, "3 um\n")
    assert found.stdout.splitlines()[0] == "tau [N*m], 3 um +- 2 deg, x^2 -> \\u03a3"
    assert (tmp_path / "done").is_file()


def test_a_console_of_all_characters_gets_them(tmp_path: Path) -> None:
    found = output("--done", str(tmp_path / "done"), PYTHONIOENCODING="utf-8")
    assert found.stdout.startswith("tau [N·m], 3 µm ± 2°, x² → Σ\n") and found.stderr == "3 µm\n"


@pytest.mark.parametrize("code", [0, 13])
def test_a_reader_that_has_had_enough_changes_nothing(tmp_path: Path, code: int) -> None:
    told = ' | head -1; exit "${PIPESTATUS[0]}"'
    words = ("--done", str(tmp_path / "done"), "--code", str(code))
    for shell in ('"$@"' + told, '"$@" 2>&1 >/dev/null' + told, '"$@" 2>&1' + told):
        found = output(*words, shell=shell)
        assert (found.returncode, found.stdout.count("\n")) == (code, 1)
        assert "Broken pipe" not in found.stderr and "Exception" not in found.stderr
        (tmp_path / "done").unlink()


def test_a_full_disk_behind_the_output_is_told_once_the_work_is_done(tmp_path: Path) -> None:
    words = ("--done", str(tmp_path / "done"))
    found = output(*words, shell='"$@" > /dev/full')
    assert found.returncode == 2 and (tmp_path / "done").is_file()
    told = "No space left on device; free some space; not all could be printed"
    assert found.stderr.splitlines() == ["3 µm", f"work: standard output: {told}"]
    assert output(*words, "--code", "13", shell='"$@" > /dev/full').returncode == 13
    assert output(*words, shell='"$@" 2> /dev/full').returncode == 0


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_without_a_console_the_work_is_done_all_the_same(tmp_path: Path, closed: str) -> None:
    found = output("--done", str(tmp_path / "done"), shell=f'"$@" {closed}')
    assert found.returncode == 0 and (tmp_path / "done").is_file()


def test_errors_are_told_on_a_plain_console(tmp_path: Path) -> None:
    words = ("--done", str(tmp_path / "done"), "--code", "1")
    found = output(*words, PYTHONIOENCODING="ascii:strict")
    assert found.returncode == 2
    assert found.stderr.splitlines()[-1] == "work: error: 30 N*m is too much"


def test_simulate_and_its_help_end_well_on_a_plain_console(tmp_path: Path) -> None:
    own = os.environ | PLAIN["locale"] | {"PYTHONPATH": str(ROOT)}
    words = [sys.executable, str(ROOT / "scripts" / "simulate.py")]
    found = [
        subprocess.run([*words, *more], env=own, capture_output=True, timeout=100)
        for more in (
            ("--outline", "mug", "--truth", "quasistatic", "--steps", "1", "--out", str(tmp_path)),
            ("--help",),
        )
    ]
    assert [one.returncode for one in found] == [0, 0], [one.stderr for one in found]
    assert b" * mount_x " in found[0].stdout and b"[N*m]" in found[1].stdout
    assert (tmp_path / "rich.csv").is_file()
