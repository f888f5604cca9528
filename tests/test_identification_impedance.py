"""What w beside K (x - u) tells of an arm and its sensor, on made recordings, and what not."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arm import Arm, half_width, holds, moving, truth
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from tpcd.identification.blocks import block_edges, correlation_time, jackknife, moments
from tpcd.identification.identify import identify
from tpcd.identification.parity import fit_parity
from tpcd.identification.quantity import LEVEL, Quantity, quantity, untold
from tpcd.identification.springs import springs
from tpcd.logs.log import Log

AXES = ("x", "y", "z")
SIX = (*AXES, "rx", "ry", "rz")
RUNS, SECONDS = 12, 60.0
FALSE_ALARM = 1e-4
"""Of one quantity's coverage test."""


@pytest.mark.parametrize(
    ("arm", "sign"),
    [
        (Arm(sensor_rotation=(0.05, -0.03, 0.08), point=(0.0, 0.02, 0.05)), "of the world"),
        (Arm(frame="world", sign=-1.0), "inverted"),
    ],
    ids=["sensor turned and off the origin", "wrench in world axes and inverted"],
)
def test_intervals_hold_the_truth_as_often_as_they_say_in_contact_and_out_of_it(arm, sign) -> None:
    hit, widths = Counter(), {name: [] for name in truth(arm)}
    for seed in range(RUNS):
        told = identify(moving(arm, seed, SECONDS))
        assert quantity(told, "wrench_frame").value == arm.frame
        assert quantity(told, "stiffness_frame").value == "world"
        assert str(quantity(told, "wrench_sign").value).startswith(sign)
        for name, value in truth(arm).items():
            hit[name] += holds(quantity(told, name), value)
            widths[name].append(half_width(quantity(told, name)))
    least = binom.ppf(FALSE_ALARM, RUNS, LEVEL)
    assert {name: count for name, count in hit.items() if count < least} == {}
    assert sum(hit.values()) >= 0.93 * RUNS * len(hit)
    widest = {name: np.median(width) for name, width in widths.items()}
    assert widest["stiffness_x"] < 0.1 * arm.stiffness[0]
    assert widest["weight"] < 0.1 * abs(arm.weight)
    assert widest["arm_friction_x"] < arm.friction[0]
    assert widest["pose_lag"] < 0.03 and widest["sensor_rotation_z"] < 0.03
    assert widest["centre_of_mass_x"] < 0.007 and widest["torque_bias_z"] < 0.016


def test_gain_is_told_with_a_stiffness_and_only_times_it_without() -> None:
    arm = Arm(gain=1.2)
    log = moving(arm, 1, SECONDS)
    bare, given = identify(log), identify(log, arm.stiffness)
    assert holds(quantity(bare, "stiffness_x"), 1.2 * arm.stiffness[0])
    assert "product" in quantity(bare, "gain_x").reason
    assert holds(quantity(given, "gain_x"), 1.2)
    assert "looks the same" in quantity(given, "gain_x").basis
    # What the sensor reads beside the springs is not what its gain makes of them.
    for name in ("weight", "force_bias_x", "force_bias_z", "torque_bias_x"):
        assert holds(quantity(given, name), truth(arm)[name]), name
    assert half_width(quantity(given, "weight")) < 0.1 * abs(truth(arm)["weight"])


def test_an_axis_that_is_never_pressed_is_not_told_and_how_to_press_it() -> None:
    arm = Arm()
    log = moving(arm, 2, SECONDS)
    random = np.random.default_rng(0)
    forces = arm.force_std * random.standard_normal(log.forces.shape)
    told = identify(replace(log, forces=forces, torques=0.05 * forces))
    for axis in SIX:
        found = quantity(told, f"stiffness_{axis}")
        assert not found.told and found.motion, found
    assert not quantity(told, "wrench_sign").told


def test_frames_are_not_told_by_an_arm_that_does_not_turn() -> None:
    told = identify(moving(Arm(turn=0.005), 3, SECONDS))
    assert not quantity(told, "wrench_frame").told
    assert "fit alike" in quantity(told, "wrench_frame").reason
    assert "turn the end effector" in quantity(told, "wrench_frame").motion
    # Contact tilts it by a degree, which shows the weight to half of itself at best.
    weight = quantity(told, "weight")
    assert not weight.told or (holds(weight, Arm().weight) and half_width(weight) > 3.0)


