"""A Universal Robots controller on loopback, with an object in its hand over a yielding floor."""

from tpcd.robot.emulator.settings import (
    EmulatorSettings,
    Fault,
    emulated_frame,
    emulated_scene,
)

__all__ = ["EmulatorSettings", "Fault", "emulated_frame", "emulated_scene"]
