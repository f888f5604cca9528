"""The way of a command: straight, at the arm's pace, and so as the model takes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from robot_bench import emulator_settings, wired_servo

from tpcd.contact import ContactScene
from tpcd.effects.conditions import Rows
from tpcd.effects.simulate import simulate_rows
from tpcd.effects.truth import TRUE_PASSES, TRUTH_SETTINGS, added_effects
from tpcd.errors import RobotError
from tpcd.robot import command_way as way_module
from tpcd.robot.admittance import at_rest, settings_for_surface
from tpcd.robot.command_way import LEAD, PACE, command_way, moved_on
from tpcd.robot.emulator import emulated_scene
from tpcd.terrain import floor, wall

pytestmark = pytest.mark.usefixtures("types_unchecked")

LAW = settings_for_surface((100.0, 100.0, 50.0), 5e3)
YIELDS = 3.0
"""Of floor and wall, across and along [mm per 10 N]."""


def test_a_command_that_is_followed_at_once_goes_straight_at_its_pace() -> None:
    way = command_way(np.array([0.0, 0.1, 3.1]), np.array([0.05, 0.1, -3.1]))
    seen = []
    while way.share < 1:
        way = moved_on(way, LAW, at_rest(way.command, np.zeros(3)), 0.01)
        seen.append(way.command)
    assert len(seen) == pytest.approx(0.05 / PACE[0] / 0.01, abs=1)
    turned = 2 * np.pi - 6.2  # the shorter way round
    for here in seen:
        share = here[0] / 0.05
        np.testing.assert_allclose(here, [0.05 * share, 0.1, 3.1 + turned * share], atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_it_waits_for_an_arm_that_is_far_from_rest(axis: int) -> None:
    start, goal = np.zeros(3), np.array([0.05, 0.05, 0.2])
    pull = np.eye(3)[axis] * LEAD[axis] * LAW.stiffness[axis]
    still = moved_on(command_way(start, goal), LAW, at_rest(start, pull), 0.01)
    assert still.share == 0.0
    half = moved_on(command_way(start, goal), LAW, at_rest(start, -0.5 * pull), 0.01)
    free = moved_on(command_way(start, goal), LAW, at_rest(start, 0.0 * pull), 0.01)
    assert half.share == pytest.approx(0.5 * free.share)


def test_a_way_of_no_length_is_done() -> None:
    here = np.array([0.1, 0.2, 0.3])
    assert moved_on(command_way(here, here), LAW, at_rest(here, np.ones(3)), 0.01).share == 1


def test_a_command_that_gets_stuck_ends_the_run_where_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No row says that the arm was given what it was not."""
    servo, controller = wired_servo(surface_mm_per_10n=YIELDS)
    servo.settings = replace(servo.settings, settle_time=1.0)
    start = servo.state.reference.copy()

    def stuck(way, *others):
        return moved_on(way, *others) if way.share < 0.3 else way

    monkeypatch.setattr("tpcd.robot.servo.moved_on", stuck)
    with pytest.raises(RobotError, match="does not get on: .* beyond 3.% of its way"):
        servo.settle(start + np.array([0.02, 0.0, 0.0]))
    assert controller.time < 8.0
    assert 0.3 * 0.02 <= servo._command[0] - start[0] < 0.35 * 0.02


def test_the_time_of_a_long_way_is_not_limited_while_the_arm_follows() -> None:
    servo, controller = wired_servo(surface_mm_per_10n=YIELDS)
    servo.settings = replace(servo.settings, settle_time=1.0)
    servo.settling = replace(servo.settling, residual=(0.0, 0.0, 0.0))  # never still
    start, began = servo.state.reference.copy(), controller.time
    reading = servo.settle(start + np.array([0.0, 0.1, 0.0]))
    assert not reading.settled and abs(float(reading.pose[1] - start[1]) - 0.1) < 1e-3
    # The limit, which has the way at full speed in it, counts from the end of the way.
    assert controller.time - began > 2 * 0.1 / servo._law.speed_limit[1] + 1.0


def worst_of_the_model() -> float:
    """Press and turn both ways on the floor; the largest distance between where the
    arm comes to rest and where a model that knows all does, from the pose before [m]."""
    bottle = {"outline": "wine_bottle", "seed": 4}
    servo, _ = wired_servo(surface_mm_per_10n=YIELDS, force_noise=0.0, **bottle)
    scene = emulated_scene(emulator_settings(**bottle))
    points = scene.vertices_ee.double()
    floor_z = scene.floor_height - float(points[:, 1].min())
    start = scene.start_pose.double().numpy()
    commands = [start, np.array([start[0], floor_z - 0.02, 0.0])]
    for turn in (0.12, -0.12):
        commands.append(np.array([start[0] + 0.02, floor_z - 0.04, turn]))
    poses = [start, *(servo.settle(command).pose.numpy() for command in commands[1:])]
    count, one = len(commands), torch.ones(1, dtype=torch.float64)
    known = ContactScene(
        points[None],
        (floor(scene.floor_height * one), wall(scene.wall_position * one)),
        torch.full((1, 2), scene.friction, dtype=torch.float64),
    )
    measured, before = torch.tensor(np.array(poses)), torch.arange(count) - 1
    before[0] = 0
    names = ("floor_compliance", "wall_compliance", "tangential_compliance")
    found = simulate_rows(
        known,
        Rows(before, torch.arange(count) / count, measured[before]),
        torch.tensor(np.array(commands)),
        scene.stiffness.double(),
        added_effects({name: {"compliance": 1e-4 * YIELDS} for name in names}),
        TRUTH_SETTINGS,
        TRUE_PASSES,
    )
    return float((found.transition.pose[0] - measured[found.index])[:, :2].abs().max())


def test_what_turns_in_contact_rests_where_the_model_has_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert worst_of_the_model() < 1e-3
    monkeypatch.setattr(way_module, "PACE", (1e3, 1e3, 1e4))
    monkeypatch.setattr(way_module, "LEAD", (1e6, 1e6, 1e6))
    assert worst_of_the_model() > 3e-3, "a command that jumps would do as well"
