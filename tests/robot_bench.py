"""An emulated controller, and an arm on it, for the tests that drive the real client."""

from __future__ import annotations

import itertools
import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import torch
from command_calls import PRIOR, load_script

from tpcd.belief.settings import EstimatorSettings, SamplerSettings
from tpcd.errors import RobotError
from tpcd.robot.admittance import AdmittanceSettings, at_rest
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.emulator import EmulatorSettings, emulated_frame, emulated_scene
from tpcd.robot.emulator.controller import SERVO_L, SERVO_STOP, ZERO_SENSOR, Controller
from tpcd.robot.emulator.process import running_emulator
from tpcd.robot.frames import task_frame, tcp_pose
from tpcd.robot.link import Link, Sample
from tpcd.robot.raw import RawRecord
from tpcd.robot.servo import Servo
from tpcd.robot.settling import SettlingSettings
from tpcd.robot.ur import UniversalRobot

_COUNT = itertools.count(1)
FEW = SamplerSettings(particles=60, draws=200, places=10, fresh_modes=4, prior_draws=100)
SURFACE = 5.0
"""Yield of floor and wall [mm per 10 N]: soft, so that the arm settles soon."""
STATED_TIME = 2.0
"""Within which an arm is away from what it touched (tpcd/robot/README.md) [s]."""
PRESSED = (0.1, -5e-4, 0.0)
"""Where the arm stands when a move begins: in the floor by 1 N [m, m, rad]."""
PRESSING = torch.tensor([0.1, -0.013, 0.0], dtype=torch.float64)
"""A command that takes a short way further down."""


def command(x: float, z: float, angle: float = 0.0) -> torch.Tensor:
    """Of an impedance [m, m, rad]."""
    return torch.tensor([x, z, angle], dtype=torch.float64)


def raw_of(folder: Path, name: str) -> tuple[dict[str, np.ndarray], dict]:
    """The columns of a raw recording, and what is said about it."""
    table = pyarrow.parquet.read_table(folder / f"{name}.parquet")
    columns = {key: table[key].to_numpy() for key in table.column_names}
    return columns, json.loads(table.schema.metadata[b"tpcd"])


def free_address() -> str:
    """A loopback address of its own for every emulator, also in tests side by side."""
    process = os.getpid()
    return f"127.{1 + process // 250 % 250}.{1 + process % 250}.{next(_COUNT)}"


def emulator_settings(**changed: Any) -> EmulatorSettings:
    """An emulator at the client's pace with a mug in its hand."""
    settings: dict[str, Any] = {
        "address": free_address(), "outline": "mug", "seed": 1, "pace": "client",
        "surface_mm_per_10n": SURFACE, "fault_after": 12.0,
    }  # fmt: skip
    return EmulatorSettings(**{**settings, **changed})


def arm_on(emulator: EmulatorSettings, folder: Path, **changed: Any) -> UniversalRobot:
    """An arm that knows the emulator's surface and origin, with its workspace confirmed."""
    settings: dict[str, Any] = {
        "address": emulator.address, "origin": emulator.origin, "still_time": 1.5,
        "stale_time": 1.0, "surface_mm_per_10n": SURFACE, "payload": emulator.payload,
        "noise_free": emulator.force_noise == 0.0,
    }  # fmt: skip
    return UniversalRobot(ArmSettings(**{**settings, **changed}), folder, lambda _: True)


@contextmanager
def arm_with(folder: Path, arm: dict[str, Any] | None = None, **emulator: Any) -> Iterator[Any]:
    """An arm on an emulator of its own; both are closed with the block."""
    settings = emulator_settings(**emulator)
    with running_emulator(settings):
        robot = arm_on(settings, folder, **(arm or {}))
        try:
            yield robot
        finally:
            robot.close()


class Wired(Link):
    """A controller in this process, as a link sees it: emulated time, no network, no client."""

    def __init__(self, controller: Controller, rate: float) -> None:
        self.controller, self.rate, self.alive = controller, rate, True
        controller.running = True

    def next_sample(self) -> Sample:
        """The reading after this one."""
        for _ in range(round(500 / self.rate)):
            self.controller.advance()
        told = self.controller.outputs()
        tcp, wrench, target = (
            np.array(told[name])
            for name in ("actual_TCP_pose", "actual_TCP_force", "target_TCP_pose")
        )
        return Sample(told["timestamp"], tcp, wrench, target, 0.0)

    def servo(self, target: np.ndarray) -> None:
        """A target for the controller."""
        values = {f"input_double_register_{index}": v for index, v in enumerate(target.tolist())}
        self.controller.write({**values, "input_int_register_0": SERVO_L})

    def zero_sensor(self) -> None:
        """Take the present wrench for zero."""
        self.controller._execute(ZERO_SENSOR)

    def payload(self) -> float:
        """Mass that the controller was told it carries [kg]."""
        return self.controller.payload

    def stop(self) -> None:
        """End the servo."""
        self.controller._execute(SERVO_STOP)

    def disconnect(self) -> None:
        """Nothing is open."""
        self.alive = False


