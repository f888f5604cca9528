"""The diagnosis motion: simulated as by simulate.py, planned beforehand, and completed."""

from __future__ import annotations

import csv
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from command_calls import call, load_script
from torch import Tensor

from tpcd.cli import parse
from tpcd.data import read_episode
from tpcd.data.episode import Episode
from tpcd.discrepancy.coverage import coverage_of
from tpcd.effects.excitations import MOTIONS
from tpcd.policies.basic import within
from tpcd.policies.limits import Limits
from tpcd.simulator import QuasistaticTruth
from tpcd.truth.diagnosis_plan import Planned, diagnosis_plan
from tpcd.truth.motions import FORCE_LIMIT, LARGEST_TILT

HALF = 0.05
FLOOR_Z, WALL_X = 0.05, 0.1
"""Places of a hand that holds a box of 100 mm in its middle, over a floor at 0 and a wall at
150 mm."""
START = torch.tensor([0.0, 0.12, 0.0], dtype=torch.float64)
STIFFNESS = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
ROUNDED = 1e-6
"""What a file of commands leaves out [m, rad]."""


def commands_of(plan: list[Planned]) -> Tensor:
    return torch.tensor([planned.command for planned in plan], dtype=torch.float64)


def followed(
    plan: list[Planned],
    friction: float = 0.5,
    floor: float = 0.0,
    wall: float = 0.15,
    stiffness: Tensor = STIFFNESS,
) -> Episode:
    """What a box does under the plan."""
    start = torch.tensor(plan[0].command, dtype=torch.float64)
    box = torch.tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]]).double() * HALF
    truth = QuasistaticTruth(box, friction, floor, wall, stiffness)
    truth.reset(start)
    commands = commands_of(plan)
    poses, wrenches = [start], [torch.zeros(3).double()]
    for command in commands[1:]:
        pose, wrench, _ = truth.step(command)
        poses.append(pose)
        wrenches.append(wrench)
    noise = torch.tensor([2e-4, 2e-4, 5e-4, 0.3, 0.3, 0.02], dtype=torch.float64)
    return Episode(commands, torch.stack(poses), torch.stack(wrenches), stiffness, noise)


@pytest.fixture(scope="module")
def plan() -> list[Planned]:
    return diagnosis_plan(START, FLOOR_Z, WALL_X, STIFFNESS, 60, 0.01)


@pytest.mark.parametrize("friction", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("off", [(0.0, 0.0), (0.01, -0.01), (-0.01, 0.01)])
def test_forces_stay_within_the_limit(
    plan: list[Planned], friction: float, off: tuple[float, float]
) -> None:
    episode = followed(plan, friction, off[0], 0.15 + off[1])
    assert float(episode.wrenches[:, :2].abs().max()) <= FORCE_LIMIT + 1e-9
    assert float(episode.commands[:, 2].abs().max()) <= LARGEST_TILT


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.005, -0.005)])
def test_a_plan_excites_what_a_diagnosis_needs(
    plan: list[Planned], off: tuple[float, float]
) -> None:
    found = coverage_of([followed(plan, 0.5, off[0], 0.15 + off[1])])
    assert found.missing(list(MOTIONS)) == []


def test_purposes_say_what_happens(plan: list[Planned]) -> None:
    episode = followed(plan)
    purposes = [planned.purpose for planned in plan]
    assert purposes[0] == "start, free of contact" and purposes[-1] == "lift off, end"
    assert len(plan) == 61
    for planned, pose, wrench, before in zip(
        plan[1:], episode.poses[1:], episode.wrenches[1:], episode.poses[:-1], strict=True
    ):
        if planned.purpose == "press 3.5 N on the floor":
            assert float(wrench[1]) == pytest.approx(3.5, abs=0.1)
        if planned.purpose.startswith("slide right"):
            assert float(pose[0] - before[0]) > 0.01
        if planned.purpose.startswith("slide up"):
            assert float(pose[1] - before[1]) > 0.01
        if "free space" in planned.purpose or "lift" in planned.purpose:
            assert float(wrench.abs().max()) < 1e-6
    assert sum("on the way" in purpose for purpose in purposes) < 8


