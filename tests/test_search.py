"""The search for the next command: it finds what teaches, also of a task and some moves ahead."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from policy_cases import SMALL, can_belief, can_episode, known_but, row_at
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.data.episode import Episode
from tpcd.information import belief_outcomes, expected_information_gain
from tpcd.policies import ActivePolicy, Limits, Situation
from tpcd.policies.active import Task
from tpcd.policies.lookahead import Reach, second_step_gain
from tpcd.predict import ContactPredictor

belief = pytest.fixture(scope="module", name="belief")(can_belief)
episode = pytest.fixture(scope="module", name="episode")(can_episode)


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
