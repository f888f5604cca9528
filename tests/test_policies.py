"""Policies: limits are kept, scripts can be taken up again, the search finds what teaches."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tpcd.belief import EstimatorSettings, SamplerSettings
from tpcd.belief.belief import Belief, prior_belief
from tpcd.data.episode import Episode
from tpcd.information import belief_outcomes, expected_information_gain
from tpcd.parameters import DEFAULT_BOUNDS, SCENE_NAMES
from tpcd.policies import (
    ActivePolicy,
    ActiveSettings,
    GridPolicy,
    Limits,
    MotionPolicy,
    Situation,
    make_policy,
)
from tpcd.policies.active import Task
from tpcd.policies.basic import best_within
from tpcd.policies.lookahead import Reach, second_step_gain
from tpcd.predict import ContactPredictor
from tpcd.robot.simulated import SimulatedRobot
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.truth.motions import press_and_slide, rich_exploration
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import Scene, draw_scene, make_truth

SMALL = ActiveSettings(first=32, rounds=2, later=16, elite=4, particles=40, finalists=4)


@pytest.fixture(scope="module")
def scene() -> Scene:
    generator = torch.Generator().manual_seed(21)
    return draw_scene("soup_can", builtin_outlines()["soup_can"].vertices, generator)


@pytest.fixture(scope="module")
def episode(scene: Scene) -> Episode:
    generator = torch.Generator().manual_seed(22)
    motion = make_motion("press_and_slide", scene, 5, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 5, generator).measured


@pytest.fixture(scope="module")
def belief(episode: Episode) -> Belief:
    settings = EstimatorSettings(sampler=SamplerSettings(particles=200))
    generator = torch.Generator().manual_seed(0)
    return prior_belief(episode, load_prior("ycb21-z2"), generator, settings)


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


def known_but(belief: Belief, name: str) -> Belief:
    """The belief with everything but one parameter known."""
    middle = belief.vectors[:1].clone()
    for i, entry in enumerate(SCENE_NAMES, start=belief.prior.shape.latent_dim):
        low, high = DEFAULT_BOUNDS[entry]
        middle[:, i] = 0.5 * (low + high)
    vectors = middle.repeat(len(belief.vectors), 1)
    column = belief.prior.names.index(name)
    vectors[:, column] = belief.vectors[:, column]
    return replace(
        belief, vectors=vectors, misfit_sd=torch.full_like(belief.misfit_sd, 1e-4),
        misfit_covariance=1e-4 * belief.misfit_covariance,
    )  # fmt: skip


def row_at(episode: Episode, pose: tuple[float, float, float]) -> Episode:
    """An episode of one row, at rest in a pose."""
    here = torch.tensor([pose], dtype=torch.float64)
    return replace(episode, commands=here, poses=here, wrenches=torch.zeros_like(here))


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
    ):
        with pytest.raises(ValueError, match="expected|must be"):
            Limits(**wrong)  # type: ignore[arg-type]


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


def test_a_goal_beyond_one_step_is_judged_by_the_step_that_is_made(
    belief: Belief, episode: Episode
) -> None:
    known = known_but(belief, "floor_height")
    start = row_at(episode, (0.0, 0.11, 0.0))
    limits = Limits(force=2.0, step=(0.02, 0.02, 0.01))
    policy, situation = ActivePolicy(limits, SMALL), Situation(start, known)
    goals = torch.tensor([[0.0, 0.17, 0.0], [0.0, -0.01, 0.0]], dtype=torch.float64)
    predictor = ContactPredictor(known)
    first, away = policy._first_step(situation, goals)
    assert away.tolist() == pytest.approx([3.0, 6.0])

    def excess_of(commands: Tensor) -> Tensor:
        starts = start.poses.expand(2, 3)
        noise = episode.sensor_std[:3]
        return limits.excess_probability(predictor.predict(starts, commands, starts, noise))

    _, excess = policy._rate(predictor, situation, goals)
    torch.testing.assert_close(excess, excess_of(first))
    assert float(excess_of(goals)[1]) > float(excess[1]) + 0.05


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


def test_the_search_goes_down_for_the_floor_and_right_for_the_wall(
    belief: Belief, episode: Episode
) -> None:
    limits = Limits(step=(0.03, 0.03, 0.01))
    generator = torch.Generator().manual_seed(0)
    start = row_at(episode, (0.0, 0.12, 0.0))
    down = ActivePolicy(limits, SMALL).choose(
        Situation(start, known_but(belief, "floor_height")), generator
    )
    assert down.command[1] < start.poses[0, 1]
    # The wall is two or three steps away: the first one leads towards it.
    right = ActivePolicy(limits, SMALL).choose(
        Situation(row_at(episode, (0.03, 0.3, 0.0)), known_but(belief, "wall_position")), generator
    )
    assert right.command[0] > 0.03 + 0.02
    assert right.gain is not None and right.gain > 0.1


def test_a_task_makes_the_search_learn_what_the_task_needs(
    belief: Belief, episode: Episode
) -> None:
    """Floor and wall are both unknown; a task on the floor asks for the floor."""
    one, other = known_but(belief, "floor_height"), known_but(belief, "wall_position")
    both = replace(one, vectors=one.vectors.clone())
    column = belief.prior.names.index("wall_position")
    order = torch.randperm(len(both.vectors), generator=torch.Generator().manual_seed(3))
    both.vectors[:, column] = other.vectors[order, column]
    here = torch.tensor([[0.0, 0.08, 0.0]], dtype=torch.float64)
    pressed = here + torch.tensor([[0.0, -0.06, 0.0]], dtype=torch.float64)
    task = Task(here, pressed)
    situation = Situation(row_at(episode, (0.0, 0.08, 0.0)), both)
    choice = ActivePolicy(Limits(step=(0.08, 0.08, 0.01)), SMALL, task).choose(
        situation, torch.Generator().manual_seed(0)
    )
    assert choice.command[1] < 0.05
    before = task.predicted_error(ContactPredictor(both))
    assert before[1] > 3e-3 and before[4] == pytest.approx(100 * float(before[1]))
    now = float((before[:3] / torch.tensor(task.tolerance)).square().mean())
    assert choice.gain == pytest.approx(now, rel=0.3)


def known_but_fields(belief: Belief, variance: Tensor) -> Belief:
    """The belief with theta known, and what is not known of each field's coefficients [m^2]."""
    known = known_but(belief, "friction")
    vectors = known.vectors[:1].expand_as(known.vectors)
    covariance = variance.double().diag().expand_as(known.misfit_covariance)
    return replace(known, vectors=vectors, misfit_covariance=covariance)