class Springy(Link):
    """An arm that is where it was told to be over a floor that is a spring, quick enough to fail in
    every way that there is. The tool points down, at angle zero."""

    def __init__(self, pose: tuple[float, float, float], drift: float = 0.0) -> None:
        """`drift` of the force [N/s]."""
        self.alive, self.rate, self.time, self._drift = True, 125.0, 0.0, drift
        self.frame = task_frame(np.array([0.4, 0.0, 0.1, np.pi, 0.0, 0.0]))
        self.target = tcp_pose(self.frame, np.array(pose))
        self.zero, self.sent = 0.0, 0

    @property
    def force(self) -> float:
        """Of the floor where the arm was told to be [N]."""
        return 2000.0 * max(0.0, float(self.frame.origin[2] - self.target[2]))

    def next_sample(self) -> Sample:
        """The reading after this one."""
        self.time += 1 / self.rate
        wrench = np.array([0.0, 0.0, self.sensed - self.zero, 0.0, 0.0, 0.0])
        return Sample(self.time, self.target, wrench, self.target, 0.0)

    @property
    def sensed(self) -> float:
        """What the sensor makes of the force before it is zeroed [N]."""
        return self.force + self._drift * self.time

    def servo(self, target: np.ndarray) -> None:
        """Where the arm is to be."""
        self.target, self.sent = target, self.sent + 1

    def zero_sensor(self) -> None:
        """Take the present wrench for zero."""
        self.zero = self.sensed

    def payload(self) -> float:
        """What it was told that it carries [kg]."""
        return 0.5

    def stop(self) -> None:
        """Nothing to end."""

    def disconnect(self) -> None:
        """Nothing is open."""
        self.alive = False


def springy_commands(
    monkeypatch: pytest.MonkeyPatch, links: Sequence[Springy], folder: Path
) -> Callable[..., int]:
    """Calls scripts/robot.py, each time on the next of these links, with few draws, into
    `folder`/run; returns the exit code."""
    from tpcd.cli import run

    left = iter(links)
    monkeypatch.setattr("tpcd.robot.ur.Link", lambda *_: next(left))
    few = {"sampler": FEW, "closing": replace(FEW, draws=600)}
    monkeypatch.setattr(
        "tpcd.commands.exploring.EstimatorSettings", partial(EstimatorSettings, **few)
    )
    script = load_script("robot")
    words = (
        "--robot", "springy", "--origin", "0.4", "0", "0.1", "--noise_free", "--prior",
        PRIOR, "--policy", "random", "--out", str(folder / "run"), "--surface_mm_per_10n", "5",
    )  # fmt: skip

    def call(*more: str, yes: bool = True) -> int:
        more = (*more, *["--yes"] * yes)
        with pytest.raises(SystemExit) as stopped:
            run(script.explore_with_robot, script.Experiment, [*words, *more], prog="robot.py")
        return int(stopped.value.code or 0)

    return call


def wired_arm(
    folder: Path,
    start: np.ndarray | None = None,
    confirm: Callable[[str], bool] = lambda _: True,
    arm: dict[str, Any] | None = None,
    **changed: Any,
) -> tuple[UniversalRobot, Controller]:
    """An arm on a controller in this process, which stands at a start pose of the world, by default
    the scene's, with its sensor not yet zeroed."""
    settings = emulator_settings(**changed)
    controller = Controller(settings)
    if start is not None:
        controller._target = controller._actual = start
        controller._delayed = deque([controller._actual] * len(controller._delayed))
        controller._load = controller._sense()
    stated = {"surface_mm_per_10n": settings.surface_mm_per_10n, **(arm or {})}
    robot = arm_on(settings, folder, **stated)
    robot._confirm, robot._link = confirm, Wired(controller, robot.settings.rate)
    return robot, controller


def touching(settings: EmulatorSettings, force_x: float = 0.0, force_z: float = 0.0) -> np.ndarray:
    """The scene's start pose, moved until floor and wall, where they are to, push with a force
    without friction [N]."""
    scene = emulated_scene(settings)
    pose, points = scene.start_pose.numpy().copy(), scene.vertices_ee.numpy()
    if force_z:
        pose[1] = scene.floor_height - points[:, 1].min() - force_z * settings.compliance
    if force_x:
        pose[0] = scene.wall_position - points[:, 0].max() + force_x * settings.compliance
    return pose


def pressing(folder: Path, **stated: Any) -> tuple[UniversalRobot, Springy]:
    """An arm between two moves that presses on the floor with 1 N."""
    link = Springy(PRESSED)
    stated = {"surface_mm_per_10n": 5.0, "retreat": 0.003, "still_time": 0.3, "noise_free": True,
              **stated}  # fmt: skip
    settings = ArmSettings("springy", **stated)
    arm = UniversalRobot(settings, folder, lambda _: True)
    arm._link = link
    servo = Servo(settings, link, link.frame, RawRecord(), arm._guard.signals)
    servo.state = at_rest(np.array(PRESSED), np.array([0.0, 1.0, 0.0]))
    servo.settling = SettlingSettings(window=0.08)
    servo._command = np.array(PRESSED) - (0.0, 0.01, 0.0)
    arm._guard.servo = servo
    return arm, link


def check_rest(arm: UniversalRobot, link: Springy, force: float) -> None:
    """The arm is locked, nothing moves it, and it presses no more than before."""
    sent, target = link.sent, link.target
    assert arm.at_rest is not None
    with pytest.raises(RobotError, match="connect anew"):
        arm.settle(command(0.1, 0.0))
    arm.stop()
    assert link.sent == sent and link.target is target
    assert link.force <= force + 1e-9


def wired_servo(law: AdmittanceSettings | None = None, **changed: Any) -> tuple[Servo, Controller]:
    """A servo that stands at the start of an emulated scene, and the controller behind it."""
    settings = emulator_settings(**changed)
    controller = Controller(settings)
    stated = ArmSettings(
        "wired",
        surface_mm_per_10n=settings.surface_mm_per_10n,
        noise_free=settings.force_noise == 0.0,
    )
    frame = emulated_frame(settings)
    servo = Servo(stated, Wired(controller, stated.rate), frame, RawRecord())
    servo._law = law or servo._law
    servo.state = at_rest(emulated_scene(settings).start_pose.numpy(), np.zeros(3))
    servo.noise = settings.force_noise * np.array([1.0, 1.0, 0.05])
    return servo, controller