def test_noise_on_both_sides_widens_the_stiffness_and_does_not_shift_it() -> None:
    calm, rough = Arm(), Arm(friction=(6.0, 5.0, 8.0, 0.2, 0.2, 0.2), force_std=2.0)
    found = [quantity(identify(moving(arm, 4, SECONDS)), "stiffness_x") for arm in (calm, rough)]
    assert all(holds(each, calm.stiffness[0]) for each in found)
    assert half_width(found[1]) > 3 * half_width(found[0])


def test_friction_of_an_arm_that_reverses_often_is_not_told_too_small() -> None:
    arm, off = Arm(pose_lag=0.0, turn=0.1), []
    for seed in range(4):
        sampled = springs(moving(arm, 3000 + seed))
        assert sampled is not None
        for axis, true in zip(fit_parity(sampled, "tool", "world").told, arm.friction, strict=True):
            off.append(np.mean([float(end.value) for end in axis.friction]) / true - 1.0)
    # Each is known to about 0.05, their mean to 0.01.
    assert len(off) == 24 and abs(np.mean(off)) < 0.05


def test_a_turned_sensor_does_not_shift_the_stiffness() -> None:
    arm = Arm(sensor_rotation=(0.1, -0.12, 0.15))
    told = [identify(moving(arm, seed, SECONDS)) for seed in range(3)]
    for k, axis in enumerate(AXES):
        found = [quantity(each, f"stiffness_{axis}") for each in told]
        assert all(holds(each, arm.stiffness[k]) for each in found), axis
        # What it reads along its own axis is less by half the square of the turn, 2 %.
        assert np.mean([each.value for each in found]) == pytest.approx(arm.stiffness[k], rel=0.01)


def test_a_wrench_that_was_computed_from_the_pose_is_called_so() -> None:
    log = moving(Arm(), 5, SECONDS)
    assert log.command_positions is not None and log.command_rotations is not None
    turn = (log.rotations * log.command_rotations.inv()).as_rotvec()
    away = log.positions - log.command_positions
    made = replace(log, forces=away * [600.0, 500.0, 800.0], torques=turn * [30.0, 40.0, 25.0])
    told = identify(made)
    assert "computed" in str(quantity(told, "wrench_source").value)
    assert quantity(told, "stiffness_x").value == pytest.approx(600.0)
    assert "computed" in quantity(told, "arm_friction_x").reason
    assert "computed" in quantity(told, "gain_x").reason


def test_an_arm_that_lags_by_a_time_is_told_that_time() -> None:
    for lag in (0.0, 0.12):
        told = quantity(identify(moving(Arm(pose_lag=lag), 6, SECONDS)), "pose_lag")
        assert holds(told, lag) and half_width(told) < 0.05


def test_a_late_wrench_is_told_its_lag() -> None:
    log = moving(Arm(), 7, SECONDS)
    late = 8
    told = identify(
        replace(log, forces=np.roll(log.forces, late, 0), torques=np.roll(log.torques, late, 0))
    )
    assert holds(quantity(told, "wrench_lag"), late / 50.0)


@pytest.mark.parametrize("samples", [2, 5])
def test_a_late_wrench_does_not_hide_the_friction(samples: int) -> None:
    arm, hit = Arm(), 0
    for seed in range(3):
        log = moving(arm, seed, SECONDS)
        forces, torques = (np.roll(v, samples, axis=0) for v in (log.forces, log.torques))
        told = identify(replace(log, forces=forces, torques=torques))
        for axis, value in zip(AXES, arm.friction[:3], strict=True):
            hit += holds(quantity(told, f"arm_friction_{axis}"), value)
    assert hit >= 8


@pytest.mark.parametrize("count", [2, 3, 5, 12, 60])
def test_too_few_samples_tell_nothing_and_break_nothing(count) -> None:
    log = moving(Arm(), 8, 10.0)
    short = log.only(np.arange(len(log)) < count)
    for each in (short, replace(short, command_positions=None, command_rotations=None)):
        told = identify(each)
        assert not quantity(told, "pose_lag").told
        assert all(each.told or each.reason for each in told)