def two_gains(
    belief: Belief, particles: int, start: Episode, commands: Tensor, reach: Reach
) -> tuple[Tensor, Tensor]:
    """What each command teaches, and the best one within reach after it."""
    predictor = ContactPredictor(belief, particles)
    std = start.sensor_std
    outcomes, _ = belief_outcomes(predictor, start.poses[0], commands, start.commands[0], std)
    generator = torch.Generator().manual_seed(0)
    second = second_step_gain(predictor, outcomes, commands, std, reach, generator)
    return expected_information_gain(outcomes), second


def test_looking_ahead_a_reading_teaches_less_of_the_outline_once_more(
    belief: Belief, episode: Episode
) -> None:
    """The first press, and the second after a press and after a move in free space."""
    size = belief.misfit_covariance.shape[-1]
    open_ = known_but_fields(belief, torch.full((size,), 4e-7))
    start = row_at(episode, (0.0, 0.15, 0.0))
    press, free = (0.0, -0.05, 0.0), (0.0, 0.16, 0.0)
    commands = torch.tensor([press, free], dtype=torch.float64)
    first, (again, anew) = two_gains(
        open_, 30, start, commands, lambda _: (commands[0], commands[0])
    )
    assert first[0] > 0.8 and first[1] < 1e-6
    assert float(anew) == pytest.approx(float(first[0]), rel=0.05)
    assert 0.1 * first[0] < again < 0.5 * first[0]


def test_what_is_left_to_learn_of_the_outline_draws_the_search_there(
    belief: Belief, episode: Episode
) -> None:
    """With theta known and the field of one sense of turning learnt, the other one is tried."""
    size = belief.misfit_covariance.shape[-1]
    known = known_but_fields(belief, torch.zeros(size))
    field, terrains = known.misfit, size // known.misfit.bumps
    nodes = field.width * (torch.arange(field.bumps) - (field.bumps - 1) / 2).double()
    situation = Situation(row_at(episode, (0.0, 0.08, 0.0)), known)
    choice = ActivePolicy(Limits(), SMALL).choose(situation, torch.Generator().manual_seed(0))
    assert choice.gain is not None and choice.gain < 1e-2
    for side in (1.0, -1.0):
        variance = torch.where(side * nodes > 0.5 * field.width, 1e-12, 4e-7)
        open_ = known_but_fields(belief, variance.repeat(terrains))
        choice = ActivePolicy(Limits(), SMALL).choose(
            replace(situation, belief=open_), torch.Generator().manual_seed(0)
        )
        assert choice.gain is not None and choice.gain > 0.5
        assert side * float(choice.command[2]) < 0.0
        # A task is served by it too.
        turned = torch.tensor([[0.0, 0.02, -0.14 * side]], dtype=torch.float64)
        task = Task(situation.episode.poses, turned)
        before = task.predicted_error(ContactPredictor(open_))[:3]
        now = float((before / torch.tensor(task.tolerance)).square().mean())
        assert before[1] > 4e-4
        choice = ActivePolicy(Limits(), SMALL, task).choose(
            replace(situation, belief=open_), torch.Generator().manual_seed(0)
        )
        assert choice.gain is not None and 0.4 * now < choice.gain < now
        assert side * float(choice.command[2]) < -0.05


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


def test_looking_ahead_counts_what_is_left_to_learn(belief: Belief, episode: Episode) -> None:
    """After a command that tells the floor nothing is left; after one in free space, all is."""
    known = known_but(belief, "floor_height")
    start = row_at(episode, (0.0, 0.15, 0.0))
    tells, free = (0.0, -0.05, 0.0), (0.0, 0.16, 0.0)
    commands = torch.tensor([tells, free], dtype=torch.float64)
    first, second = two_gains(known, 60, start, commands, lambda pose: (pose - 0.2, pose + 0.2))
    assert first[1] < 0.01 and first[0] > 2
    assert second[1] > 0.8 * first[0]
    # What two readings of the floor tell more than one.
    assert second[0] < 0.5 * second[1]
    settings = replace(SMALL, look_ahead=True)
    choice = ActivePolicy(Limits(step=(0.08, 0.08, 0.01)), settings).choose(
        Situation(start, known), torch.Generator().manual_seed(0)
    )
    assert choice.gain is not None and choice.gain > 0
    with pytest.raises(ValueError, match="look-ahead"):
        ActivePolicy(Limits(), settings, Task(start.poses, start.poses))


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
