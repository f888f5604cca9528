"""scripts/robot.py on an emulated arm: an experiment, a fault and resuming, bad input."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, load_script
from robot_bench import SURFACE, emulator_settings

from tpcd.data.files import read_episode
from tpcd.robot.emulator import emulated_scene
from tpcd.robot.emulator.process import running_emulator

pytest.importorskip("rtde_control")


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
    assert len(episode) == 16
    assert len(list((out / "raw").glob("row_*.parquet"))) == 15
    summary = json.loads((out / "summary.json").read_text())["parameters"]
    theta = emulated_scene(emulator).theta
    # The model's floor is rigid and the prior a small one: near the truth, not within intervals.
    assert summary["floor_height"]["mean"] == pytest.approx(theta["floor_height"], abs=0.01)
    assert summary["wall_position"]["mean"] == pytest.approx(theta["wall_position"], abs=0.02)
    assert summary["friction"]["mean"] == pytest.approx(theta["friction"], abs=0.15)


def test_a_fault_in_the_command_is_one_line_and_goes_on_with_resume(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    failing = emulator_settings(fault="protective_stop", fault_after=23.0)
    arguments = (
        "--origin", *map(str, failing.origin), "--yes", "--surface_mm_per_10n", str(SURFACE),
        "--stale_time", "1", "--prior", PRIOR, "--policy", "random", "--out", str(out),
        "--steps", "5",
    )  # fmt: skip
    with running_emulator(failing):
        assert robot_command("--robot", failing.address, *arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1 and "protective stop" in lines[0] and "--resume" in lines[0]
    before = read_episode(out / "explore.csv")
    assert 2 <= len(before) < 6  # A start takes 14 s
    sound = emulator_settings()
    with running_emulator(sound):
        assert robot_command("--robot", sound.address, *arguments, "--resume") == 0
    after = read_episode(out / "explore.csv")
    assert len(after) == 6
    torch.testing.assert_close(after.poses[: len(before)], before.poses)
    assert len((out / "steps.jsonl").read_text().splitlines()) == 5


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
