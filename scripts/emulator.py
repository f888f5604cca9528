"""Emulate a Universal Robots controller on loopback, with an object in its hand.

python scripts/emulator.py --address 127.0.0.2 --outline mug --surface_mm_per_10n 2
python scripts/robot.py --robot 127.0.0.2 --origin 0.4 0 0.1 --out runs/rehearsal  # elsewhere
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from tpcd.cli import check_numbers, run


@dataclass(frozen=True)
class Emulation:
    """Settings of the command; SI units."""

    address: str = "127.0.0.2"
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
    """Standard deviation of one reading of a force [N]; of a torque a twentieth [N·m]."""
    servo_delay: float = 0.034
    """From a target to the arm being there [s]."""
    pace: Literal["real", "client"] = "real"
    """real: 500 Hz of real time; client: time goes on with every servo target, which is faster."""
    fault: Literal[
        "none",
        "protective_stop",
        "frozen_link",
        "killed_controller",
        "register_in_use",
        "wrong_payload",
        "drifting_sensor",
        "local_control",
    ] = "none"
    """What goes wrong."""
    fault_after: float = 10.0
    """Emulated time of servoing after which it does, where it is not there from the start [s]."""
    truth: Path | None = None
    """YAML file in which to write what the arm does not know."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"fault_after": 0.0})
        if not self.address.startswith("127."):
            raise ValueError(f"address is {self.address}, expected a loopback address 127.x.y.z")


def emulate(config: Emulation) -> None:
    """Emulate a controller (dashboard, script upload, RTDE) and the world behind it, until
    Ctrl-C."""
    import sys

    import torch
    import yaml

    from tpcd.results import check_target, write_text
    from tpcd.robot.emulator import EmulatorSettings, emulated_scene
    from tpcd.robot.emulator.server import Server

    torch.set_num_threads(1)
    if config.truth is not None:
        check_target(config.truth)
    names = {field.name for field in fields(EmulatorSettings)} & set(vars(config))
    settings = EmulatorSettings(**{name: getattr(config, name) for name in names})
    server, scene = Server(settings), emulated_scene(settings)
    if config.truth is not None:
        content = {
            "theta": scene.theta,
            "outline": {"name": scene.outline_name, "vertices": scene.outline_vertices.tolist()},
            "start_pose": scene.start_pose.tolist(),
            "compliance": settings.compliance,
        }
        write_text(config.truth, yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    print(
        f"{scene.outline_name} over a floor that yields {settings.surface_mm_per_10n:g} mm at"
        f" 10 N, on {settings.address}, fault {settings.fault}; Ctrl-C ends it",
        file=sys.stderr,
        flush=True,
    )
    server.run()


if __name__ == "__main__":
    run(emulate, Emulation)
