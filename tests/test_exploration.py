"""Exploration end to end: the command, being stopped and going on, and when to stop."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, call

from tpcd.belief import EstimatorSettings, SamplerSettings
from tpcd.belief.belief import EstimationStep
from tpcd.belief.paper import PaperSettings
from tpcd.belief.state import EstimatorState
from tpcd.belief.storage import load_belief
from tpcd.commands.estimation import EstimationRun
from tpcd.commands.exploration_run import Kept, Stopping, expected_error, run_exploration
from tpcd.data.episode import Episode
from tpcd.data.files import read_episode
from tpcd.exploration import Estimator, ExplorationStep, explore
from tpcd.policies import ActivePolicy, ActiveSettings, Limits, Policy, Situation, make_policy
from tpcd.policies.active import Task
from tpcd.policies.protocol import Choice
from tpcd.robot.protocol import Robot
from tpcd.robot.simulated import SimulatedRobot
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.truth.make import make_truth
from tpcd.truth.recording import read_truth
from tpcd.truth.scene import Scene, draw_scene

SMALL = ActiveSettings(first=24, rounds=1, later=12, elite=4, particles=30, finalists=3)
FAST = SamplerSettings(particles=80, draws=500, places=20, fresh_modes=20, prior_draws=300)
CLOSING = replace(FAST, draws=2000, places=80, fresh_modes=80)


@pytest.fixture(scope="module")
def scene() -> Scene:
    outline = builtin_outlines()["mug"]
    return draw_scene("mug", outline.vertices, torch.Generator().manual_seed(31))


def robot_in(scene: Scene) -> SimulatedRobot:
    return SimulatedRobot(make_truth(scene, "quasistatic"), scene, seed=5)


def test_a_simulated_arm_tells_its_noise(scene: Scene) -> None:
    robot = robot_in(scene)
    start = robot.start()
    assert torch.equal(robot.settle(start.commands[0]).sensor_std, start.sensor_std)


def estimator_of(kind: str) -> Estimator:
    return Estimator(
        load_prior("ycb21-z2"),
        kind,  # type: ignore[arg-type]
        EstimatorSettings(sampler=FAST, closing=CLOSING),
        PaperSettings(particles=150),
    )


def policy_of(name: str, scene: Scene) -> Policy:
    if name == "active":
        return ActivePolicy(Limits(), SMALL)
    return make_policy(name, Limits(), scene, seed=2)  # type: ignore[arg-type]


def first_steps(count: int, steps) -> list[ExplorationStep]:
    return [step for step, _ in zip(steps, range(count), strict=False)]


@pytest.mark.parametrize(
    ("kind", "name"), [("default", "active"), ("paper", "grid"), ("default", "random")]
)
def test_an_exploration_that_was_stopped_goes_on_the_same(
    kind: str, name: str, scene: Scene
) -> None:
    estimator = estimator_of(kind)
    whole = first_steps(3, explore(robot_in(scene), policy_of(name, scene), estimator, 4))
    again = explore(
        robot_in(scene), policy_of(name, scene), estimator, 4,
        whole[0].episode, whole[0].estimation.belief, whole[0].estimation.state,
    )  # fmt: skip
    for expected, found in zip(whole[1:], first_steps(2, again), strict=True):
        torch.testing.assert_close(found.episode.commands, expected.episode.commands)
        torch.testing.assert_close(found.episode.poses, expected.episode.poses)
        torch.testing.assert_close(
            found.estimation.belief.vectors, expected.estimation.belief.vectors
        )


def test_rows_that_were_not_learnt_from_come_first(scene: Scene) -> None:
    estimator, policy = estimator_of("default"), policy_of("random", scene)
    whole = first_steps(3, explore(robot_in(scene), policy, estimator, 4))
    again = explore(
        robot_in(scene), policy_of("random", scene), estimator, 4,
        whole[1].episode, whole[0].estimation.belief, whole[0].estimation.state,
    )  # fmt: skip
    for expected, found in zip(whole[1:], first_steps(2, again), strict=True):
        torch.testing.assert_close(
            found.estimation.belief.vectors, expected.estimation.belief.vectors
        )
    torch.testing.assert_close(found.episode.commands, whole[2].episode.commands)


def test_a_simulated_robot_reads_the_truth_with_noise_and_refuses_other_rows(scene: Scene) -> None:
    robot = robot_in(scene)
    assert isinstance(robot, Robot)
    episode = robot.start()
    torch.testing.assert_close(episode.commands[0], scene.start_pose)
    for z in (0.01, 0.03):
        command = scene.start_pose - torch.tensor([0.0, z, 0.0], dtype=torch.float64)
        reading = robot.settle(command)
        episode = episode.with_row(command, reading.pose, reading.wrench)
    recording = robot.recording(episode)
    offset = torch.cat((episode.poses, episode.wrenches), -1) - torch.cat(
        (recording.true.poses, recording.true.wrenches), -1
    )
    score = offset / episode.sensor_std
    assert score.abs().max() < 4 and score.square().mean() > 0.3
    robot_in(scene).resume(episode)
    moved = replace(episode, poses=episode.poses + 1e-3)
    with pytest.raises(ValueError, match="another scene"):
        robot_in(scene).resume(moved)


def test_rows_are_handed_out_before_they_are_learnt_from(scene: Scene) -> None:
    seen: list[int] = []

    class Unlearnable(Estimator):
        def steps(self, *arguments):
            raise ValueError("no particle explains")

    shape = estimator_of("default").shape
    steps = explore(
        robot_in(scene), policy_of("random", scene), Unlearnable(shape), 4,
        on_row=lambda rows: seen.append(len(rows)),
    )  # fmt: skip
    with pytest.raises(ValueError, match="no particle"):
        next(steps)
    assert seen == [2]


def test_it_stops_before_a_move_that_promises_too_little(scene: Scene) -> None:
    estimator, policy = estimator_of("default"), policy_of("active", scene)
    first = next(explore(robot_in(scene), policy, estimator, 4))
    assert first.choice.gain is not None
    robot = robot_in(scene)
    least = 1.1 * first.choice.gain
    assert list(explore(robot, policy, estimator, 4, least_gain=least)) == []
    assert len(robot.recording(robot.start()).true) == 1
    belief = first.estimation.belief
    assert Stopping(steps=5).reason(belief, 1, None) is None
    assert Stopping(steps=1).reason(belief, 1, None) == "all 1 moves are made"


def test_letting_go_of_a_forbidden_load_is_no_reason_to_stop(scene: Scene) -> None:
    """One move is forced upon the policy, after which it sees nothing worth a move."""

    class Forced:
        def choose(self, situation: Situation, generator: torch.Generator) -> Choice:
            here = situation.episode.poses[-1]
            return Choice(here, gain=0.0, forced=len(situation.episode) == 1)

    steps = list(explore(robot_in(scene), Forced(), estimator_of("default"), 4, least_gain=0.1))
    assert len(steps) == 1


ARGUMENTS = ("--outline", "soup_can", "--prior", PRIOR, "--truth", "quasistatic")


def test_the_command_explores_stops_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = partial(EstimatorSettings, sampler=FAST, closing=CLOSING)
    monkeypatch.setattr("tpcd.commands.exploring.EstimatorSettings", few)
    out = tmp_path / "run"
    assert call("explore", *ARGUMENTS, "--steps", "2", "--out", str(out)) == 0
    assert "all 2 moves are made" in capsys.readouterr().err
    rows = [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]
    assert len(rows) == 2 and rows[0]["gain"] > 0
    assert ["closed" in row for row in rows] == [False, True]
    episode = read_episode(out / "explore.csv")
    assert len(episode) == 3
    true, _ = read_truth(out / "explore.csv")
    assert (true.poses - episode.poses).abs().max() < 4e-3
    for name in ("estimation", "outline", "scene"):
        assert (out / "figures" / f"{name}.png").is_file()
    assert json.loads((out / "results.json").read_text())["moves"] == 2
    # Stopped after its last move, it is ended from what it kept.
    (out / "results.json").rename(tmp_path / "results.json")
    (out / "summary.json").unlink()
    assert call("explore", *ARGUMENTS, "--steps", "2", "--out", str(out), "--resume") == 0
    assert json.loads((out / "results.json").read_text())["moves"] == 2
    assert (out / "summary.json").is_file()
    # Asked for more, it goes on from there.
    capsys.readouterr()
    assert call("explore", *ARGUMENTS, "--steps", "2", "--out", str(out), "--resume") == 2
    assert "raise --steps" in capsys.readouterr().err
    assert call("explore", *ARGUMENTS, "--steps", "3", "--out", str(out), "--resume") == 0
    longer: Episode = read_episode(out / "explore.csv")
    torch.testing.assert_close(longer.poses[:3], episode.poses)
    rows = [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]
    assert ["closed" in row for row in rows] == [False, False, True]
    # And comes to what one without a stop comes to.
    whole = tmp_path / "whole"
    assert call("explore", *ARGUMENTS, "--steps", "3", "--out", str(whole)) == 0
    assert torch.equal(read_episode(whole / "explore.csv").commands, longer.commands)
    assert torch.equal(load_belief(whole).vectors, load_belief(out).vectors)
    assert json.loads((out / "results.json").read_text())["config"]["steps"] == 3


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--stop_error", "1e-3"), "needs a task"),
        (("--policy", "expert", "--stop_gain", "1"), "stop_gain needs a policy"),
        (("--force_limit", "0"), "force_limit"),
        (("--step_limit", "0", "0", "0"), "step"),
        (("--step_limit", "80", "80", "0.3"), "step_limit is 80, expected at most 5"),
        (("--workspace_low", "1", "1", "1"), "workspace"),
        (("--policy", "brave"), "policy"),
        (("--task", "nowhere.csv"), "nowhere.csv"),
        (("--resume", "--overwrite"), "give --resume or --overwrite, not both"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(
    wrong: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert call("explore", *ARGUMENTS, "--out", str(out), *wrong) == 2
    message = capsys.readouterr().err.strip()
    assert said in message and message.count("\n") == 0
    assert not out.exists()


def test_the_arm_lets_go_before_the_closing_draws(scene: Scene, tmp_path: Path) -> None:
    estimator, robot = estimator_of("default"), robot_in(scene)
    order: list[str] = []

    def closing(episode: Episode, state: EstimatorState) -> EstimationStep:
        order.append(f"closed after {len(episode) - 1}")
        assert estimator.closing is not None
        return estimator.closing(episode, state)

    steps = explore(robot, policy_of("random", scene), estimator, 4)
    belief, episode, _ = run_exploration(
        steps,
        Stopping(2),
        PRIOR,
        tmp_path,
        closing=closing,
        let_go=lambda: order.append("let go"),
        show_progress=False,
    )
    assert order == ["let go", "closed after 2"] and len(episode) == 3
    assert torch.equal(load_belief(tmp_path).vectors, belief.vectors)


def test_what_was_enough_before_a_stop_needs_no_further_move(scene: Scene, tmp_path: Path) -> None:
    estimator = estimator_of("default")
    (step,) = first_steps(1, explore(robot_in(scene), policy_of("random", scene), estimator, 4))
    episode, state = step.episode, step.estimation.state
    task = Task(episode.poses[:1], episode.commands[1:], episode.commands[:1])
    error = expected_error(step.estimation.belief, task)
    with pytest.raises(ValueError, match="the task is for an arm of stiffness"):
        expected_error(step.estimation.belief, replace(task, stiffness=2 * episode.stiffness))

    def moves() -> Iterator[ExplorationStep]:
        raise AssertionError("no move was needed")
        yield

    with EstimationRun(tmp_path, PRIOR, 5, show_progress=False) as run:
        run.add(step.estimation, episode)
    kept = Kept(episode, step.estimation.belief, state)
    *_, reason = run_exploration(
        moves(), Stopping(5, 1.01 * error), PRIOR, tmp_path, kept, task, show_progress=False
    )
    assert reason.startswith(f"the task's poses are expected within {1e3 * error:.2f} mm")
    with pytest.raises(AssertionError, match="no move was needed"):
        run_exploration(
            moves(), Stopping(5, 0.99 * error), PRIOR, tmp_path, kept, task, show_progress=False
        )
