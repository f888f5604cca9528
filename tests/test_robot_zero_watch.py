"""A zero that drifts is found where the arm is free, and the rows that are off are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from robot_bench import command, wired_arm

from tpcd.quality.finding import Weight
from tpcd.robot.emulator import controller as emulated
from tpcd.robot.free_space import is_free
from tpcd.robot.preflight import FreeAir
from tpcd.robot.protocol import Reading
from tpcd.robot.zero_watch import ZeroWatch

NOISE = np.array([0.2, 0.2, 0.01])
STD = np.array([1e-4, 1e-4, 1e-4, 0.03, 0.03, 0.002])
START, ABOVE = np.array([0.0, 0.06, 0.0]), np.array([-0.015, 0.09, 0.0])


def air(stamp: float, pose: np.ndarray, wrench: np.ndarray, seed: int, count: int = 25) -> FreeAir:
    noise = NOISE * np.random.default_rng(seed).standard_normal((count, 3))
    stamps = stamp + np.arange(count) / 125
    return FreeAir(stamps, np.tile(pose, (count, 1)), wrench + noise)


def reading(stamp: float, pose: tuple, wrench: tuple, settled: bool = True) -> Reading:
    tensors = (torch.tensor(value, dtype=torch.float64) for value in (pose, wrench))
    return Reading(*tensors, settled, stamps=(stamp - 0.3, stamp + 0.3))


def watch(seed: int = 0, first_new: int = 0, turning: float = 0.0) -> ZeroWatch:
    zeroed = air(0.0, ABOVE, np.zeros(3), seed, 375)
    return ZeroWatch(zeroed, air(4.0, START, np.zeros(3), seed + 1), STD, NOISE, turning, first_new)


def test_what_is_above_and_to_the_left_of_a_free_pose_is_free() -> None:
    assert is_free(np.array([-0.01, 0.07, 0.0]), [START])
    assert not is_free(np.array([0.01, 0.07, 0.0]), [START])
    assert not is_free(np.array([-0.01, 0.05, 0.0]), [START])
    assert not is_free(np.array([-0.01, 0.07, 0.1]), [START])
    assert is_free(np.array([-0.03, 0.09, -0.1]), [START])


def test_the_rows_that_a_drift_puts_off_are_named_with_channel_and_size() -> None:
    """0.02 N/s from zeroing at 1.5 s: row k, at 10 k s, is off by 0.2 k - 0.03 N."""
    zero = watch()
    for row in range(1, 11):
        zero.moved(row, reading(10.0 * row, (0.05, -0.02, 0.0), (0.0, 3.0, 0.0)))
    assert zero.doubts() == ()
    (doubt,) = zero.doubts(air(110.0, ABOVE, np.array([0.0, 2.17, 0.0]), 7))
    assert doubt.weight is Weight.DOUBT and doubt.channels == ("F_z",)
    assert "F_z reads 2.2 N in free air after row 10, expected at most 0.25 N" in str(doubt)
    assert "rows 1 to 10 are off by 0.18 to 2 N, with a noise of 0.03 N" in str(doubt)


def test_rows_up_to_the_last_reading_that_was_zero_are_not_named() -> None:
    zero = watch()
    for row in range(1, 11):
        free = row == 5
        pose = (-0.02, 0.1, 0.0) if free else (0.05, -0.02, 0.0)
        zero.moved(row, reading(10.0 * row, pose, (0.0, 0.0 if free else 3.0, 0.0)))
    (doubt,) = zero.doubts(air(100.0, ABOVE, np.array([-1.0, 0.0, 0.0]), 7))
    assert doubt.channels == ("F_x",) and "rows 6 to 10 are off by 0.22 to 1.1 N" in str(doubt)


def test_rows_of_an_earlier_session_are_not_those_of_this_zero() -> None:
    zero = watch(first_new=4)
    for row in range(1, 6):
        zero.moved(row, reading(10.0 * row, (0.05, -0.02, 0.0), (0.0, 3.0, 0.0)))
    (doubt,) = zero.doubts(air(60.0, ABOVE, np.array([0.0, 0.0, 0.2]), 7))
    assert doubt.channels == ("tau",) and "rows 4 to 5 are off" in str(doubt)


def test_no_false_alarm_in_a_thousand_runs_with_a_payload_that_is_allowed() -> None:
    """0.2 kg too much, at a lever of 0.1 m, with the tool turned by up to 0.15 rad."""
    generator, told = np.random.default_rng(0), 0
    for seed in range(1000):
        angle = generator.uniform(-0.15, 0.15)
        force = 0.2 * 9.81 * angle
        zero = watch(seed, turning=0.2 * 9.81 * 0.1)
        for row in range(1, 6):
            noise = STD[3:] * generator.standard_normal(3)
            zero.moved(row, reading(10.0 * row, (-0.1, 0.2, angle), tuple(noise + force * TILTED)))
        last = air(60.0, np.array([-0.1, 0.2, angle]), force * TILTED, seed)
        told += bool(zero.doubts(last))
    assert told == 0


TILTED = np.array([1.0, 0.0, 0.1])


@pytest.mark.parametrize("drift", [0.0, 0.05])
def test_a_run_on_an_arm_whose_sensor_drifts_tells_so_at_its_end(
    drift: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(emulated, "DRIFT", drift)
    arm, controller = wired_arm(tmp_path, force_noise=0.05, fault="drifting_sensor")
    x, z, _ = arm.start().poses[0].tolist()
    zeroed = controller._zero[2]
    pressed = [arm.settle(command(x, z - 0.05)) for _ in range(2)]
    assert arm.doubts() == ()
    arm.stop()
    assert arm.at_rest == "the arm has retreated"
    if not drift:
        assert arm.doubts() == ()
        return
    (doubt,) = arm.doubts()
    at = drift * np.mean(pressed[1].stamps) + zeroed
    assert doubt.channels == ("F_z",) and "rows 0 to 2 are off by 0." in str(doubt)
    told = float(str(doubt).split(" to ")[-1].split(" N")[0])
    assert told == pytest.approx(abs(at), abs=0.1)
