"""What rests in several orientations tell of load and sensor: law by law, on made recordings."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from made_arm import Arm, half_width, holds, resting, truth
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from tpcd.identification.identify import identify
from tpcd.identification.quantity import LEVEL, quantity
from tpcd.identification.rests import find_rests
from tpcd.quality.finding import Finding, Weight

AXES = ("x", "y", "z")
WEIGHED = ("weight", "force_bias", "torque_bias", "centre_of_mass", "sensor_rotation")
RUNS = 60
FALSE_ALARM = 1e-5
"""Of one quantity's coverage test."""


@pytest.mark.parametrize("frame", ["tool", "world"])
def test_intervals_hold_the_truth_as_often_as_they_say_under_creep_and_slow_noise(frame) -> None:
    arm = Arm(frame=frame, sensor_rotation=(0.05, -0.1, 0.2))
    expected = {name: v for name, v in truth(arm).items() if name.startswith(WEIGHED)}
    hit, widths = Counter(), {name: [] for name in expected}
    for seed in range(RUNS):
        told = identify(resting(arm, seed, orientations=7, crosstalk=0.1))
        assert quantity(told, "wrench_frame").value == frame
        for name, value in expected.items():
            hit[name] += holds(quantity(told, name), value)
            widths[name].append(half_width(quantity(told, name)))
    least = binom.ppf(FALSE_ALARM, RUNS, LEVEL)
    assert {name: count for name, count in hit.items() if count < least} == {}
    # Errors of an orientation are 0.1 N; an interval of many times that would hold anything.
    assert np.median(widths["weight"]) < 0.4 and np.median(widths["force_bias_x"]) < 0.4
    assert np.median(widths["sensor_rotation_z"]) < 0.1
    assert np.median(widths["centre_of_mass_z"]) < 0.01


def test_a_rest_that_was_touched_is_left_out_and_told() -> None:
    arm = Arm()
    log = resting(arm, 3, orientations=10)
    first, end = find_rests(log)[4]
    forces = log.forces.copy()
    forces[first:end] += [0.0, 0.0, 4.0]
    told = identify(replace(log, forces=forces))
    weight = quantity(told, "weight")
    assert "9 rests" in weight.basis and "1 left out" in weight.basis
    assert holds(weight, arm.weight) and half_width(weight) < 0.3


def test_what_findings_leave_out_is_not_used() -> None:
    arm = Arm()
    log = resting(arm, 4, orientations=8)
    first, end = find_rests(log)[2]
    forces = log.forces.copy()
    forces[first:end] = 0.0
    gap = Finding("frozen", Weight.LEFT_OUT, "frozen", start=log.times[first], end=log.times[end])
    told = identify(replace(log, forces=forces, findings=(gap,)))
    assert "7 rests" in quantity(told, "weight").basis
    assert holds(quantity(told, "weight"), arm.weight)


def test_one_orientation_tells_neither_weight_nor_bias_and_how_to_move() -> None:
    log = resting(Arm(), 5, orientations=6, tilt=0.0)
    told = identify(log)
    for name in ("weight", "force_bias_z", "torque_bias_x", "centre_of_mass_z"):
        found = quantity(told, name)
        assert not found.told and "in 1 orientation," in found.reason
        assert "six orientations" in found.motion


def test_a_rest_that_comes_again_in_the_same_orientation_counts_once() -> None:
    arm = Arm()
    once = quantity(identify(resting(arm, 6, orientations=7, crosstalk=0.1)), "weight")
    log = resting(arm, 6, orientations=7, crosstalk=0.1)
    twice = replace(
        log,
        times=np.concatenate((log.times, log.times + log.times[-1] + 5.0)),
        positions=np.tile(log.positions, (2, 1)),
        rotations=Rotation.from_quat(np.tile(log.rotations.as_quat(), (2, 1))),
        forces=np.tile(log.forces, (2, 1)),
        torques=np.tile(log.torques, (2, 1)),
    )
    again = quantity(identify(twice), "weight")
    assert half_width(again) == pytest.approx(half_width(once), rel=0.05)


def test_rows_read_one_by_one_are_rests() -> None:
    arm = Arm()
    log = resting(arm, 7, orientations=8)
    rows = [(a + b) // 2 for a, b in find_rests(log)]
    kept = np.zeros(len(log), dtype=bool)
    kept[rows] = True
    told = identify(log.only(kept))
    assert "8 rests" in quantity(told, "weight").basis
    assert holds(quantity(told, "weight"), arm.weight)


def test_a_sensor_mounted_the_other_way_round_is_found() -> None:
    turn = Rotation.from_euler("zx", [90.0, 180.0], degrees=True).as_rotvec()
    arm = Arm(sensor_rotation=tuple(turn))
    told = identify(resting(arm, 8, orientations=10))
    found = [quantity(told, f"sensor_rotation_{a}").value for a in AXES]
    away = Rotation.from_rotvec(found) * Rotation.from_rotvec(turn).inv()
    assert away.magnitude() < 0.05
    assert holds(quantity(told, "weight"), arm.weight)


def test_an_arm_whose_world_has_no_z_upwards_is_told_no_weight() -> None:
    side = Rotation.from_rotvec([0.0, np.pi / 2, 0.0])
    for seed in range(4):
        log = resting(Arm(), seed)
        told = identify(replace(log, rotations=side * log.rotations))
        for name in ("weight", "force_bias_x", "centre_of_mass_z"):
            assert "z is not up" in quantity(told, name).reason


def test_forces_without_torques_tell_the_load_and_no_centre_of_mass() -> None:
    arm = Arm()
    log = resting(arm, 9)
    bare = replace(log, torques=0 * log.torques, missing=frozenset({"T_x", "T_y", "T_z"}))
    told = identify(bare)
    assert holds(quantity(told, "weight"), arm.weight)
    assert "not recorded" in quantity(told, "centre_of_mass_x").reason


def test_a_planar_recording_tells_the_load_in_its_plane() -> None:
    arm = Arm(force_bias=(1.0, 0.0, 3.0), torque_bias=(0.0, -0.05, 0.0), centre=(0.01, 0.0, 0.06))
    whole = resting(arm, 10)
    angles = np.linspace(-2.0, 2.0, 8)
    rests = find_rests(whole)
    turns = np.zeros((len(whole), 3))
    for angle, (first, end) in zip(angles, rests, strict=True):
        turns[first:end, 1] = angle
    rotations = Rotation.from_rotvec(turns)
    weight = rotations.inv().apply([0.0, 0.0, arm.weight])
    random = np.random.default_rng(0)
    forces = weight + np.array(arm.force_bias) + 0.05 * random.standard_normal(turns.shape)
    torques = np.cross(arm.centre, weight) + np.array(arm.torque_bias)
    torques = torques + 0.005 * random.standard_normal(turns.shape)
    forces[:, 1], torques[:, [0, 2]] = 0.0, 0.0
    planar = replace(
        whole,
        rotations=rotations,
        forces=forces,
        torques=torques,
        missing=frozenset({"y", "F_y", "T_x", "T_z"}),
    )
    told = identify(planar)
    expected = truth(arm)
    names = ("weight", "force_bias_x", "force_bias_z", "torque_bias_y")
    for name in (*names, "centre_of_mass_x", "centre_of_mass_z"):
        assert holds(quantity(told, name), expected[name]), name
    assert not quantity(told, "force_bias_y").told and not quantity(told, "centre_of_mass_y").told
