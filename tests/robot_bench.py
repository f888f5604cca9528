"""An emulated controller, and an arm on it, for the tests that drive the real client."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import torch

from tpcd.robot.admittance import AdmittanceSettings, at_rest
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.emulator import EmulatorSettings, emulated_frame, emulated_scene
from tpcd.robot.emulator.controller import SERVO_L, Controller
from tpcd.robot.emulator.process import running_emulator
from tpcd.robot.link import Link, Sample
from tpcd.robot.raw import RawRecord
from tpcd.robot.servo import Servo
from tpcd.robot.ur import UniversalRobot

_COUNT = itertools.count(1)
SURFACE = 5.0
"""Yield of floor and wall [mm per 10 N]: soft, so that the arm settles soon."""


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


def wired_servo(law: AdmittanceSettings | None = None, **changed: Any) -> tuple[Servo, Controller]:
    """A servo that stands at the start of an emulated scene, and the controller behind it."""
    settings = emulator_settings(**changed)
    controller = Controller(settings)
    stated = ArmSettings("wired", surface_mm_per_10n=settings.surface_mm_per_10n)
    frame = emulated_frame(settings)
    servo = Servo(stated, Wired(controller, stated.rate), frame, RawRecord())
    servo._law = law or servo._law
    servo.state = at_rest(emulated_scene(settings).start_pose.numpy(), np.zeros(3))
    servo.noise = settings.force_noise * np.array([1.0, 1.0, 0.05])
    return servo, controller
