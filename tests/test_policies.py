"""Policies: limits are kept, scripts can be taken up again, basic ones find floor and wall."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from policy_cases import SMALL, can_belief, can_episode, can_scene, known_but, row_at
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.data.episode import Episode
from tpcd.policies import (
    ActivePolicy,
    GridPolicy,
    Limits,
    MotionPolicy,
    Situation,
    make_policy,
)
from tpcd.policies.basic import best_within
from tpcd.predict import ContactPredictor
from tpcd.robot.simulated import SimulatedRobot
from tpcd.truth.make import make_truth
from tpcd.truth.motions import press_and_slide, rich_exploration
from tpcd.truth.scene import Scene

belief = pytest.fixture(scope="module", name="belief")(can_belief)
episode = pytest.fixture(scope="module", name="episode")(can_episode)
scene = pytest.fixture(scope="module", name="scene")(can_scene)


def test_what_limits_draw_back_is_told(episode: Episode, belief: Belief) -> None:
    wide = Limits(50.0, (1.0, 1.0, 1.0), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    narrow = replace(wide, low=(-1.0, 0.06, -1.0))
    free, drawn = (
        MotionPolicy(lambda: press_and_slide(None), limits).choose(
            Situation(episode.first(3), belief), torch.Generator()
        )
        for limits in (wide, narrow)
    )
    assert free.asked is None and float(free.command[1]) < 0.06
    assert float(drawn.command[1]) == 0.06
    torch.testing.assert_close(drawn.asked, free.command)


def test_the_box_is_step_workspace_and_blocked_arm_together() -> None:
    limits = Limits(force=4.0, step=(0.03, 0.1, 0.2), low=(-1.0, -1.0, -0.1), high=(0.02, 1.0, 0.1))
    stiffness = torch.tensor([100.0, 200.0, 50.0], dtype=torch.float64)
    low, high = limits.box(torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64), stiffness)
    assert low.tolist() == pytest.approx([-0.03, 0.48, -0.1])
    assert high.tolist() == pytest.approx([0.02, 0.52, 0.1])
    # From outside, the way leads back in.
    low, high = limits.box(torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64), stiffness)
    assert low[0] == high[0] == pytest.approx(0.47)
    low, high = limits.box(torch.tensor([0.03, 0.5, 0.0], dtype=torch.float64), stiffness)
    assert low[0] == pytest.approx(0.0) and high[0] == pytest.approx(0.02)
    for wrong in (
        {"force": 0.0},
        {"probability": 1.0},
        {"low": (1.0, 0.0, 0.0), "high": (0.0,) * 3},
        {"step": (0.08, 0.08, math.nan)},
        {"step": (0.08, math.inf, 0.3)},
    ):
        with pytest.raises(ValueError, match="expected|must be"):
            Limits(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"),
    [("first", 1), ("elite", 1), ("rounds", -1), ("strides", math.nan), ("strides", 0.0),
     ("stride_cost", -1.0), ("stride_cost", math.inf)],
)  # fmt: skip
def test_a_search_without_meaning_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} (is )?{value}"):
        replace(SMALL, **{name: value})


def test_excess_probability_is_the_share_of_particles_whose_floor_is_too_high(
    belief: Belief, episode: Episode
) -> None:
    known = known_but(belief, "floor_height")
    start = row_at(episode, (0.0, 0.2, 0.0)).poses
    down = torch.tensor([[0.0, -0.02, 0.0], [0.0, 0.2, 0.0]], dtype=torch.float64)
    prediction = ContactPredictor(known).predict(start.expand(2, 3), down)
    force = 100.0 * (prediction.component_mean - down)[:, 0, 1]
    limit = float(force.quantile(0.6))
    found = Limits(force=limit).excess_probability(prediction)
    share = prediction.weights[:, 0] @ (force > limit).double()
    assert float(found[0]) == pytest.approx(float(share), abs=0.03)
    assert float(found[1]) == 0.0


def test_the_force_limit_is_about_the_wrench_of_the_effects(
    belief: Belief, episode: Episode
) -> None:
    """Twice as stiff as the arm says, and a lag that leaves no force at all in free air."""
    start = row_at(episode, (0.0, 0.2, 0.0)).poses
    down = torch.tensor([[0.0, -0.02, 0.0]], dtype=torch.float64)
    plain = ContactPredictor(belief).predict(start, down)
    mean = plain.true_moments()[0][..., 3:]
    limits = Limits(force=float(mean[:, 0, 1].abs().quantile(0.9)))
    assert float(limits.excess_probability(plain)[0]) < 0.2
    matrix = torch.diag(plain.stiffness).expand(*mean.shape[:2], 3, 3)
    stiff = replace(plain, component_wrench=2 * mean, wrench_matrix=2 * matrix)
    share = plain.weights[:, 0] @ (2 * mean[:, 0, 1].abs() > limits.force).double()
    assert float(share) > 0.4
    assert float(limits.excess_probability(stiff)[0]) == pytest.approx(float(share), abs=0.05)
    slack = replace(plain, component_wrench=0 * mean, wrench_matrix=0 * matrix)
    assert float(Limits(force=1e-3).excess_probability(slack)[0]) == 0.0


def test_the_best_allowed_command_is_taken_and_else_the_gentlest() -> None:
    gain = torch.tensor([1.0, 3.0, 2.0], dtype=torch.float64)
    assert best_within(gain, torch.tensor([0.0, 0.5, 0.01]), 0.05) == 2
    assert best_within(gain, torch.tensor([0.7, 0.5, 0.4]), 0.05) == 2


@pytest.mark.parametrize("name", ["active", "grid", "random", "expert"])
def test_commands_keep_their_limits(
    name: str, belief: Belief, episode: Episode, scene: Scene
) -> None:
    limits = Limits(force=5.0, step=(0.02, 0.03, 0.1))
    policy = make_policy(name, limits, scene, seed=0)  # type: ignore[arg-type]
    for rows in (1, 3, 6):
        situation = Situation(episode.first(rows), belief)
        choice = policy.choose(situation, torch.Generator().manual_seed(1))
        low, high = limits.box(episode.poses[rows - 1], episode.stiffness)
        assert (choice.command >= low - 1e-12).all() and (choice.command <= high + 1e-12).all()
        if name in ("active", "grid"):
            assert choice.gain is not None and choice.gain >= 0
            assert choice.excess_probability is not None
            # The rows press on the floor; some draws from the prior cannot even stay there.
            assert choice.excess_probability <= 2 * limits.probability


def test_a_lower_force_limit_holds_the_hand_back(belief: Belief, episode: Episode) -> None:
    """The floor is uncertain by 40 mm: pressing deep is informative and forbidden."""
    known = known_but(belief, "floor_height")
    start = row_at(episode, (0.0, 0.13, 0.0))
    heights = {}
    for force in (8.0, 1.0):
        limits = Limits(force=force, step=(0.08, 0.08, 0.01))
        choice = ActivePolicy(limits, SMALL).choose(
            Situation(start, known), torch.Generator().manual_seed(0)
        )
        answer = ContactPredictor(known).predict(start.poses, choice.command[None])
        wrench = 100.0 * (answer.component_mean - choice.command)[:, 0, :2]
        share = float(answer.weights[:, 0] @ (wrench.abs() > force).any(-1).double())
        # The choice was made by fewer particles than these.
        assert share <= 2 * limits.probability
        assert choice.excess_probability == pytest.approx(share, abs=limits.probability)
        assert not choice.forced
        heights[force] = float(choice.command[1])
    assert heights[1.0] > heights[8.0] + 0.005


def test_where_nothing_but_staying_is_allowed_the_choice_says_so(
    belief: Belief, episode: Episode
) -> None:
    """A hand that is pressed down on a floor nobody knows: no command keeps the limit surely."""
    known = known_but(belief, "floor_height")
    limits = Limits(force=1e-6)
    for policy in (
        ActivePolicy(limits, SMALL),
        GridPolicy(MotionPolicy(lambda: press_and_slide(None)), limits),
    ):
        choice = policy.choose(
            Situation(row_at(episode, (0.0, -0.05, 0.0)), known), torch.Generator().manual_seed(0)
        )
        assert choice.forced


def test_scripts_taken_up_again_give_the_same_commands(episode: Episode) -> None:
    def make():
        return rich_exploration(torch.Generator().manual_seed(5))

    policy = MotionPolicy(make)
    whole = [policy.next_command(episode.first(rows)) for rows in range(1, 7)]
    torch.testing.assert_close(MotionPolicy(make).next_command(episode), whole[-1], rtol=0, atol=0)
    torch.testing.assert_close(policy.next_command(episode.first(3)), whole[2], rtol=0, atol=0)


def test_the_grid_policy_stays_near_the_basic_trajectory(belief: Belief, episode: Episode) -> None:
    basic = MotionPolicy(lambda: press_and_slide(None))
    wanted = MotionPolicy(lambda: press_and_slide(None)).next_command(episode)
    wide = Limits(force=1e3, step=(1.0, 1.0, 1.0), low=(-math.inf,) * 3, high=(math.inf,) * 3)
    choice = GridPolicy(basic, wide).choose(
        Situation(episode, belief), torch.Generator().manual_seed(0)
    )
    reach = torch.tensor([0.03, 0.03, 0.025], dtype=torch.float64)
    offset: Tensor = (choice.command - wanted).abs()
    assert (offset <= reach + 1e-12).all()
    assert choice.considered == 27


@pytest.mark.parametrize("name", ["expert", "random", "rich"])
def test_scripts_find_floor_and_wall(name: str, scene: Scene) -> None:
    policy = make_policy(name, Limits(), scene, seed=3)  # type: ignore[arg-type]
    assert isinstance(policy, MotionPolicy)
    robot = SimulatedRobot(make_truth(scene, "quasistatic"), scene, 3)
    rows = robot.start()
    for _ in range(15):
        command = policy.next_command(rows)
        reading = robot.settle(command)
        rows = rows.with_row(command, reading.pose, reading.wrench)
    true = robot.recording(rows).true
    floor, wall = zip(*(scene.clearances(pose) for pose in true.poses[1:]), strict=True)
    assert min(map(abs, floor)) < 2e-4 and min(map(abs, wall)) < 2e-4
    assert (true.wrenches[:, :2].abs() < 10.0).all()


def test_the_basic_trajectory_is_the_random_one_without_noise(scene: Scene) -> None:
    """On the same rows, the random policy's commands scatter about the basic ones."""
    basic = MotionPolicy(lambda: press_and_slide(None))
    generator = torch.Generator().manual_seed(0)
    offsets = []
    robot = SimulatedRobot(make_truth(scene, "quasistatic"), scene, 4)
    rows = robot.start()
    for _ in range(8):
        command = basic.next_command(rows)
        reading = robot.settle(command)
        rows = rows.with_row(command, reading.pose, reading.wrench)
    for seed in range(40):
        generator = torch.Generator().manual_seed(seed)
        noisy = MotionPolicy(lambda g=generator: press_and_slide(g)).next_command(rows)
        offsets.append(noisy - basic.next_command(rows))
    spread = torch.stack(offsets)
    std = torch.tensor([0.005, 0.005, 0.04], dtype=torch.float64)
    assert (spread.mean(0).abs() < 4 * std / 40**0.5).all()
    assert (spread.std(0) / std - 1).abs().max() < 0.4
