"""What an emulated controller, and the world behind it, are like."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from tpcd.robot.frames import TaskFrame
    from tpcd.truth.scene import Scene

Fault = Literal[
    "none",
    "protective_stop",
    "frozen_link",
    "killed_controller",
    "register_in_use",
    "wrong_payload",
    "drifting_sensor",
    "frozen_sensor",
    "no_numbers",
    "local_control",
]
SCENE_STREAM = 0
"""The stream of scripts/simulate.py, so that equal seeds mean equal scenes."""
TOOL_DOWN = (math.pi, 0.0, 0.0)
"""Rotation vector of a tool that points down [rad]."""


@dataclass(frozen=True)
class EmulatorSettings:
    """An arm with an object in its hand over a floor and beside a wall; SI units."""

    address: str = "127.0.0.1"
    """Loopback address to listen on; another one for each emulator at a time."""
    outline: str = "mug"
    """Outline that plays the unknown object: a built-in or YCB name, or a file."""
    seed: int = 0
    """Seed of the scene and of the sensors' noise."""
    friction: tuple[float, float] = (0.1, 0.9)
    """Range from which friction is drawn."""
    wall: tuple[float, float] = (0.09, 0.18)
    """Range from which the wall's position is drawn, along x of the task [m]."""
    surface_mm_per_10n: float = 2.0
    """How far floor and wall yield under 10 N [mm]."""
    x_axis: str = "+x"
    """Axis of the base that is x of the task; z is up."""
    origin: tuple[float, float, float] = (0.4, 0.0, 0.1)
    """Origin of the task in the base frame [m]."""
    payload: float = 0.5
    """Mass that the controller was told it carries [kg]."""
    force_noise: float = 0.2
    """Standard deviation of one reading of a force [N]; of a torque a twentieth [N·m]. With 0 the
    arm has to be told that its sensor is noise_free."""
    pose_noise: float = 1e-5
    """Standard deviation of one reading of a position [m]; of an angle twice that [rad]."""
    servo_delay: float = 0.034
    """From a target to the arm being there [s]."""
    pace: Literal["real", "client"] = "real"
    """real: 500 Hz of real time; client: emulated time goes on with every servo target, so that a
    busy machine changes nothing and an idle one is faster than real time."""
    fault: Fault = "none"
    """What goes wrong."""
    fault_after: float = 3.0
    """Emulated time of servoing after which it does, where it is not there from the start [s]."""

    def __post_init__(self) -> None:
        """Refuse what no world can be."""
        for name in ("surface_mm_per_10n", "force_noise", "pose_noise", "servo_delay", "payload"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 or more")
        for name in ("friction", "wall"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"{name} is from {low} to {high}, expected low <= high")

    @property
    def compliance(self) -> float:
        """How far floor and wall yield [m/N]."""
        return 1e-4 * self.surface_mm_per_10n


def emulated_scene(settings: EmulatorSettings) -> Scene:
    """The object, floor, wall and start behind an emulator, in the world of the task."""
    from tpcd.random import stream
    from tpcd.shape.named import find_outline
    from tpcd.truth.scene import draw_scene

    outline = find_outline(settings.outline)
    bounds = {"friction": settings.friction, "wall_position": settings.wall}
    generator = stream(settings.seed, SCENE_STREAM)
    return draw_scene(outline.name, outline.vertices, generator, bounds=bounds)


def emulated_frame(settings: EmulatorSettings) -> TaskFrame:
    """The task's frame of an emulator, whose tool points down at phi = 0."""
    import numpy as np

    from tpcd.robot.frames import task_frame

    tcp = np.array([*settings.origin, *TOOL_DOWN])
    return task_frame(tcp, settings.x_axis, "+z", settings.origin)
