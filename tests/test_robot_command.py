"""scripts/robot.py on an emulated arm: an experiment, a fault and resuming, bad input."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, call, load_script
from robot_bench import Springy, emulator_settings, springy_commands

from tpcd.data.files import read_episode
from tpcd.errors import RobotError
from tpcd.robot.emulator import emulated_scene
from tpcd.robot.emulator.process import running_emulator
from tpcd.robot.link import Sample

pytestmark = pytest.mark.usefixtures("types_unchecked")

pytest.importorskip("rtde_control")
START = (0.0, 0.06, 0.0)


def robot_command(*arguments: str) -> int:
    from tpcd.cli import run

    module = load_script("robot")
    with pytest.raises(SystemExit) as stopped:
        run(module.explore_with_robot, module.Experiment, list(arguments), prog="robot.py")
    return int(stopped.value.code or 0)


@pytest.mark.slow
def test_the_whole_experiment_of_fifteen_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    emulator = emulator_settings(surface_mm_per_10n=2.0)
    arguments = (
        "--robot", emulator.address, "--origin", *map(str, emulator.origin), "--yes",
        "--surface_mm_per_10n", "2", "--stale_time", "1", "--payload", str(emulator.payload),
        "--prior", PRIOR, "--policy", "random", "--out", str(out),
    )  # fmt: skip
    with running_emulator(emulator):
        assert robot_command(*arguments) == 0, capsys.readouterr().err
    shown = capsys.readouterr()
    assert "all 15 moves are made" in shown.err and "wall_position" in shown.out
    episode = read_episode(out / "explore.csv")
    assert len(episode) == 16 and episode.doubts == ()
    assert len(list((out / "raw").glob("row_*.parquet"))) == 15
    summary = json.loads((out / "summary.json").read_text())["parameters"]
    theta = emulated_scene(emulator).theta
    # The model's floor is rigid and the prior a small one: near the truth, not within intervals.
    assert summary["floor_height"]["mean"] == pytest.approx(theta["floor_height"], abs=0.01)
    assert summary["wall_position"]["mean"] == pytest.approx(theta["wall_position"], abs=0.02)
    assert summary["friction"]["mean"] == pytest.approx(theta["friction"], abs=0.15)


class Struck(Springy):
    """An arm to which something happens in the move after a row was kept."""

    def __init__(self, error: BaseException, row: Path, drift: float = 0.0) -> None:
        super().__init__(START, drift)
        self._error, self._row, self._left = error, row, 20

    def next_sample(self) -> Sample:
        self._left -= self._row.is_file()
        if self._left == 0:
            raise self._error
        return super().next_sample()


def test_a_fault_in_the_command_is_one_line_and_goes_on_with_resume(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    failing = Struck(RobotError("springy: protective stop"), out / "raw" / "row_001.parquet")
    explore = springy_commands(monkeypatch, [failing, Springy(START)], tmp_path)
    assert explore("--steps", "3") == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1 and "protective stop" in lines[0] and "--resume" in lines[0]
    before = read_episode(out / "explore.csv")
    assert len(before) == 2
    assert explore("--steps", "3", "--resume") == 0
    after = read_episode(out / "explore.csv")
    assert len(after) == 4 and after.doubts == ()
    torch.testing.assert_close(after.poses[: len(before)], before.poses)
    assert len((out / "steps.jsonl").read_text().splitlines()) == 3


def test_doubts_of_a_stopped_run_stay_with_it_and_are_told_by_all_that_comes_after(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sensor drifts in the first session, and in the second no more."""
    out = tmp_path / "run"
    drifting = Struck(KeyboardInterrupt(), out / "raw" / "row_002.parquet", drift=0.01)
    explore = springy_commands(monkeypatch, [drifting, Springy(START)], tmp_path)
    assert explore("--steps", "3") == 130
    told = capsys.readouterr().err
    assert "the sensor's zero has drifted: F_z reads " in told and "retreated" in told
    stopped = read_episode(out / "explore.csv")
    assert len(stopped) == 3
    (doubt,) = stopped.doubts
    assert "to 2 are off by 0.0" in str(doubt)
    predict = ("predict", str(out), str(out / "explore.csv"))
    assert call(*predict, "--out", str(tmp_path / "a.csv")) == 0
    assert "was learnt from an episode with doubts: explore.csv was" in capsys.readouterr().err
    assert explore("--steps", "3", "--resume") == 0
    assert str(doubt) in capsys.readouterr().err
    whole = read_episode(out / "explore.csv")
    assert len(whole) == 4 and list(map(str, whole.doubts)) == [str(doubt)]
    assert call(*predict, "--out", str(tmp_path / "b.csv")) == 0
    (line,) = [each for each in capsys.readouterr().err.splitlines() if "with doubts" in each]
    assert line.endswith(f"explore.csv was accepted in spite of 1 doubt: doubt: {doubt}")


def test_an_arm_that_does_not_come_away_at_the_end_of_a_run_is_told_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cable is pulled while the last move is learnt from; what was found is whole."""
    row = tmp_path / "run" / "raw" / "row_001.parquet"
    lost = Struck(RobotError("springy: no new reading for 40 ms"), row)
    lost._left = 1
    explore = springy_commands(monkeypatch, [lost], tmp_path)
    assert explore("--steps", "1") == 0
    told = capsys.readouterr().err
    assert "warning: the arm holds its place, its way back not being free (springy: no new" in told
    assert "all 1 moves are made" in told


def test_no_answer_is_no_yes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Closed(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("sys.stdin", Closed())
    link = Springy(START)
    explore = springy_commands(monkeypatch, [link], tmp_path)
    assert explore(yes=False) == 2
    (line,) = [each for each in capsys.readouterr().err.splitlines() if "error" in each]
    assert "not confirmed" in line and link.sent == 0 and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--floor", "1"), "floor is"),
        (("--origin", "1", "2"), "origin is"),
        (("--policy", "expert", "--origin", "0", "0", "0"), "--expert_wall"),
        (("--policy", "file", "--origin", "0", "0", "0"), "--commands"),
        (("--stop_force", "5", "--origin", "0", "0", "0"), "stop_force is 5 N"),
        ((), "neither origin nor floor"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(
    wrong: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert robot_command("--robot", "127.0.0.9", "--out", str(out), *wrong) == 2
    message = capsys.readouterr().err.strip()
    assert said in message and message.count("\n") == 0
    assert not out.exists()
