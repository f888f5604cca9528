"""Recordings that ur_rtde's own client writes of a controller are read as they are."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from robot_bench import emulator_settings
from scipy.spatial.transform import Rotation

from tpcd.logs.columns import log_from_columns
from tpcd.logs.table import read_columns
from tpcd.robot.emulator.process import running_emulator

READ = ["timestamp", "actual_TCP_pose", "actual_TCP_force", "target_TCP_pose", "actual_q"]


@pytest.mark.parametrize("variables", [(), ("actual_TCP_pose", "actual_TCP_force", "timestamp")])
def test_a_recording_of_the_real_client_needs_no_map(
    variables: tuple[str, ...], tmp_path: Path
) -> None:
    from rtde_receive import RTDEReceiveInterface

    settings, path = emulator_settings(pace="real"), tmp_path / "robot.csv"
    with running_emulator(settings):
        receiver = RTDEReceiveInterface(settings.address, 125.0, READ)
        try:
            pose = np.array(receiver.getActualTCPPose())
            assert receiver.startFileRecording(str(path), list(variables))
            time.sleep(0.5)
            assert receiver.stopFileRecording()
        finally:
            receiver.disconnect()
    log = log_from_columns(read_columns(path), (), path)
    assert len(log) > 30 and 0.2 < log.times[-1] < 2.0
    assert np.abs(log.positions - pose[:3]).max() < 1e-3
    assert (log.rotations * Rotation.from_rotvec(pose[3:]).inv()).magnitude().max() < 1e-2
    # Noise of the sensor, and nothing else, in free air.
    assert 0.05 < log.forces.std() < 1.0
    assert log.command_positions is None and not log.missing
