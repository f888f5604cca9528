"""Slides of the emulated arm: quick along the way, and as far as friction lets them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robot_bench import emulator_settings, wired_servo

from tpcd.robot import servo as servo_module
from tpcd.robot.admittance import advance, at_rest, settings_for_surface, travel_time
from tpcd.robot.emulator import emulated_scene
from tpcd.robot.servo import Servo

pytestmark = pytest.mark.usefixtures("types_unchecked")

STIFFNESS = (100.0, 100.0, 50.0)


def pressed(servo: Servo) -> np.ndarray:
    """Press on the floor; the command that does."""
    scene = emulated_scene(emulator_settings())
    lowest = float(scene.vertices_ee[:, 1].min())
    command = np.array([0.0, scene.floor_height - lowest - 0.02, 0.0])
    command[0] = float(scene.start_pose[0])
    assert servo.settle(command).settled
    return command


@pytest.mark.parametrize(
    ("yields", "longest"),
    [(3.0, 4.0), (2.0, 5.0), (1.0, 7.0), pytest.param(0.2, 30.0, marks=pytest.mark.slow)],
)
def test_a_slide_settles_at_the_limit_of_friction(yields: float, longest: float) -> None:
    servo, controller = wired_servo(surface_mm_per_10n=yields)
    friction = emulated_scene(emulator_settings()).theta["friction"]
    command = pressed(servo)
    for way in (0.035, -0.035):
        began = controller.time
        command = command + np.array([way, 0.0, 0.0])
        reading = servo.settle(command)
        assert reading.settled and controller.time - began < longest
        force_x, force_z, _ = reading.wrench.tolist()
        # 0.2 N of noise over 75 readings is 0.023 N; half of it in what K (u - r) + w may leave.
        assert force_x == pytest.approx(-np.sign(way) * friction * force_z, abs=0.08)


def test_a_slide_ends_where_it_does_without_the_lighter_damping() -> None:
    """Without noise, so that nothing but the law differs; 0.03 N that may be left are 0.3 mm."""
    ends = []
    for heavy in (False, True):
        law = settings_for_surface(STIFFNESS, 1e4 / 3)
        law = replace(law, free_damping=law.damping) if heavy else law
        servo, controller = wired_servo(law, surface_mm_per_10n=3.0, force_noise=0.0)
        command = pressed(servo)
        began = controller.time
        reading = servo.settle(command + np.array([0.025, 0.0, 0.0]))
        ends.append((reading.pose.numpy(), controller.time - began))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=6e-4)
    assert ends[0][1] < 0.4 * ends[1][1]


def test_what_lies_ahead_of_a_slide_is_a_first_touch() -> None:
    """The wall adds about 4 N to what friction makes, and the arm comes to rest at it."""
    servo, controller = wired_servo(surface_mm_per_10n=3.0)
    scene = emulated_scene(emulator_settings())
    command = pressed(servo)
    gap = scene.wall_position - float(scene.vertices_ee[:, 0].max() + scene.start_pose[0])
    servo.link.next_sample, forces = recording(servo, controller)
    reading = servo.settle(command + np.array([gap + 0.02, 0.0, 0.0]))
    friction = scene.theta["friction"] * float(reading.wrench[1])
    assert reading.settled and float(reading.wrench[0]) < -friction
    assert 2.0 < -np.min(forces) - friction < 5.5


def recording(servo: Servo, controller):
    """Readings as before, and a list that the true force along x is written to."""
    before, forces = servo.link.next_sample, []

    def sample():
        reading = before()
        forces.append(float(controller._world.wrench(controller._actual)[0]))
        return reading

    return sample, forces


def test_the_lighter_damping_is_along_the_way_only() -> None:
    """A force across the way moves the arm as little as if it stood in a contact."""
    law = settings_for_surface(STIFFNESS, 5e3)
    load, command = np.array([-1.2, 2.0, 0.0]), np.array([0.05, -0.02, 0.0])
    state = at_rest(np.zeros(3), load)
    for _ in range(1000):
        state = advance(law, state, command, load, 0.008)
    assert state.soft is not None and state.in_contact
    assert abs(float(state.reference[0]) - 0.038) < 1e-4
    moved = {}
    for axis in (0, 1):
        pushed = load + 0.25 * np.eye(3)[axis]
        way = advance(law, replace(state, wrench=pushed), command, pushed, 0.008)
        moved[axis] = abs(float(way.velocity[axis]))
    assert moved[1] == pytest.approx(0.25 / 400, rel=0.05)
    # Along it the mean of the way counts, which one reading changes little.
    assert 0.25 / 400 < moved[0] < 2 * 0.25 / 400


def soft_state(law):
    """On its way along x against 1.2 N of friction, long enough to be soft."""
    load, command = np.array([-1.2, 2.0, 0.0]), np.array([0.05, -0.02, 0.0])
    state = at_rest(np.zeros(3), load)
    for _ in range(500):
        state = advance(law, state, command, load, 0.008)
        if state.soft is not None:
            return state, command, load
    raise AssertionError("the way was never soft")


@pytest.mark.parametrize(("change", "readings"), [(2.0, 1), (0.6, 6)], ids=["fast", "slow"])
def test_a_wrench_that_changes_ends_the_way(change: float, readings: int) -> None:
    """A large change by the first reading, a small one once noise cannot have made it."""
    state, command, load = soft_state(law := settings_for_surface(STIFFNESS, 5e3))
    for count in range(readings):
        assert state.soft is not None, count
        state = advance(law, state, command, load - np.array([change, 0.0, 0.0]), 0.008)
    assert state.soft is None


def test_noise_does_not_end_the_way() -> None:
    generator = np.random.default_rng(0)
    noise = (0.5, 0.5, 0.025)
    law = replace(settings_for_surface(STIFFNESS, 5e3), noise=noise)
    state, command, load = soft_state(law)
    for _ in range(200):
        state = advance(law, state, command, load + noise * generator.standard_normal(3), 0.008)
        assert state.soft is not None
    deaf = replace(law, noise=(0.0, 0.0, 0.0))
    for _ in range(200):
        state = advance(deaf, state, command, load + noise * generator.standard_normal(3), 0.008)
        if state.soft is None:
            return
    raise AssertionError("noise that is not known of ended no way")


def test_a_new_command_begins_a_new_way(monkeypatch: pytest.MonkeyPatch) -> None:
    servo, _ = wired_servo(surface_mm_per_10n=3.0)
    command = pressed(servo)
    servo.settle(command + np.array([0.02, 0.0, 0.0]))
    assert servo.state is not None and servo.state.soft is not None
    given = []

    def noted(law, state, *others):
        given.append(state)
        return advance(law, state, *others)

    monkeypatch.setattr(servo_module, "advance", noted)
    servo.settle(command + np.array([0.02, 0.0, 0.1]))
    assert given[0].soft is None and given[0].mark.reference is given[0].reference


def test_the_time_of_a_way_is_that_of_its_slowest_axis_and_the_short_way_round() -> None:
    law = settings_for_surface(STIFFNESS, 5e3)
    x, _, angle = law.speed_limit
    state = at_rest(np.array([0.0, 0.0, 3.1]), np.array([5.0, -3.0, 1.0]))
    far, turned = np.array([0.1, 0.05, 3.1]), np.array([0.0, 0.0, -3.1])
    assert travel_time(law, state, far) == pytest.approx(0.1 / x)
    assert travel_time(law, state, turned) == pytest.approx((2 * np.pi - 6.2) / angle)


def test_a_long_flat_side_is_turned_slower_instead_of_ending_the_run() -> None:
    """24 cm of brick are far stiffer against turning than the floor that was stated."""
    servo, _ = wired_servo(outline="brick", surface_mm_per_10n=3.0)
    scene = emulated_scene(emulator_settings(outline="brick"))
    lowest = float(scene.vertices_ee[:, 1].min())
    command = np.array([float(scene.start_pose[0]), scene.floor_height - lowest - 0.03, 0.0])
    before = servo._law
    for angle in (0.0, 0.1, -0.1):
        assert servo.settle(command + np.array([0.0, 0.0, angle])).settled
    assert servo._law.damping[2] > before.damping[2]
    assert servo._law.damping[:2] == before.damping[:2]
