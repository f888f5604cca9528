"""Emulate a Universal Robots controller on loopback, with an object in its hand.

python scripts/emulator.py --address 127.0.0.2 --outline mug --surface_mm_per_10n 2
python scripts/robot.py --robot 127.0.0.2 --origin 0.4 0 0.1 --out runs/rehearsal  # elsewhere
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tpcd.cli import check_numbers, run
from tpcd.robot.emulator.settings import EmulatorSettings


@dataclass(frozen=True)
class Emulation(EmulatorSettings):
    """Settings of the command; SI units."""

    address: str = "127.0.0.2"
    """Loopback address to listen on; another one for each emulator at a time."""
    fault_after: float = 10.0
    """Emulated time of servoing after which it does, where it is not there from the start [s]."""
    truth: Path | None = None
    """YAML file in which to write what the arm does not know."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, least={"fault_after": 0.0})
        if not self.address.startswith("127."):
            raise ValueError(f"address is {self.address}, expected a loopback address 127.x.y.z")


def emulate(config: Emulation) -> None:
    """Emulate a controller (dashboard, script upload, RTDE) and the world behind it, until
    Ctrl-C."""
    import sys

    import torch

    from tpcd.files import write_text
    from tpcd.plain_yaml import to_yaml
    from tpcd.robot.emulator import emulated_scene
    from tpcd.robot.emulator.server import Server
    from tpcd.targets import check_target

    torch.set_num_threads(1)
    if config.truth is not None:
        check_target(config.truth)
    server, scene = Server(config), emulated_scene(config)
    if config.truth is not None:
        content = {
            "theta": scene.theta,
            "outline": {"name": scene.outline_name, "vertices": scene.outline_vertices.tolist()},
            "start_pose": scene.start_pose.tolist(),
            "compliance": config.compliance,
        }
        write_text(config.truth, to_yaml(content, flow=True))
    print(
        f"{scene.outline_name} over a floor that yields {config.surface_mm_per_10n:g} mm at"
        f" 10 N, on {config.address}, fault {config.fault}; Ctrl-C ends it"
        + ("" if config.force_noise else "; without noise it is for robot.py --noise_free"),
        file=sys.stderr,
        flush=True,
    )
    server.run()


if __name__ == "__main__":
    run(emulate, Emulation)
