"""A sensor is zeroed in the air, and an arm that touches where it starts is found out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from robot_bench import command, emulator_settings, touching, wired_arm

from tpcd.errors import RobotError
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.emulator import controller as emulated
from tpcd.robot.emulator import emulated_scene
from tpcd.robot.free_space import check_room, lifted
from tpcd.robot.preflight import FreeAir, touch

pytestmark = pytest.mark.usefixtures("types_unchecked")

RATE, NOISE = 125.0, np.array([0.2, 0.2, 0.01])
START, HIGHER = np.array([0.0, 0.06, 0.0]), np.array([-0.015, 0.09, 0.0])


def readings(
    generator: np.random.Generator,
    start: float,
    seconds: float,
    wrench: np.ndarray,
    drift: np.ndarray,
) -> FreeAir:
    stamps = start + np.arange(round(seconds * RATE)) / RATE
    noise = NOISE * generator.standard_normal((len(stamps), 3))
    wrenches = wrench + stamps[:, None] * drift + noise
    return FreeAir(stamps, np.tile(START, (len(stamps), 1)), wrenches)


def found(seed: int, contact: np.ndarray) -> bool:
    """Whether a contact is told from an offset, a payload and a drift that are allowed."""
    generator = np.random.default_rng(seed)
    offset = np.array([5.0, 5.0, 0.5]) * generator.uniform(-1, 1, 3)
    drift = np.array([0.15, 0.15, 0.01]) * generator.uniform(-1, 1, 3)
    place = readings(generator, 0.0, 0.6, offset + contact, drift)
    return touch(place, readings(generator, 2.1, 3.0, offset, drift)).felt


def test_no_false_alarm_in_two_thousand_starts_that_drift_and_carry_a_wrong_payload() -> None:
    """The stated rate is one in half a million: of 2000 none, but by a chance of 0.4 %."""
    assert sum(found(seed, np.zeros(3)) for seed in range(2000)) == 0


@pytest.mark.parametrize(
    "contact", [(0.0, 0.5, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.0, 0.05), (0.0, -0.5, 0.0)]
)
def test_half_a_newton_from_any_side_or_its_torque_alone_is_found(contact: tuple) -> None:
    """0.2 N beyond the bound are 4.3 standard deviations at 0.2 N of noise."""
    missed = sum(not found(seed, np.array(contact)) for seed in range(1000))
    assert missed <= 1


@pytest.mark.parametrize("press", [(0.0, 0.5), (0.0, 3.0), (0.0, 9.0), (0.7, 0.0), (6.0, 0.0)])
def test_an_arm_that_touches_where_it_starts_is_refused_with_the_force(
    press: tuple[float, float], tmp_path: Path
) -> None:
    asked: list[str] = []

    def only_to_move(text: str) -> bool:
        asked.append(text)
        return len(asked) == 1

    settings = emulator_settings(force_noise=0.1)
    pose = touching(settings, *press)
    arm, controller = wired_arm(tmp_path, pose, only_to_move, force_noise=0.1)
    before = controller._sense()[[0, 2]]
    np.testing.assert_allclose(before, (-press[0], press[1]), atol=0.2)
    with pytest.raises(RobotError, match="would be zeroed in contact") as raised:
        arm.start()
    assert "the arm has retreated" in str(raised.value)
    told = [float(part.split(" N")[0]) for part in str(raised.value).split("(")[1].split(", ")[:2]]
    np.testing.assert_allclose(told, before, atol=0.2)
    assert len(asked) == 2 and "starts from the free pose above" in asked[1]
    assert np.abs(controller._sense()[:3]).max() == 0.0


@pytest.mark.parametrize("press", [(0.0, 1.0), (0.0, 9.0), (2.0, 0.0), (4.0, 4.0)])
def test_zeroed_in_the_air_instead_nothing_is_off_and_it_is_told(
    press: tuple[float, float], tmp_path: Path
) -> None:
    pose = touching(emulator_settings(), *press)
    arm, controller = wired_arm(tmp_path, pose, force_noise=0.02)
    episode = arm.start()
    assert "moved to free air" in (episode.notes or "")
    np.testing.assert_allclose(episode.poses[0].numpy(), pose + (-0.015, 0.03, 0.0), atol=1e-3)
    np.testing.assert_allclose(episode.wrenches[0].numpy(), 0.0, atol=0.02)
    np.testing.assert_allclose(controller._zero, 0.0, atol=0.02)
    x, z, _ = episode.poses[0].tolist()
    free = arm.settle(command(x, z + 0.02))
    torch.testing.assert_close(free.pose, command(x, z + 0.02), atol=1e-3, rtol=0)
    pressed = arm.settle(command(x, z - 0.08))
    assert float(pressed.wrench[1]) == pytest.approx(controller._sense()[2], abs=0.1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("fault", ["none", "drifting_sensor", "wrong_payload"])
def test_a_free_start_stays_where_it_is_with_drift_and_payload_that_are_allowed(
    fault: str, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(emulated, "DRIFT", 0.1)
    monkeypatch.setattr(emulated, "WRONG_MASS", 0.2)
    arm, controller = wired_arm(tmp_path, arm={"still_time": 3.0}, seed=seed, fault=fault)
    episode = arm.start()
    expected = emulated_scene(controller.settings).start_pose
    torch.testing.assert_close(episode.poses[0], expected, atol=1e-4, rtol=0)
    assert episode.notes is None
    # Zeroed 4.5 s before, it has drifted since.
    assert float(episode.wrenches[0, 1]) == pytest.approx(0.47 * (fault[0] == "d"), abs=0.12)


def test_a_start_pose_that_touches_when_the_arm_comes_back_is_refused(tmp_path: Path) -> None:
    """In restart: what is below has risen since the arm had started there in free air."""
    arm, controller = wired_arm(tmp_path, force_noise=0.05)
    episode = arm.start()
    points = emulated_scene(controller.settings).vertices_ee.numpy()
    low = float(episode.poses[0, 1]) + float(points[:, 1].min())
    controller._world._floor_height = low + 0.6 * controller.settings.compliance
    with pytest.raises(RobotError, match="the start pose is not free: zeroed in the air"):
        arm.restart()
    assert arm.at_rest == "the arm has retreated"
    np.testing.assert_allclose(controller._zero, 0.0, atol=1e-9)


def test_a_run_that_goes_on_is_zeroed_in_the_air_though_it_stands_pressed(tmp_path: Path) -> None:
    arm, controller = wired_arm(tmp_path, force_noise=0.05)
    episode = arm.start()
    x, z, _ = episode.poses[0].tolist()
    touch_floor = command(x, z - 0.04)
    reading = arm.settle(touch_floor)
    episode = episode.with_row(touch_floor, reading.pose, reading.wrench)
    pressed = controller._sense()[2]
    again, later = wired_arm(tmp_path, reading.pose.numpy(), force_noise=0.05)
    assert later._sense()[2] == pytest.approx(pressed, abs=0.1) and pressed > 1.0
    again.resume(episode)
    np.testing.assert_allclose(later._zero, 0.0, atol=1e-9)
    low = touching(controller.settings, force_z=0.8)
    slipped = replace(episode, poses=episode.poses.clone())
    slipped.poses[0, 1] = low[1]
    third, _ = wired_arm(tmp_path, force_noise=0.05)
    with pytest.raises(RobotError, match="the start pose is not free: .*0.[789]. N"):
        third.resume(slipped)


def test_the_arm_is_lifted_away_from_floor_and_wall_as_far_as_surfaces_yield() -> None:
    settings = ArmSettings("nowhere")
    np.testing.assert_allclose(lifted(settings, START), HIGHER)
    soft = ArmSettings("nowhere", surface_mm_per_10n=40.0)
    np.testing.assert_allclose(lifted(soft, START) - START, (-0.042, 0.042, 0.0))


@pytest.mark.parametrize("corner", [(-0.149, 0.06, 0.0), (0.0, 0.2995, 0.0)])
def test_without_room_to_lift_nothing_is_moved(corner: tuple, tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="mm to the left and .* mm above, expected 3 mm of both"):
        check_room(ArmSettings("nowhere"), np.array(corner))
    settings = emulator_settings()
    start = emulated_scene(settings).start_pose.numpy()
    high = (0.3, float(start[1]) + 0.004, 0.15)
    arm, controller = wired_arm(tmp_path, arm={"workspace_high": high})
    with pytest.raises(RobotError, match="leaves 15 mm to the left and 4 mm above"):
        arm.start()
    assert controller.servo_time == 0.0
