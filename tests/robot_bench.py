"""An emulated controller, and an arm on it, for the tests that drive the real client."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.emulator import EmulatorSettings
from tpcd.robot.emulator.process import running_emulator
from tpcd.robot.ur import UniversalRobot

_COUNT = itertools.count(1)
SURFACE = 5.0
"""Yield of floor and wall [mm per 10 N]: soft, so that the arm settles soon."""


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
