"""Recordings as an arm would make them, from the rows of a planar episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tpcd.data.episode import Episode
from tpcd.logs.importing import Importing
from tpcd.logs.log import Log
from tpcd.logs.plane import Plane, WrenchReading

STIFFNESS = (100.0, 100.0, 50.0)
RATE, HOLD, RAMP = 100.0, 1.6, 0.3
SAMPLE_STD = (1e-4, 1e-4, 3e-4, 0.2, 0.2, 0.01)


@dataclass(frozen=True)
class Setting:
    """How an arm stands and how it records."""

    base: Rotation = Rotation.identity()
    """From the plane's x, z and angle axis, as (x, -angle axis, z), to the arm's world."""
    tool: Rotation = Rotation.identity()
    """From the end effector to the plane's axes, where the angle is 0."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the sensor in the frame of the end effector [m]."""
    in_tool: bool = False
    sign: float = 1.0
    zero: tuple[float, ...] = (0.0,) * 6
    """What the sensor reads where nothing acts."""

    @property
    def plane_x(self) -> np.ndarray:
        return self.base.apply([1.0, 0.0, 0.0])

    @property
    def plane_z(self) -> np.ndarray:
        return self.base.apply([0.0, 0.0, 1.0])

    @property
    def tool_x(self) -> np.ndarray:
        """The end effector's direction along x where the angle is 0."""
        return self.tool.inv().apply([1.0, 0.0, 0.0])


def an_episode(steps: int = 30, seed: int = 3) -> Episode:
    """What a diagnosis motion leaves, without noise and without pauses, which a recording does
    not show as steps."""
    from tpcd.shape.builtin import builtin_outlines
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import make_motion, record
    from tpcd.truth.scene import draw_scene

    generator = torch.Generator().manual_seed(seed)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    truth = make_truth(scene, "quasistatic")
    motion = make_motion("diagnosis", scene, steps, generator)
    made = record(truth, scene, motion, steps, generator).true
    new = torch.ones(len(made), dtype=torch.bool)
    new[1:] = (made.commands[1:] - made.commands[:-1]).abs().amax(-1) > 1e-9
    return replace(
        made, commands=made.commands[new], poses=made.poses[new], wrenches=made.wrenches[new]
    )


def sampled(episode: Episode, seed: int = 5, time_constant: float = 0.08) -> dict[str, np.ndarray]:
    """Times, commands, poses and wrenches in the plane, with noise on every sample.

    A command ramps to where it is held; the arm follows with a time constant [s].
    """
    random = np.random.default_rng(seed)
    ramp, hold = round(RAMP * RATE), round(HOLD * RATE)
    commands, poses, wrenches = (
        value.numpy() for value in (episode.commands, episode.poses, episode.wrenches)
    )
    share = np.concatenate((np.arange(1, ramp + 1) / ramp, np.ones(hold)))[:, None]
    seconds = np.arange(1, ramp + hold + 1)[:, None] / RATE
    come = 1 - np.exp(-seconds / time_constant)
    parts: dict[str, list[np.ndarray]] = {"u": [], "pose": [], "wrench": []}
    for k in range(len(commands)):
        j = max(k - 1, 0)
        parts["u"].append(commands[j] + share * (commands[k] - commands[j]))
        parts["pose"].append(poses[j] + come * (poses[k] - poses[j]))
        parts["wrench"].append(wrenches[j] + come * (wrenches[k] - wrenches[j]))
    joined = {name: np.concatenate(part) for name, part in parts.items()}
    noise = np.array(SAMPLE_STD) * random.standard_normal((len(joined["u"]), 6))
    return {
        "time": np.arange(len(noise)) / RATE,
        "u": joined["u"],
        "pose": joined["pose"] + noise[:, :3],
        "wrench": joined["wrench"] + noise[:, 3:],
    }


def in_space(samples: Mapping[str, np.ndarray], setting: Setting) -> dict[str, np.ndarray]:
    """Samples in three dimensions: time, position, rotation and set point (as quaternions), and
    force and torque as the sensor gives them."""

    def place(poses: np.ndarray) -> tuple[np.ndarray, Rotation]:
        position = np.stack((poses[:, 0], 0.0 * poses[:, 0], poses[:, 1]), axis=1)
        turn = Rotation.from_rotvec(poses[:, 2:] * np.array([0.0, -1.0, 0.0]))
        return setting.base.apply(position) + setting.origin, setting.base * turn * setting.tool

    position, rotation = place(samples["pose"])
    target, turned = place(samples["u"])
    wrench, zero = samples["wrench"], np.zeros(len(position))
    force = setting.base.apply(np.stack((wrench[:, 0], zero, wrench[:, 1]), axis=1))
    torque = setting.base.apply(np.stack((zero, -wrench[:, 2], zero), axis=1))
    torque = torque - np.cross(rotation.apply(np.array(setting.point)), force)
    if setting.in_tool:
        force, torque = rotation.inv().apply(force), rotation.inv().apply(torque)
    return {
        "time": samples["time"],
        "position": position,
        "rotation": rotation.as_quat(),
        "target": target,
        "turned": turned.as_quat(),
        "force": setting.sign * force + np.array(setting.zero[:3]),
        "torque": setting.sign * torque + np.array(setting.zero[3:]),
    }


def write_csv(path: Path, columns: Mapping[str, np.ndarray], separator: str = ",") -> Path:
    """A table of named columns."""
    table = np.column_stack(list(columns.values()))
    np.savetxt(
        path, table, delimiter=separator, header=separator.join(columns), comments="", fmt="%.9g"
    )
    return path


def log_of(setting: Setting, samples: Mapping[str, np.ndarray]) -> Log:
    """A recording of some samples."""
    parts = in_space(samples, setting)
    return Log(
        Path("made.csv"),
        parts["time"],
        parts["position"],
        Rotation.from_quat(parts["rotation"]),
        parts["force"],
        parts["torque"],
        parts["target"],
        Rotation.from_quat(parts["turned"]),
    )


def choices_of(setting: Setting, **more: Any) -> Importing:
    """The choices of an import that undo a setting."""
    x, z, tool_x = (tuple(v.tolist()) for v in (setting.plane_x, setting.plane_z, setting.tool_x))
    reading = WrenchReading("tool" if setting.in_tool else "world", setting.sign, setting.point)
    plane = Plane(x, z, setting.origin, tool_x)
    return Importing(STIFFNESS, **{"plane": plane, "wrench": reading, **more})
