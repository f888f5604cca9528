"""A UR arm through the real ur_rtde client: an experiment, limits, faults, and going on."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import torch
from command_calls import PRIOR, load_script
from robot_bench import SURFACE, arm_on, arm_with, emulator_settings

from tpcd.data.episode import read_episode
from tpcd.errors import RobotError
from tpcd.robot.admittance import at_rest
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.emulator import emulated_scene
from tpcd.robot.emulator.process import running_emulator
from tpcd.robot.frames import task_frame, tcp_pose
from tpcd.robot.link import Link, Sample
from tpcd.robot.protocol import Robot
from tpcd.robot.raw import COLUMNS, RawRecord
from tpcd.robot.servo import Servo
from tpcd.robot.ur import UniversalRobot

pytest.importorskip("rtde_control")
START = torch.tensor([0.0, 0.06, 0.0], dtype=torch.float64)


def command(x: float, z: float, angle: float = 0.0) -> torch.Tensor:
    return torch.tensor([x, z, angle], dtype=torch.float64)


def raw_of(folder: Path, name: str) -> tuple[dict[str, np.ndarray], dict]:
    table = pyarrow.parquet.read_table(folder / f"{name}.parquet")
    columns = {key: table[key].to_numpy() for key in table.column_names}
    return columns, json.loads(table.schema.metadata[b"tpcd"])


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
            while arm._row == 0 or len(arm._raw) < 20:
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


def test_a_stopped_run_goes_on_and_a_slipped_object_does_not(emulator, tmp_path: Path) -> None:
    arm = arm_on(emulator, tmp_path)
    try:
        episode = arm.start()
        x, z, _ = episode.poses[0].tolist()
        for u in (command(x, z - 0.05), command(x + 0.02, z - 0.05, 0.08)):
            reading = arm.settle(u)
            episode = episode.with_row(u, reading.pose, reading.wrench)
    finally:
        arm.stop()
        arm.close()
    again = arm_on(emulator, tmp_path)
    try:
        again.resume(episode)
        reading = again.settle(episode.commands[-1])
        torch.testing.assert_close(reading.pose, episode.poses[-1], atol=1.5e-3, rtol=0)
    finally:
        again.stop()
        again.close()
    names = {path.stem for path in tmp_path.glob("row_*.parquet")}
    assert names == {"row_001", "row_001-2", "row_002", "row_002-2", "row_003"}
    slipped = replace(episode, poses=episode.poses + command(0.0, 0.004)[None])
    slipped.poses[0] = episode.poses[0]
    third = arm_on(emulator, tmp_path)
    try:
        with pytest.raises(
            RobotError, match=r"repeating move 1 ends [345]\.\d mm.* the object has slipped"
        ):
            third.resume(slipped)
        assert third.at_rest == "the arm has retreated"
    finally:
        third.stop()
        third.close()
    (tmp_path / "frame.json").unlink()
    with pytest.raises(RobotError, match=r"frame.json is missing"):
        arm_on(emulator, tmp_path).resume(episode)


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
    ],
)
def test_a_sensor_that_zeroing_does_not_mend_is_refused(
    fault: str, said: str, tmp_path: Path
) -> None:
    with arm_with(tmp_path, fault=fault) as arm, pytest.raises(RobotError, match=said):
        arm.start()


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


def test_the_force_limit_holds_again_after_a_retreat_that_fails() -> None:
    frame = task_frame(np.array([0.4, 0.0, 0.1, np.pi, 0.0, 0.0]))
    place = np.array([0.1, 0.1, 0.0])
    tcp = tcp_pose(frame, place)
    forces = (25.0, 40.0, 25.0, 25.0)
    samples = [
        Sample(0.008 * k, tcp, np.array([0.0, 0.0, force, 0.0, 0.0, 0.0]), tcp, 0.0)
        for k, force in enumerate(forces)
    ]
    servo = Servo(ArmSettings("nowhere"), StubLink(samples), frame, RawRecord())
    servo.state = at_rest(place, np.zeros(3))
    with pytest.raises(RobotError, match="met a force of 40"):
        servo.retreat()
    with pytest.raises(RobotError, match="beyond the limit of 20 N"):
        for _ in range(2):
            servo.read()


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
    servo = Servo(ArmSettings("nowhere"), StubLink(samples), frame, RawRecord())
    if said == "does not follow":
        servo.state = at_rest(np.array([0.1, 0.1, 0.0]), np.zeros(3))
    with pytest.raises(RobotError, match=said):
        for _ in range(3):
            servo.read()


def robot_command(*arguments: str) -> int:
    from tpcd.cli import run

    module = load_script("robot")
    with pytest.raises(SystemExit) as stopped:
        run(module.explore_with_robot, module.Experiment, list(arguments), prog="robot.py")
    return int(stopped.value.code or 0)


@pytest.mark.slow
def test_the_whole_experiment_of_fifteen_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    emulator = emulator_settings(surface_mm_per_10n=2.0)
    arguments = (
        "--robot", emulator.address, "--origin", *map(str, emulator.origin), "--yes",
        "--surface_mm_per_10n", "2", "--stale_time", "1", "--payload", str(emulator.payload),
        "--prior", PRIOR, "--policy", "random", "--out", str(out),
    )  # fmt: skip
    with running_emulator(emulator):
        assert robot_command(*arguments) == 0, capsys.readouterr().err
    shown = capsys.readouterr()
    assert "all 15 moves are made" in shown.err and "wall_position" in shown.out
    episode = read_episode(out / "explore.csv")
    assert len(episode) == 16
    assert len(list((out / "raw").glob("row_*.parquet"))) == 15
    summary = json.loads((out / "summary.json").read_text())["parameters"]
    theta = emulated_scene(emulator).theta
    # The model's floor is rigid and the prior a small one: near the truth, not within intervals.
    assert summary["floor_height"]["mean"] == pytest.approx(theta["floor_height"], abs=0.01)
    assert summary["wall_position"]["mean"] == pytest.approx(theta["wall_position"], abs=0.02)
    assert summary["friction"]["mean"] == pytest.approx(theta["friction"], abs=0.15)


def test_a_fault_in_the_command_is_one_line_and_goes_on_with_resume(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    failing = emulator_settings(fault="protective_stop", fault_after=14.0)
    arguments = (
        "--origin", *map(str, failing.origin), "--yes", "--surface_mm_per_10n", str(SURFACE),
        "--stale_time", "1", "--prior", PRIOR, "--policy", "random", "--out", str(out),
        "--steps", "4",
    )  # fmt: skip
    with running_emulator(failing):
        assert robot_command("--robot", failing.address, *arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1 and "protective stop" in lines[0] and "--resume" in lines[0]
    before = read_episode(out / "explore.csv")
    assert 2 <= len(before) < 5
    sound = emulator_settings()
    with running_emulator(sound):
        assert robot_command("--robot", sound.address, *arguments, "--resume") == 0
    after = read_episode(out / "explore.csv")
    assert len(after) == 5
    torch.testing.assert_close(after.poses[: len(before)], before.poses)
    assert len((out / "steps.jsonl").read_text().splitlines()) == 4


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--floor", "1"), "floor is"),
        (("--origin", "1", "2"), "origin is"),
        (("--policy", "expert", "--origin", "0", "0", "0"), "--expert_wall"),
        (("--policy", "file", "--origin", "0", "0", "0"), "--commands"),
        (("--stop_force", "5", "--origin", "0", "0", "0"), "stop_force is 5 N"),
        ((), "neither origin nor floor"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(
    wrong: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert robot_command("--robot", "127.0.0.9", "--out", str(out), *wrong) == 2
    message = capsys.readouterr().err.strip()
    assert said in message and message.count("\n") == 0
    assert not out.exists()


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
