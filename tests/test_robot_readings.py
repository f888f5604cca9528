"""Readings and commands that are no numbers, and a sensor that has stopped, move no arm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from robot_bench import STATED_TIME, check_rest, command, pressing, wired_arm

from tpcd.errors import RobotError
from tpcd.robot.preflight import FreeAir, longest_repeat

NAN = float("nan")


def started(folder: Path) -> tuple[Any, Any, torch.Tensor]:
    arm, controller = wired_arm(folder)
    return arm, controller, arm.start().poses[0].clone()


def altered(arm: Any, change: Any) -> None:
    """Let every reading of the link go through `change(count, sample)`."""
    link, count = arm._link, [0]
    original = link.next_sample

    def changed() -> Any:
        count[0] += 1
        return change(count[0], original())

    link.next_sample = changed


def test_a_wrench_that_has_stopped_stops_the_arm_before_it_presses(tmp_path: Path) -> None:
    arm, controller, start = started(tmp_path)
    first: list[np.ndarray] = []

    def frozen(_: int, sample: Any) -> Any:
        first.append(sample.wrench)
        return replace(sample, wrench=first[0])

    altered(arm, frozen)
    with pytest.raises(RobotError, match="the force sensor has stopped: F_x, .* exactly"):
        arm.settle(start - torch.tensor([0.0, 0.06, 0.0], dtype=torch.float64))
    assert arm.at_rest is not None
    assert abs(controller._load[:3]).max() < 2.0


@pytest.mark.parametrize("channels", [range(6), [0], [2], [4]])
def test_a_sensor_that_stands_still_from_the_start_is_refused_before_the_arm_moves(
    tmp_path: Path, channels: Any
) -> None:
    arm, controller = wired_arm(tmp_path)

    def frozen(_: int, sample: Any) -> Any:
        wrench = sample.wrench.copy()
        wrench[channels] = 0.7
        return replace(sample, wrench=wrench)

    altered(arm, frozen)
    names = np.array(["F_x", "F_y", "F_z", "M_x", "M_y", "M_z"])[channels]
    with pytest.raises(RobotError, match=f"stopped: {', '.join(names)} of the base.*noise_free"):
        arm.start()
    assert controller.servo_time == 0.0


def test_a_sensor_without_noise_works_where_it_is_said_to_have_none(tmp_path: Path) -> None:
    arm, _ = wired_arm(tmp_path, force_noise=0.0, pose_noise=0.0)
    assert arm.settings.noise_free
    x, z, _ = arm.start().poses[0].tolist()
    assert arm.settle(command(x, z + 0.01)).settled
    arm.stop()
    assert arm.at_rest == "the arm has retreated" and arm.doubts() == ()


@pytest.mark.parametrize(("channel", "name"), [(0, "x"), (2, "z"), (5, "phi")])
def test_a_pose_that_does_not_change_while_the_arm_moves_is_refused_by_name(
    tmp_path: Path, channel: int, name: str
) -> None:
    """Of a tool that points down the third part of the rotation vector is nearly the angle."""
    arm, controller = wired_arm(tmp_path)
    first: list[float] = []

    def frozen(_: int, sample: Any) -> Any:
        tcp = sample.tcp.copy()
        first.append(tcp[channel])
        tcp[channel] = first[0]
        return replace(sample, tcp=tcp)

    altered(arm, frozen)
    with pytest.raises(RobotError, match=f"{name} is -?[0-9]+ .* or this reading of its pose has"):
        arm.start()
    assert abs(controller._load).max() < 1e-9


@pytest.mark.parametrize("channels", ["wrench", "tcp", "both", "F_x"])
def test_readings_that_are_no_numbers_any_more_end_a_move_in_a_retreat(
    tmp_path: Path, channels: str
) -> None:
    """The arm is away from what it presses on, and does not just hold its place there."""
    arm, link = pressing(tmp_path)
    read, lost = link.next_sample, []

    def without() -> Any:
        sample = read()
        if link.sent < 20:
            return sample
        lost.append(link.time)
        wrench = np.full(6, NAN)
        if channels == "F_x":
            wrench[1:] = sample.wrench[1:]
        change = {"wrench": wrench} if channels != "tcp" else {}
        return replace(sample, **change, **({"tcp": wrench} if channels in ("tcp", "both") else {}))

    link.next_sample = without  # type: ignore[method-assign]
    with pytest.raises(RobotError, match="a reading that is no number.*; the arm has retreated"):
        arm.settle(command(0.1, -0.05))
    assert link.time - lost[0] < STATED_TIME
    check_rest(arm, link, 0.0)
    assert arm.doubts() == ()


@pytest.mark.parametrize("channel", ["wrench", "tcp"])
def test_one_reading_that_is_no_number_ends_a_move_in_a_retreat(
    tmp_path: Path, channel: str
) -> None:
    arm, controller, start = started(tmp_path)
    command = start - torch.tensor([0.0, 0.08, 0.0], dtype=torch.float64)
    arm.settle(command)
    pressed = abs(controller._load[:3]).max()

    def once(count: int, sample: Any) -> Any:
        return replace(sample, **{channel: np.full(6, NAN)}) if count == 10 else sample

    altered(arm, once)
    with pytest.raises(RobotError, match="a reading that is no number.*retreated"):
        arm.settle(command)
    assert pressed > 1.0 and abs(controller._load[:3]).max() < 0.5


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_command_that_is_no_number_is_refused_before_anything_moves(
    tmp_path: Path, place: int
) -> None:
    arm, _, start = started(tmp_path)
    sent: list[np.ndarray] = []
    arm._link.servo = sent.append
    start[place] = NAN
    with pytest.raises(RobotError, match="outside of the workspace"):
        arm.settle(start)
    assert sent == [] and arm.at_rest is None


def air(noise: float, step: float = 0.0, every: int = 1) -> FreeAir:
    """Readings of a still arm, in steps, of a sensor that is read more often than it reads."""
    read = np.random.default_rng(0).normal(0.0, noise, (1000 // every, 3)) * [1.0, 1.0, 0.05]
    read = np.repeat(np.round(read / step) * step if step else read, every, axis=0)
    return FreeAir(np.arange(len(read)) / 500.0, 0.0 * read, read)


@pytest.mark.parametrize("noise", [4e-4, 0.05, 1.0])
def test_how_long_a_wrench_may_repeat_follows_from_the_sensor_whatever_its_noise(noise) -> None:
    assert longest_repeat(air(noise)) == 10
    assert longest_repeat(air(noise, noise / 2)) < 60
    assert 40 <= longest_repeat(air(noise, every=4)) < 100
    assert longest_repeat(air(0.0)) == 0.0
