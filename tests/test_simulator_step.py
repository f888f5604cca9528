"""Free motion, rollouts and the door of the quasi-static step."""

from __future__ import annotations

import math
from inspect import unwrap

import pytest
import torch
from contact_scenes import (
    BOX,
    STIFFNESS,
    make_scene,
    outline_points,
    random_transitions,
    rotated,
    vector,
)
from simulator_steps import SIDES, step

from tpcd.planar import compose
from tpcd.simulator import ContactMode, StepSettings, StepStatus, rollout, simulate_step

# Free flight and angles


@pytest.mark.parametrize("substeps", [1, 4])
def test_free_flight_reaches_the_command_without_force(substeps):
    command = vector(0.05, 0.3, 0.7)
    result = step(make_scene(), vector(-0.1, 0.2, -0.4), command, substeps=substeps)
    torch.testing.assert_close(result.pose, command, atol=1e-15, rtol=0)
    assert result.wrench.tolist() == [0.0, 0.0, 0.0]
    assert result.mode.tolist() == [ContactMode.FREE, ContactMode.FREE]


@SIDES
def test_commands_across_half_a_turn_go_the_short_way_round(side):
    """At an angle near pi, upside down on the floor, the step is that of the turned box."""
    turn = side * (math.pi - 0.01)
    start, command = vector(0, 0.05, turn), vector(0.01, 0.02, turn + side * 0.03)
    command[2] = command[2] - 2 * math.pi * side
    scene = make_scene(rotated(BOX, -turn), friction=0.3)
    result = step(scene, start, command)
    upright = step(make_scene(friction=0.3), vector(0, 0.05, 0), vector(0.01, 0.02, side * 0.03))
    torch.testing.assert_close(result.wrench, upright.wrench, atol=1e-7, rtol=0)
    assert -math.pi < float(result.pose[2]) <= math.pi
    expected = compose(upright.pose * vector(0, 0, 1), vector(0, 0, turn))[2]
    assert abs(float(result.pose[2] - expected)) < 1e-9


def test_a_rollout_is_steps_in_a_row():
    scene, start, command = random_transitions(outline_points("mug"), 6, seed=51)
    commands = torch.stack((command, start, command))
    transitions = rollout(scene, start, commands, STIFFNESS, StepSettings())
    pose, previous = start, None
    for command_now, transition in zip(commands, transitions, strict=True):
        alone = simulate_step(
            scene, pose, command_now, STIFFNESS, StepSettings(), previous=previous
        )
        assert torch.equal(alone.pose, transition.pose)
        pose, previous = transition.pose, command_now


# The door


@pytest.mark.parametrize(
    "stiffness", [(0.0, 1, 1), (1.0, -1, 1), (1.0, 1, math.nan), (1, math.inf, 1)]
)
def test_stiffness_that_is_not_positive_is_refused(stiffness):
    with pytest.raises(ValueError, match="stiffness is .*, expected three positive"):
        simulate_step(make_scene(), vector(0, 1, 0), vector(0, 1, 0), vector(*stiffness))


@pytest.mark.parametrize("name", ["pose", "command", "previous"])
def test_poses_of_another_width_are_refused(name):
    given = dict.fromkeys(("pose", "command", "previous"), vector(0, 1, 0))
    given[name] = vector(0, 1)
    with pytest.raises(ValueError, match=rf"{name} has shape \(2,\), expected 3"):
        # The tests' own check of shapes would come first.
        unwrap(simulate_step)(make_scene(), stiffness=STIFFNESS, **given)


def test_settings_that_mean_nothing_are_refused():
    for wrong in (
        {"friction": "viscous"},
        {"substeps": 0},
        {"rounds": 0},
        {"substeps": 2.5},
        {"substeps": 10**6},
        {"rounds": 2.5},
        {"tolerance": 0.0},
        {"tolerance": math.nan},
        {"largest_turn": 1e-9},
        {"largest_turn": 0.0},
        {"finest": 1e-8},
        {"finest": 1.5},
    ):
        with pytest.raises((ValueError, TypeError)):
            StepSettings(**wrong)


def test_every_status_is_a_sentence():
    assert all(len(status.sentence) > 5 for status in StepStatus)