def test_a_stiff_arm_goes_in_small_steps() -> None:
    stiffness = torch.tensor([400.0, 400.0, 50.0], dtype=torch.float64)
    plan = diagnosis_plan(START, FLOOR_Z, WALL_X, stiffness, 200, 0.005)
    free = [planned for planned in plan if "free" in planned.purpose or "lift" in planned.purpose]
    assert len(plan) == 201 and len(free) > 20
    steps = (commands_of(plan)[1:] - commands_of(plan)[:-1])[:, :2].abs()
    assert float(steps.max()) < 2 * FORCE_LIMIT / 400.0


@pytest.mark.parametrize(
    ("start", "error", "told"),
    [
        ((0.0, 0.055, 0.0), 0.01, "is not free"),
        ((0.12, 0.2, 0.0), 0.01, "is not free"),
        ((0.0, 0.3, 0.0), 0.08, "expected floor and wall to be known within less than 0.079 m"),
    ],
)
def test_a_plan_that_could_harm_is_refused(
    start: tuple[float, ...], error: float, told: str
) -> None:
    wall = 0.1 if error < 0.05 else 0.3
    with pytest.raises(ValueError, match=told):
        diagnosis_plan(torch.tensor(start).double(), FLOOR_Z, wall, STIFFNESS, 60, error)


def test_an_arm_too_stiff_for_any_step_is_refused_for_that() -> None:
    with pytest.raises(ValueError, match="stiffness of 1e.06 N/m a step of 0.001 m alone means"):
        diagnosis_plan(START, FLOOR_Z, WALL_X, 1e4 * STIFFNESS, 30, 0.0)


def test_episodes_of_two_set_ups_lack_nothing_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--object", "mug", "--steps", "2", "--truth", "quasistatic")
    for name, stiffness in (("a", "100"), ("b", "200")):
        more = ("--stiffness", stiffness, stiffness, "50", "--out", str(tmp_path / name))
        assert call("plan_diagnosis", *words, *more) == 0
    given = [str(tmp_path / f"{name}.csv") for name in "ab"]
    assert call("plan_diagnosis", "--after", *given) == 2
    assert "one set-up" in capsys.readouterr().err


def test_a_stiffness_in_newtons_per_millimetre_is_refused() -> None:
    with pytest.raises(ValueError, match="check that the stiffness is in N/m"):
        diagnosis_plan(START, FLOOR_Z, WALL_X, 1e-3 * STIFFNESS, 60, 0.005)


def test_the_command_writes_a_plan(tmp_path: Path) -> None:
    out = tmp_path / "commands.csv"
    words = ("--start", "0", "0.12", "0", "--floor-height", "0.05", "--wall-position", "0.1")
    assert call("plan_diagnosis", *words, "--steps", "20", "--out", str(out)) == 0
    rows = list(csv.DictReader(out.open()))
    assert list(rows[0]) == ["u_x", "u_z", "u_phi", "purpose"] and len(rows) == 21
    assert [float(rows[0][name]) for name in ("u_x", "u_z", "u_phi")] == [0.0, 0.12, 0.0]