@pytest.mark.filterwarnings("error")
def test_dead_channels_and_a_still_arm_break_nothing() -> None:
    log = moving(Arm(), 9, 20.0)
    assert log.command_positions is not None
    for each in (
        replace(log, forces=0 * log.forces, torques=0 * log.torques),
        replace(log, positions=0 * log.positions, command_positions=0 * log.positions),
        replace(log, command_rotations=None),
        replace(log, forces=0 * log.forces),
    ):
        assert all(found.told or found.reason for found in identify(each))


def test_without_commands_what_needs_them_is_named() -> None:
    log = moving(Arm(), 10, 20.0)
    told = identify(replace(log, command_positions=None, command_rotations=None))
    for name in ("stiffness_x", "arm_friction_rz", "pose_lag", "wrench_lag"):
        assert "no set points" in quantity(told, name).reason


def test_a_planar_recording_is_one_with_components_missing() -> None:
    random = np.random.default_rng(1)
    rows, stiffness = 60, np.array([100.0, 120.0, 50.0])
    wrench = random.normal(size=(rows, 3)) * [5.0, 5.0, 0.5]
    command = random.normal(size=(rows, 3)) * [0.05, 0.05, 0.5]
    pose = command + wrench / stiffness
    reading = 1.1 * wrench + [0.5, -0.3, 0.02] + 0.01 * random.normal(size=(rows, 3))
    nothing = np.zeros(rows)

    def turned(angle: np.ndarray) -> Rotation:
        return Rotation.from_rotvec(np.column_stack((nothing, -angle, nothing)))

    log = Log(
        Path("rows.csv"),
        2.0 * np.arange(rows),
        np.column_stack((pose[:, 0], nothing, pose[:, 1])),
        turned(pose[:, 2]),
        np.column_stack((reading[:, 0], nothing, reading[:, 1])),
        np.column_stack((nothing, -reading[:, 2], nothing)),
        np.column_stack((command[:, 0], nothing, command[:, 1])),
        turned(command[:, 2]),
        missing=frozenset({"y", "u_y", "F_y", "T_x", "T_z"}),
    )
    told = identify(log, stiffness.tolist())
    for axis in ("x", "z", "ry"):
        assert holds(quantity(told, f"gain_{axis}"), 1.1), axis
    assert "not recorded" in quantity(told, "stiffness_y").reason
    assert "not recorded" in quantity(told, "stiffness_rx").reason
    assert "one by one" in quantity(told, "pose_lag").reason


def test_stiffness_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="4 numbers, expected six"):
        identify(moving(Arm(), 11, 5.0), (1.0, 2.0, 3.0, 4.0))


def test_correlation_time_of_a_smoothed_series_is_its_width() -> None:
    random = np.random.default_rng(2)
    white = random.standard_normal(20_000)
    smooth = np.convolve(white, np.ones(25) / 5.0, mode="valid")
    assert correlation_time(white) == pytest.approx(1.0, abs=0.2)
    # A sliding mean of k samples is correlated for k samples.
    assert correlation_time(smooth) == pytest.approx(25.0, rel=0.2)


def test_the_jackknife_of_a_mean_is_the_standard_error_of_independent_blocks() -> None:
    random = np.random.default_rng(3)
    values = np.column_stack((np.ones(4000), 3.0 + random.standard_normal(4000)))
    edges = block_edges(4000, 1.0)
    found = jackknife(lambda sums: sums[0, 1] / sums[0, 0], moments(values, edges))
    assert float(found.value) == pytest.approx(values[:, 1].mean())
    # 40 blocks know it to about a ninth of itself: this is four of those.
    assert float(found.error) == pytest.approx(4000**-0.5, rel=0.45)


def test_lines_say_value_interval_and_level_or_the_reason_and_what_to_do() -> None:
    told = Quantity("pose_lag", "s", 0.05, (0.04, 0.06), 0.9, "moving")
    assert str(told) == "pose lag: 0.05 s (0.04 to 0.06 at 90%) (moving)"
    (not_told,) = untold(("weight",), "N", "it never turned", "turn it")
    assert str(not_told) == (
        "weight: the data cannot tell, because it never turned; move so: turn it"
    )
    with pytest.raises(KeyError):
        quantity((told,), "weight")
