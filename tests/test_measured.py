"""Real recordings: converters and geometry on made data, and known answers where the sets are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_arm import Arm, resting
from scipy.spatial.transform import Rotation

import eval.measured as package
from eval.measured.__main__ import (
    Measurements,
    _checked,
    _imported,
    balance,
    evaluate_measured,
    placeless,
)
from eval.measured.page import page_text
from eval.measured.pivoting import Held, episode, joined, read_held
from eval.measured.sets import FOLDER_VARIABLE, Recording, measured_folder, recordings, write_table
from tpcd.data.checks import check_rows
from tpcd.errors import FileError
from tpcd.identification.identify import identify
from tpcd.identification.quantity import quantity
from tpcd.identification.rests import find_rests

PAGE = Path(package.__file__).parent / "README.md"
RESULTS = Path(package.__file__).parent / "results.json"
STIFFNESS = np.array([1000.0, 1000.0, 30.0])


def held(theta: float, begun: float, friction: float = 0.0, slide: float = -0.01) -> Held:
    """A palm that rests at `theta` on an object that pivots, whose command is such that springs and
    weight leave `friction` about the pivot."""
    times = np.arange(0.0, 4.0, 1.0 / 30.0)
    share = np.clip(times / 2.0, 0.0, 1.0)
    contact = np.column_stack(
        (np.full_like(times, -0.118), np.full_like(times, slide), begun + share * (theta - begun))
    )
    made = Held(times, contact, np.zeros(3), STIFFNESS, np.array([0.53, 0.0]), 0.8, -0.05)
    pose = made.poses()[-1]
    lever, pressed = pose[:2] - made.pivot, np.array([3.0, 30.0])
    # The palm presses the object with -pressed; what is left turns it the way theta grows.
    turning = -(lever[1] * pressed[0] - lever[0] * pressed[1])
    torque = friction - turning - made.moment * np.sin(theta - made.upright)
    command = np.append(pose[:2] - pressed / STIFFNESS[:2], pose[2] - torque / STIFFNESS[2])
    return replace(made, command=command)


def test_the_palm_stands_over_the_pivot_and_leans_the_way_theta_grows() -> None:
    upright, leaning = (held(angle, angle, slide=0.0).poses()[-1] for angle in (0.0, 0.3))
    assert upright == pytest.approx([0.53, 0.118, 0.0])
    expected = [0.53 + 0.118 * np.sin(0.3), 0.118 * np.cos(0.3), -0.3]
    assert leaning == pytest.approx(expected)


def test_moments_that_balance_leave_nothing_and_what_they_leave_is_friction() -> None:
    for theta in (-0.2, 0.1):
        assert held(theta, theta).moment_left() == pytest.approx(0.0, abs=1e-9)
        assert held(theta, theta, 1.6).moment_left() == pytest.approx(1.6, abs=1e-9)


def test_only_the_right_geometry_leaves_the_same_of_every_hold() -> None:
    random = np.random.default_rng(0)
    made = [
        held(theta, begun, -1.6 * np.sign(begun), slide)
        for theta, begun, slide in zip(
            random.uniform(-0.1, 0.1, 8),
            [-0.3, 0.3] * 4,
            random.uniform(-0.02, 0.0, 8),
            strict=True,
        )
    ]
    found = balance(made)
    assert found["as derived"]["below"] == pytest.approx(1.6, abs=1e-6)
    assert found["as derived"]["above"] == pytest.approx(-1.6, abs=1e-6)
    assert found["as derived"]["scatter"] < 1e-6
    others = [row["scatter"] for name, row in found.items() if name != "as derived"]
    assert min(others) > 0.05


def test_the_episode_of_the_palm_obeys_the_format_and_says_what_was_assumed() -> None:
    jitter = 1e-5 * np.random.default_rng(1).standard_normal((120, 3))
    made = [held(theta, -0.3) for theta in (-0.05, 0.0, 0.05)]
    made = [replace(one, contact=one.contact + jitter) for one in made]
    found = episode(made)
    check_rows(
        Path("palm.csv"),
        found.commands.numpy(),
        found.poses.numpy(),
        found.wrenches.numpy(),
        found.sensor_std.numpy(),
        found.stiffness.numpy(),
    )
    assert len(found) == 4
    assert "not recorded" in str(found.notes) and "computed" in str(found.notes)
    springs = found.stiffness * (found.poses - found.commands)
    torch.testing.assert_close(found.wrenches, springs, rtol=0.0, atol=1e-9)
    assert found.wrenches[1:, 1].numpy() == pytest.approx(30.0, abs=0.1)


def test_a_joined_palm_is_read_as_a_computed_wrench(tmp_path: Path) -> None:
    columns = joined([held(theta, -0.3) for theta in (-0.05, 0.0, 0.05)])
    table = write_table(tmp_path / "palm.csv", columns)
    recording = Recording("palm", "pbal_impedance", table, tuple(f"{c}={c}" for c in columns))
    told = identify(recording.read())
    assert "computed" in str(quantity(told, "wrench_source").value)
    assert quantity(told, "stiffness_z").value == pytest.approx(1000.0)


def _written_sets(folder: Path) -> None:
    """Folders as those of the sets, with made data in them."""
    ati, franka = folder / "ati_static_poses", folder / "franka_taskboard"
    iiwa = folder / "iiwa_screw_contact"
    for each in (ati, franka, iiwa):
        each.mkdir(parents=True)
    for frame, seed in (("world", 1), ("tool", 2)):
        log = resting(Arm(frame=frame), seed, orientations=7)
        quaternions = log.rotations.as_quat()
        if frame == "world":
            rows = [(a + b) // 2 for a, b in find_rests(log)]
            poses = np.column_stack((log.positions, quaternions))[rows]
            wrenches = np.column_stack((log.forces, log.torques))[rows]
            np.savetxt(ati / "recorded_messages_pose.txt", poses, delimiter=", ")
            np.savetxt(ati / "recorded_messages_wrench.txt", wrenches, delimiter=", ")
        else:
            rows = np.column_stack((log.times, log.forces, log.torques, quaternions))
            np.savetxt(ati / "GP2025-07-22-22-06-02.txt", rows, delimiter=", ")
    random = np.random.default_rng(3)
    rotations = Rotation.from_rotvec(0.1 * random.standard_normal((200, 3))).as_quat()
    names = [f"current_pos_{a}" for a in "xyz"]
    names += [f"current_orientation_{a}" for a in "wxyz"]
    names += [f"goal_pos_{a}" for a in "xyz"] + [f"goal_orientation_{a}" for a in "wxyz"]
    names += [f"force_{a}" for a in "xyz"] + [f"torque_{a}" for a in "xyz"]
    first = np.column_stack((random.standard_normal((200, 3)), np.roll(rotations, 1, axis=1)))
    values = np.column_stack((first, first, random.standard_normal((200, 6))))
    write_table(franka / "data_trial1.csv", dict(zip(names, values.T, strict=True)))
    names = ["timestamp", *"XYZABC", *(f"{k}{a}" for k in "FT" for a in "xyz")]
    values = np.column_stack((1.6e12 + 21.0 * np.arange(200), random.standard_normal((200, 12))))
    write_table(iiwa / "sensor_data.csv", dict(zip(names, values.T, strict=True)))


def test_every_recording_of_the_sets_is_read_as_it_was_made(tmp_path: Path) -> None:
    _written_sets(tmp_path / "sets")
    found = recordings(tmp_path / "sets", tmp_path / "tables")
    assert [each.set for each in found] == [
        "ati_static_poses", "ati_static_poses", "franka_taskboard", "iiwa_screw_contact",
    ]  # fmt: skip
    arm = Arm()
    for each, frame in zip(found[:2], ("world", "tool"), strict=True):
        told = identify(each.read())
        assert quantity(told, "wrench_frame").value == frame
        low, high = quantity(told, "weight").interval or (0.0, 0.0)
        assert low <= arm.weight <= high
    franka, iiwa = (each.read() for each in found[2:])
    assert franka.command_positions is not None and franka.times[1] == pytest.approx(0.05)
    # Quaternions that begin with w are read by their names.
    assert franka.rotations.magnitude().max() < 1.0
    assert iiwa.command_positions is None and iiwa.times[1] == pytest.approx(0.021, abs=1e-4)


def test_check_and_import_of_a_made_set_leave_figures_and_no_places(tmp_path: Path) -> None:
    _written_sets(tmp_path / "sets")
    turning = recordings(tmp_path / "sets", tmp_path / "tables")[1]
    checked, imported = _checked(turning, tmp_path), _imported(turning, tmp_path)
    assert checked["code"] == 0 and checked["verdict"].startswith("usable")
    noise = {row["channel"]: row["noise of a sample"] for row in checked["noise"]}
    # White and slow noise of one size each.
    assert 0.1 < noise["F_x"] < 0.4
    assert imported["code"] == 3
    assert any("no set points in the map" in line for line in imported["said"])
    assert str(tmp_path) not in json.dumps([checked, imported])


def test_rows_too_far_apart_for_an_import_are_told_so_and_no_command_is_missed(tmp_path) -> None:
    _written_sets(tmp_path / "sets")
    static = recordings(tmp_path / "sets", tmp_path / "tables")[0]
    said = _imported(static, tmp_path)
    assert said["code"] == 2
    assert any("the 8 samples of a row: they come every 10 s" in line for line in said["said"])
    assert not any("command" in line for line in said["said"])


def test_places_of_this_machine_are_left_out_of_lines() -> None:
    line = "episode in /mnt/runs/measured/import/episode.csv, from /data/sets/a.csv"
    told = placeless(line, ["/mnt/runs/measured", "/data/sets"])
    assert told == "episode in import/episode.csv, from a.csv"


def test_without_the_sets_the_command_says_which_variable_to_set(monkeypatch, tmp_path) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    assert measured_folder() is None
    with pytest.raises(FileError, match="TPCD_MEASURED.*is not set"):
        evaluate_measured(Measurements(out=tmp_path / "run"))
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(FileError, match="does not exist"):
        measured_folder()


def test_the_page_is_what_its_results_say_and_holds_no_samples() -> None:
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    assert PAGE.read_text(encoding="utf-8") == page_text(results)
    known = results["recordings"][0]["known"]
    assert len(known) == 7 and all(row["holds"] for row in known)

    def longest(value: object) -> int:
        if isinstance(value, dict):
            return max((longest(each) for each in value.values()), default=0)
        if not isinstance(value, list):
            return 0
        numbers = sum(isinstance(each, float) for each in value)
        return max([numbers, *(longest(each) for each in value)])

    # Intervals are the longest runs of numbers.
    assert longest(results["recordings"]) <= 2
    assert "folder" not in results["versions"] and "out" not in results["config"]


needs_sets = pytest.mark.skipif(measured_folder() is None, reason=f"{FOLDER_VARIABLE} is not set")


@needs_sets
def test_weight_and_biases_of_the_static_poses_are_within_their_intervals(tmp_path: Path) -> None:
    folder = measured_folder()
    assert folder is not None
    static, turning = recordings(folder, tmp_path)[:2]
    told = identify(static.read())
    assert quantity(told, "wrench_frame").value == "world"
    for name, known in static.known.items():
        low, high = quantity(told, name).interval or (np.inf, -np.inf)
        assert low <= known <= high, name
        # The rests scatter by 0.2 N and 3 mN·m about the fit.
        assert high - low < (0.01 if "torque" in name else 0.6), name
    assert quantity(identify(turning.read()), "wrench_frame").value == "tool"


@needs_sets
def test_both_trials_of_the_task_board_tell_the_same_arm(tmp_path: Path) -> None:
    folder = measured_folder()
    assert folder is not None
    trials = [identify(each.read()) for each in recordings(folder, tmp_path)[2:4]]
    for name in ("stiffness_x", "stiffness_y", "stiffness_z", "arm_friction_z", "pose_lag"):
        intervals = [quantity(told, name).interval for told in trials]
        assert None not in intervals
        first, second = (interval or (np.nan, np.nan) for interval in intervals)
        assert first[0] < second[1] and second[0] < first[1], name
    assert not any(quantity(told, "gain_x").told for told in trials)


@needs_sets
def test_the_palm_stops_against_the_same_friction_from_either_side() -> None:
    folder = measured_folder()
    assert folder is not None
    files = sorted((folder / "pbal_impedance").glob("*Stiffness*.json"))
    found = balance([read_held(path) for path in files])
    right = found["as derived"]
    assert right["below"] == pytest.approx(-right["above"], rel=0.1)
    assert right["scatter"] < 0.15 * right["below"]
    assert right["scatter"] == min(row["scatter"] for row in found.values())
