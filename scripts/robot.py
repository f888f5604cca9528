"""Explore an unknown object with a Universal Robots arm; see tpcd/robot/README.md first.

python scripts/robot.py --robot 192.168.1.10 --x_axis -x --origin -0.7 0.1 0.05 --out runs/arm
python scripts/robot.py --robot 127.0.0.2 --origin 0.4 0 0.1 --out runs/rehearsal
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tpcd.cli import check_numbers, run
from tpcd.commands.exploring_options import ARM_HIGH, ARM_LOW, ExploringOptions

if TYPE_CHECKING:
    from torch import Tensor

    from tpcd.commands.exploring import Stage
    from tpcd.policies import Limits
    from tpcd.policies.active import Task
    from tpcd.policies.protocol import Policy
    from tpcd.robot.arm_settings import ArmSettings


@dataclass(frozen=True, kw_only=True)
class Experiment(ExploringOptions):
    """Settings of the command; SI units, poses and commands in the world of the task."""

    robot: str
    """Address of the controller."""
    policy: Literal["active", "lookahead", "grid", "random", "expert", "rich", "file"] = "active"
    """active: the most informative command within reach; lookahead: the same, two commands deep;
    grid: the best of the paper's 27; random: the paper's basic trajectory with noise; expert: one
    trajectory made with the wall in view; rich: a script that feels its way; file: --commands."""
    commands: Path | None = None
    """For policy file: CSV with u_x, u_z, u_phi, row 0 being the start; an episode is one."""
    expert_wall: float | None = None
    """For policy expert: where the wall is seen, along x [m]."""
    x_axis: str = "+x"
    """Axis of base or tool that is x, towards the wall: `x`, `-y`, `tool_z`, ..."""
    z_axis: str = "+z"
    """Axis of base or tool that is z, away from the floor."""
    origin: tuple[float, ...] = ()
    """Origin of the task in the base frame [m], on the floor below the start; without it the TCP
    at the start, and then --floor is needed."""
    tool_zero: tuple[float, ...] = ()
    """Rotation vector of the tool in the base frame at angle zero [rad]; else as at the start."""
    floor: tuple[float, ...] = ()
    """Range in which the floor's height is [m]; else ±0.02."""
    wall: tuple[float, ...] = ()
    """Range in which the wall's position is [m]; else 0.09 to 0.18."""
    friction: tuple[float, ...] = ()
    """Range in which friction is; else 0.1 to 0.9."""
    stiffness: tuple[float, float, float] = (100.0, 100.0, 50.0)
    """Of the spring that the arm imitates [N/m, N/m, N·m/rad]."""
    surface_mm_per_10n: float = 1.0
    """How far the stiffest surface yields under 10 N [mm]; stiffer than stated is unstable."""
    payload: float | None = None
    """Mass of gripper and object [kg], to compare with what the controller was told."""
    stop_force: float = 20.0
    """Force on an axis at which the arm stops [N]."""
    workspace_low: tuple[float, float, float] = ARM_LOW
    """Lower corner of where commands and poses may be [m, m, rad]."""
    workspace_high: tuple[float, float, float] = ARM_HIGH
    """Upper corner [m, m, rad]."""
    rate: float = 125.0
    """Readings and targets each second [Hz]: 125, 250 or 500."""
    stale_time: float = 0.04
    """Without a new reading for this long the link is lost [s]; more only for an emulator."""
    settle_time: float = 60.0
    """Longest time to wait for a steady pose and force once the command has arrived, or for it to
    get on, on top of the way at full speed [s]."""
    noise_free: bool = False
    """The force sensor has no noise, as an emulator's with --force_noise 0; of any other, readings
    that repeat exactly end the run."""
    yes: bool = False
    """Workspace and limits are confirmed beforehand; nobody is asked."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_policy(self.policy)
        check_numbers(self, above={"stiffness": 0.0, "stop_force": 0.0, "surface_mm_per_10n": 0.0})
        for name in ("floor", "wall", "friction"):
            value = getattr(self, name)
            if value and (len(value) != 2 or not value[0] < value[1]):
                raise ValueError(f"{name} is {value}, expected two numbers, low < high")
        if self.origin and len(self.origin) != 3:
            raise ValueError(f"origin is {self.origin}, expected x y z in the base frame [m]")
        if self.tool_zero and len(self.tool_zero) != 3:
            raise ValueError(f"tool_zero is {self.tool_zero}, expected rx ry rz [rad]")
        if not self.origin and not self.floor:
            raise ValueError("neither origin nor floor is given; one of them must say where it is")
        if (self.policy == "file") != (self.commands is not None):
            raise ValueError("policy file and --commands go together; give both or none")
        if (self.policy == "expert") != (self.expert_wall is not None):
            raise ValueError("policy expert and --expert_wall go together; give both or none")
        if self.stop_force <= self.force_limit:
            raise ValueError(
                f"stop_force is {self.stop_force:g} N, expected more than force_limit"
                f" {self.force_limit:g} N, or the arm stops where it may go"
            )


MAY_CHANGE = (
    "robot", "yes", "settle_time", "stale_time", "surface_mm_per_10n", "stop_force", "payload",
    "rate", "noise_free",
)  # fmt: skip
"""Options, beside those of every exploration, with which a stopped run may go on."""


def explore_with_robot(config: Experiment) -> None:
    """Explore an object with a UR arm and write belief, episode and raw readings to a folder."""
    import torch

    from tpcd.commands.exploring import EPISODE_NAME, Stage, explore_in_folder
    from tpcd.commands.exploring import MAY_CHANGE as ALWAYS
    from tpcd.data.files import episode_contents
    from tpcd.robot.held_signals import kill_as_ctrl_c
    from tpcd.robot.ur import FRAME_FILE, UniversalRobot

    torch.set_num_threads(1)
    settings = _settings(config)
    commands = None if config.commands is None else _commands(config.commands)
    if commands is not None:
        planned = len(commands) - 1
        if config.steps < planned:
            print(
                f"{config.steps} of the {planned} moves planned are made; --steps {planned} is all"
            )
        config = replace(config, steps=min(config.steps, planned))

    def stage(folder: Path, limits: Limits, task: Task | None) -> Stage:
        robot = UniversalRobot(settings, folder / "raw", lambda text: _confirmed(config, text))
        return Stage(
            robot,
            _policy(config, limits, task, commands),
            lambda rows: episode_contents(rows, folder / f"{EPISODE_NAME}.csv"),
        )

    resumable = f"raw/{FRAME_FILE}"
    with kill_as_ctrl_c():
        explore_in_folder(config, "scripts/robot.py", stage, resumable, (*ALWAYS, *MAY_CHANGE))


def _settings(config: Experiment) -> ArmSettings:
    from tpcd.robot.arm_settings import ArmSettings

    given = {
        "floor_height": config.floor,
        "wall_position": config.wall,
        "friction": config.friction,
    }
    return ArmSettings(
        config.robot,
        config.stiffness,
        config.surface_mm_per_10n,
        config.x_axis,
        config.z_axis,
        _three(config.origin),
        _three(config.tool_zero),
        config.payload,
        config.stop_force,
        config.workspace_low,
        config.workspace_high,
        config.rate,
        config.stale_time,
        config.settle_time,
        noise_free=config.noise_free,
        priors={name: (value[0], value[1]) for name, value in given.items() if value},
        notes=f"explored with the arm at {config.robot}, policy {config.policy}",
    )


def _three(values: tuple[float, ...]) -> tuple[float, float, float] | None:
    return (values[0], values[1], values[2]) if values else None


def _policy(
    config: Experiment, limits: Limits, task: Task | None, commands: Tensor | None
) -> Policy:
    from tpcd.policies import MotionPolicy, make_policy
    from tpcd.truth.motions import PlannedMotion, expert_motion

    wall = config.expert_wall
    if config.policy == "file":
        assert commands is not None
        return MotionPolicy(lambda: PlannedMotion(commands), limits)
    if config.policy == "expert":
        assert wall is not None
        return MotionPolicy(lambda: expert_motion(wall), limits)
    return make_policy(config.policy, limits, None, config.seed, task)


def _commands(path: Path) -> Tensor:
    """The commands of a file, as a tensor (n, 3); row 0 is the start."""
    import numpy as np
    import torch

    from tpcd.data.checks import COMMAND_COLUMNS
    from tpcd.data.table import read_table

    table = read_table(path, COMMAND_COLUMNS)
    return torch.from_numpy(np.stack([table[name] for name in COMMAND_COLUMNS], axis=1))


def _confirmed(config: Experiment, text: str) -> bool:
    import sys

    print(text, file=sys.stderr, flush=True)
    if config.yes:
        return True
    if not sys.stdin.isatty():
        return False
    try:
        return input("Type yes to let it move: ").strip().lower() == "yes"
    except EOFError:
        return False


if __name__ == "__main__":
    run(explore_with_robot, Experiment)
