"""A UR arm through the real ur_rtde client: moves, limits, and going on."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from robot_bench import Springy, arm_on, command, emulator_settings, pressing, raw_of

from tpcd.errors import RobotError
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.emulator import emulated_scene
from tpcd.robot.emulator.process import running_emulator
from tpcd.robot.protocol import Robot
from tpcd.robot.raw import COLUMNS
from tpcd.robot.ur import UniversalRobot

pytestmark = pytest.mark.usefixtures("types_unchecked")

pytest.importorskip("rtde_control")
START = torch.tensor([0.0, 0.06, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def emulator():
    settings = emulator_settings()
    with running_emulator(settings):
        yield settings


def test_moves_are_springs_and_every_reading_is_kept(emulator, tmp_path: Path) -> None:
    arm = arm_on(emulator, tmp_path, priors={"friction": (0.1, 0.9)})
    assert isinstance(arm, Robot)
    try:
        episode = arm.start()
        scene = emulated_scene(emulator)
        torch.testing.assert_close(episode.poses[0], scene.start_pose, atol=1e-4, rtol=0)
        assert episode.priors == {"friction": (0.1, 0.9)}
        # What counts as still; the fast noise, 0.2 N at 125 Hz over 0.6 s, has become motion.
        assert 0.014 < float(episode.sensor_std[4]) < 0.06
        assert 1e-4 < float(episode.sensor_std[0]) < 1e-3
        x, z, _ = episode.poses[0].tolist()
        touch = command(x, z - 0.05)
        reading = arm.settle(touch)
        assert reading.settled and reading.stamps is not None
        assert torch.equal(reading.sensor_std, episode.sensor_std)
        stiffness = episode.stiffness
        torch.testing.assert_close(
            reading.wrench, stiffness * (reading.pose - touch), atol=0.08, rtol=0
        )
        assert float(reading.wrench[1]) > 1.5
    finally:
        arm.stop()
        arm.close()
    assert arm.at_rest == "the arm has retreated"
    columns, about = raw_of(tmp_path, "row_001")
    assert tuple(columns) == COLUMNS and about["ended"] == "done" and about["row"] == 1
    rate = len(columns["stamp"]) / np.ptp(columns["stamp"])
    assert 100 < rate < 130
    assert columns["F_z"][-50:].mean() == pytest.approx(float(reading.wrench[1]), abs=0.15)
    retreat, _ = raw_of(tmp_path, "retreat")
    assert retreat["z"][-1] > retreat["z"][0] + 0.02
    assert abs(retreat["F_z"][-30:].mean()) < 0.2


def test_nothing_moves_before_it_is_confirmed(emulator, tmp_path: Path) -> None:
    shown: list[str] = []
    arm = arm_on(emulator, tmp_path)
    arm._confirm = lambda text: bool(shown.append(text))
    try:
        with pytest.raises(RobotError, match="not confirmed"):
            arm.start()
    finally:
        arm.stop()
        arm.close()
    assert "-150 to 300 mm" in shown[0] and "20 N" in shown[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"payload": 1.2}, "told a payload of 0.50 kg, expected 1.20"),
        ({"workspace_low": (0.1, 0.0, -0.1)}, "the start pose is at"),
        ({"origin": (5.0, 0.0, 0.1)}, "outside of the workspace"),
        ({"x_axis": "z"}, "0.0 degrees apart"),
    ],
)
def test_an_arm_that_is_not_as_stated_does_not_start(
    settings: dict, said: str, emulator, tmp_path: Path
) -> None:
    arm = arm_on(emulator, tmp_path, **settings)
    try:
        with pytest.raises((RobotError, ValueError), match=said):
            arm.start()
    finally:
        arm.stop()
        arm.close()


def test_a_force_beyond_the_limit_stops_and_the_arm_retreats(emulator, tmp_path: Path) -> None:
    arm = arm_on(emulator, tmp_path, stop_force=6.0)
    try:
        x, z, _ = arm.start().poses[0].tolist()
        with pytest.raises(RobotError, match="beyond the limit of 6 N.*has retreated"):
            arm.settle(command(x, z - 0.12))
    finally:
        arm.stop()
        arm.close()
    stopped, about = raw_of(tmp_path, "row_001")
    assert "beyond the limit" in about["ended"]
    assert np.abs(stopped["F_z"][-2:]).min() > 6.0 and np.abs(stopped["F_z"]).max() < 9.0
    retreat, _ = raw_of(tmp_path, "retreat")
    assert abs(retreat["F_z"][-30:].mean()) < 0.3


def test_a_command_outside_of_the_workspace_is_refused_where_it_stands(
    emulator, tmp_path: Path
) -> None:
    arm = arm_on(emulator, tmp_path)
    try:
        episode = arm.start()
        with pytest.raises(RobotError, match=r"a command is at \(0.500"):
            arm.settle(command(0.5, 0.06))
        reading = arm.settle(episode.commands[0])
        torch.testing.assert_close(reading.pose, episode.poses[0], atol=1e-3, rtol=0)
    finally:
        arm.stop()
        arm.close()


def test_ctrl_c_in_a_move_retreats_and_keeps_it(emulator, tmp_path: Path) -> None:
    arm = arm_on(emulator, tmp_path)
    # A shell starts what runs in the background with Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        x, z, _ = arm.start().poses[0].tolist()

        def interrupt() -> None:
            while arm._guard.row == 0 or len(arm._guard.servo.record) < 20:
                time.sleep(0.002)
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            arm.settle(command(x + 0.1, z - 0.06))
        assert arm.at_rest == "the arm has retreated"
        with pytest.raises(RobotError, match="has retreated since it was stopped"):
            arm.settle(command(x, z))
    finally:
        signal.signal(signal.SIGINT, before)
        arm.stop()
        arm.close()
    columns, about = raw_of(tmp_path, "row_001")
    assert about["ended"] == "KeyboardInterrupt" and len(columns["stamp"]) > 10
    assert (tmp_path / "retreat.parquet").is_file()


def test_a_stopped_run_goes_on(emulator, tmp_path: Path) -> None:
    with arm_on(emulator, tmp_path) as arm:
        episode = arm.start()
        x, z, _ = episode.poses[0].tolist()
        press = command(x + 0.01, z - 0.05, 0.04)
        reading = arm.settle(press)
        episode = episode.with_row(press, reading.pose, reading.wrench)
    with arm_on(emulator, tmp_path) as again:
        again.resume(episode)
        reading = again.settle(press)
        torch.testing.assert_close(reading.pose, episode.poses[-1], atol=1.5e-3, rtol=0)
    names = {path.stem for path in tmp_path.glob("row_*.parquet")}
    assert names == {"row_001", "row_001-2", "row_002"}


def test_a_slipped_object_does_not_go_on(tmp_path: Path) -> None:
    def arm_at_start() -> UniversalRobot:
        arm, _ = pressing(tmp_path, origin=(0.4, 0.0, 0.1))
        arm._link = Springy((0.0, 0.06, 0.0))
        return arm

    press = command(0.0, -0.02)
    with arm_at_start() as arm:
        episode = arm.start()
        reading = arm.settle(press)
        episode = episode.with_row(press, reading.pose, reading.wrench)
    slipped = replace(episode, poses=episode.poses + command(0.0, 0.004)[None])
    slipped.poses[0] = episode.poses[0]
    with arm_at_start() as again:
        with pytest.raises(RobotError, match=r"move 1 ends 4\.\d mm.* the object has slipped"):
            again.resume(slipped)
        assert again.at_rest == "the arm has retreated"
    (tmp_path / "frame.json").unlink()
    with pytest.raises(RobotError, match=r"frame.json is missing"):
        arm_at_start().resume(episode)


@pytest.mark.robot
def test_a_real_arm_stands_still_in_free_air(tmp_path: Path) -> None:
    """TPCD_ROBOT names the controller; the arm stands free, and tilts by 0.1 rad, 30 mm up."""
    address = os.environ.get("TPCD_ROBOT")
    if not address:
        pytest.skip("TPCD_ROBOT names no arm")
    arm = UniversalRobot(ArmSettings(address), tmp_path, lambda _: True)
    try:
        episode = arm.start()
        assert float(episode.sensor_std[3:5].max()) < 1.0
    finally:
        arm.stop()
        arm.close()