@pytest.mark.parametrize("stiffness", [STIFFNESS.tolist(), [50.0, 60.0, 20.0]])
@pytest.mark.parametrize("away", [0.0, 0.2])
def test_the_arm_takes_the_line_and_draws_no_command_back(
    away: float, stiffness: list[float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a plan.csv"
    words = ("--start", str(-away), "0.12", "0", "--floor-height", "0.05", "--wall-position", "0.1")
    given = ("--stiffness", *map(str, stiffness), "--steps", "150", "--out", str(out))
    assert call("plan_diagnosis", *words, *given) == 0
    line = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert line[:2] == ["python", "scripts/robot.py"]
    place = {"ADDRESS": "127.0.0.1", "X": "0.4", "Y": "0", "Z": "0.1", "RUN": str(tmp_path / "run")}
    robot = load_script("robot")
    found = parse(robot.Experiment, [place.get(word, word) for word in line[2:]])
    commands = robot._commands(found.commands)
    assert found.policy == "file" and found.steps == len(commands) - 1
    assert list(robot._settings(found).stiffness) == stiffness
    limits = Limits(found.force_limit, found.step_limit, found.workspace_low, found.workspace_high)
    plan = [Planned(tuple(command), "") for command in commands.tolist()]
    episode = followed(plan, stiffness=torch.tensor(stiffness, dtype=torch.float64))
    for command, pose in zip(commands[1:], episode.poses[:-1], strict=True):
        box = limits.box(pose, episode.stiffness)
        torch.testing.assert_close(within(command, *box), command, rtol=0, atol=ROUNDED)


def test_the_command_simulates_what_simulate_does(tmp_path: Path) -> None:
    common = ("--steps", "4", "--seed", "3", "--truth", "quasistatic")
    assert call("plan_diagnosis", "--object", "mug", *common, "--out", str(tmp_path / "a")) == 0
    words = ("--outline", "mug", "--policy", "diagnosis", "--name", "b", "--out", str(tmp_path))
    assert call("simulate", *words, *common) == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_the_command_says_what_an_episode_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Coverage:
        counts = {"pause": 0.0, "floor load": 4.0}

        def missing(self, needs: list[str]) -> list[str]:
            return [need for need in needs if need == "pause"]

    fake = ModuleType("tpcd.discrepancy.coverage")
    fake.coverage_of = lambda episodes: Coverage()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tpcd.discrepancy.coverage", fake)
    words = ("--object", "mug", "--steps", "2", "--truth", "quasistatic")
    assert call("plan_diagnosis", *words, "--out", str(tmp_path / "a")) == 0
    capsys.readouterr()
    assert call("plan_diagnosis", "--after", str(tmp_path / "a.csv")) == 0
    printed = capsys.readouterr().out
    assert MOTIONS["pause"] in printed and "command_lag" in printed
    assert "1 of 23 effects are hardly excited: command_lag" in printed
    assert "hides" not in printed and "could not" not in printed
    assert len(read_episode(tmp_path / "a.csv")) == 3


BAD = {
    "nothing": ((), "found none of --object, --start and --after"),
    "two things": (("--object", "mug", "--after", "a.csv"), "found object and after of"),
    "no file": (("--object", "mug"), "out missing"),
    "no floor": (("--start", "0", "0.1", "0", "--out", "a"), "a plan needs --floor_height"),
    "two numbers": (("--start", "0", "0.1", "--out", "a"), "start has 2 numbers"),
    "millimetres": (
        ("--start", "0", "120", "0", "--floor-height", "0", "--wall-position", "1", "--out", "a"),
        "start z is 120, expected m",
    ),
    "degrees": (
        ("--start", "0", "0.1", "30", "--floor-height", "0", "--wall-position", "1", "--out", "a"),
        "start phi is 30, expected rad; it looks like degrees",
    ),
    "turned": (
        ("--start", "0", "0.1", "0.5", "--floor-height", "0", "--wall-position", "1", "--out", "a"),
        "start phi is 0.5, expected at most 0.15",
    ),
    "no episode": (("--after", "nowhere.csv"), "nowhere.csv: no such file"),
}


@pytest.mark.parametrize("case", BAD)
def test_the_command_refuses_in_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words, told = BAD[case]
    assert call("plan_diagnosis", *words) == 2
    line = capsys.readouterr().err
    assert line.startswith("plan_diagnosis: error: ") and line.count("\n") == 1
    assert told in line
    assert not any(tmp_path.iterdir())
