"""What goes wrong with an arm: faults of the controller, readings that must stop it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from robot_bench import arm_with, command, raw_of

from tpcd.errors import RobotError
from tpcd.robot.admittance import at_rest
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.frames import task_frame, tcp_pose
from tpcd.robot.link import Link, Sample
from tpcd.robot.raw import RawRecord
from tpcd.robot.servo import Servo
from tpcd.robot.ur import UniversalRobot

pytest.importorskip("rtde_control")
NOWHERE = ArmSettings("nowhere", noise_free=True)
AWAY = (-0.015, 0.03, 0.0)
"""The way of a retreat [m, m, rad]."""


def press_until_it_fails(arm: UniversalRobot) -> tuple[str, float]:
    """Start, and press and let go until an error; its text, and when it came."""
    x, z, _ = arm.start().poses[0].tolist()
    assert arm._link is not None
    arm._link.stale_time = 0.04
    with pytest.raises(RobotError) as caught:
        for _ in range(20):
            arm.settle(command(x, z - 0.05))
            arm.settle(command(x, z))
    return str(caught.value), time.monotonic()


def test_a_protective_stop_ends_the_move(tmp_path: Path) -> None:
    with arm_with(tmp_path, fault="protective_stop") as arm:
        text, _ = press_until_it_fails(arm)
    assert "protective stop" in text and "holds its place" in text
    _, about = raw_of(tmp_path, sorted(tmp_path.glob("row_*"))[-1].stem)
    assert "protective stop" in about["ended"]


@pytest.mark.parametrize("fault", ["frozen_link", "killed_controller"])
def test_a_lost_link_is_noticed_at_once_though_the_client_serves_the_last_pose(
    fault: str, tmp_path: Path
) -> None:
    began = time.monotonic()
    with arm_with(tmp_path, fault=fault) as arm:
        text, noticed = press_until_it_fails(arm)
        closing = time.monotonic()
        arm.close()
        assert time.monotonic() - closing < 15.0
    assert "no new reading for 40 ms" in text and "holds its last target" in text
    columns, about = raw_of(tmp_path, sorted(tmp_path.glob("row_*"))[-1].stem)
    # 40 ms, and what a busy machine adds; until the error had come through all.
    assert 0.035 < noticed - columns["received"][-1] < 0.5
    assert "no new reading" in about["ended"] and began < noticed


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("wrong_payload", "payload is wrong by about 0.[78]"),
        ("drifting_sensor", r"drifts by 0\.[56]"),
        ("frozen_sensor", "sensor has stopped: F_x, .* repeat .*; the arm holds its place"),
    ],
)
def test_a_sensor_that_zeroing_does_not_mend_is_refused(
    fault: str, said: str, tmp_path: Path
) -> None:
    with arm_with(tmp_path, fault=fault) as arm, pytest.raises(RobotError, match=said):
        arm.start()


def test_a_wrench_that_is_no_number_any_more_ends_in_a_retreat(tmp_path: Path) -> None:
    with arm_with(tmp_path, fault="no_numbers") as arm:
        text, _ = press_until_it_fails(arm)
    assert "no number" in text and "the arm has retreated" in text
    retreat, _ = raw_of(tmp_path, "retreat")
    assert retreat["z"][-1] > retreat["z"][0] + 0.029 and np.isnan(retreat["F_z"]).all()


def test_a_surface_stiffer_than_stated_is_detected_and_left(tmp_path: Path) -> None:
    with arm_with(tmp_path, {"surface_mm_per_10n": 12.0}, surface_mm_per_10n=1.0) as arm:
        x, z, _ = arm.start().poses[0].tolist()
        with pytest.raises(RobotError, match="oscillates.*state less than 12 mm|beyond the limit"):
            arm.settle(command(x, z - 0.07))
        assert arm.at_rest == "the arm has retreated"


class StubLink(Link):
    """Samples as given, with no controller behind."""

    def __init__(self, samples: list[Sample]) -> None:
        self.alive, self.rate, self._samples = True, 125.0, samples

    def next_sample(self) -> Sample:
        return self._samples.pop(0)

    def servo(self, target: object) -> None:
        pass


class FollowingLink(Link):
    """An arm that is where it is sent, and feels forces along z as given, then none."""

    def __init__(self, tcp: np.ndarray, forces: tuple[float, ...]) -> None:
        self.alive, self.rate, self._tcp, self._forces = True, 125.0, tcp, list(forces)
        self._time = 0.0

    def next_sample(self) -> Sample:
        self._time += 1 / self.rate
        force = self._forces.pop(0) if self._forces else 0.0
        wrench = np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])
        return Sample(self._time, self._tcp, wrench, self._tcp, 0.0)

    def servo(self, target: np.ndarray) -> None:
        self._tcp = target


def test_the_force_limit_holds_again_after_a_retreat_that_fails() -> None:
    frame = task_frame(np.array([0.4, 0.0, 0.1, np.pi, 0.0, 0.0]))
    place = np.array([0.1, 0.1, 0.0])
    tcp = tcp_pose(frame, place)
    forces = (25.0, 40.0, 25.0, 25.0)
    samples = [
        Sample(0.008 * k, tcp, np.array([0.0, 0.0, force, 0.0, 0.0, 0.0]), tcp, 0.0)
        for k, force in enumerate(forces)
    ]
    servo = Servo(NOWHERE, StubLink(samples), frame, RawRecord())
    servo.state = at_rest(place, np.zeros(3))
    with pytest.raises(RobotError, match="met a force of 40"):
        servo.retreat()
    with pytest.raises(RobotError, match="beyond the limit of 20 N"):
        for _ in range(2):
            servo.read()


def test_a_force_about_the_limit_does_not_end_a_retreat() -> None:
    """Noise takes it below the limit and above again."""
    frame = task_frame(np.array([0.4, 0.0, 0.1, np.pi, 0.0, 0.0]))
    place = np.array([0.1, 0.1, 0.0])
    link = FollowingLink(tcp_pose(frame, place), (25.0, 19.0, 21.0, 21.0, 21.0))
    servo = Servo(NOWHERE, link, frame, RawRecord())
    servo.state = at_rest(place, np.zeros(3))
    servo.retreat()
    np.testing.assert_allclose(servo.state.reference - place, AWAY, atol=1e-9)


def test_a_retreat_between_two_blows_of_a_swing_goes_on() -> None:
    """It began at 1 N, and the surface strikes once more with what it had struck with before."""
    frame = task_frame(np.array([0.4, 0.0, 0.1, np.pi, 0.0, 0.0]))
    place = np.array([0.1, 0.1, 0.0])

    def retreat(forces: tuple[float, ...]) -> np.ndarray:
        link = FollowingLink(tcp_pose(frame, place), forces)
        servo = Servo(NOWHERE, link, frame, RawRecord())
        servo.state = at_rest(place, np.zeros(3))
        for _ in range(20):
            servo.read()
        servo.retreat()
        return servo.state.reference - place

    swing = (1.0,) * 9 + (17.5,) + (1.0,) * 10
    raised = retreat((*swing, 1.0, 17.5, 1.0))
    np.testing.assert_allclose(raised, AWAY, atol=1e-9)
    with pytest.raises(RobotError, match="met a force of 17.5"):
        retreat((*(1.0,) * 20, 1.0, 17.5, 1.0))


@pytest.mark.parametrize(
    ("pose", "force", "said"),
    [
        ((0.31, 0.1, 0.0), 0.0, "outside of the workspace"),
        ((0.1, 0.1, 0.0), 25.0, "beyond the limit of 20 N"),
        ((0.2, 0.1, 0.0), 0.0, "does not follow"),
    ],
)
def test_single_readings_are_guarded(pose: tuple, force: float, said: str) -> None:
    frame = task_frame(np.array([0.4, 0.0, 0.1, np.pi, 0.0, 0.0]))
    wrench = np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])
    tcp = tcp_pose(frame, np.array(pose))
    samples = [Sample(0.008 * k, tcp, wrench, tcp, 0.0) for k in range(3)]
    servo = Servo(NOWHERE, StubLink(samples), frame, RawRecord())
    if said == "does not follow":
        servo.state = at_rest(np.array([0.1, 0.1, 0.0]), np.zeros(3))
    with pytest.raises(RobotError, match=said):
        for _ in range(3):
            servo.read()
