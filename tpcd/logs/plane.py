"""From three dimensions into the plane: which motion and force stay, and which are left out.

The plane is spanned by two directions of the recording's world; the planar angle turns from the
first (x) to the second (z), about x cross z, which in the usual axes is -y. A rotation is split
into the turn about that axis and the rest (swing and twist; Dobrowolski, "Swing-twist
decomposition in Clifford algebra", arXiv 1506.05481, 2015); the rest is left out.

The wrench of a sensor at p, moved to the end-effector origin o, is (F, T + (p - o) x F).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tpcd.logs.log import AXES, Log, LogError
from tpcd.quality.finding import Finding


@dataclass(frozen=True)
class Plane:
    """The plane of motion in the recording's world."""

    x: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction of the planar x axis."""
    z: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction of the planar z axis, up."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point of the world that is the origin of the plane [m]."""
    tool_x: tuple[float, ...] | None = None
    """Direction fixed to the end effector that lies along x where the angle is 0; without it the
    angle is 0 in the first sample."""

    def __post_init__(self) -> None:
        """Refuse directions that span no plane."""
        x, z = np.array(self.x), np.array(self.z)
        lengths = np.linalg.norm(x) * np.linalg.norm(z)
        if not lengths or abs(x @ z) > 1e-3 * lengths:
            raise ValueError(f"plane_x {self.x} and plane_z {self.z}, expected right angles")

    @cached_property
    def directions(self) -> Float[np.ndarray, "3 3"]:
        """Rows x, z, and the axis of the angle, as unit vectors of the world."""
        x, z = np.array(self.x, dtype=float), np.array(self.z, dtype=float)
        x = x / np.linalg.norm(x)
        z = z - (z @ x) * x
        z = z / np.linalg.norm(z)
        return np.stack((x, z, np.cross(x, z)))


@dataclass(frozen=True)
class WrenchReading:
    """How the numbers of the force sensor are meant."""

    frame: Literal["world", "tool"] = "world"
    """Axes in which they are given: the world's, or those of the end effector."""
    sign: float = 1.0
    """1 where they are what the world exerts on the object, -1 where they are the opposite."""
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the torque is taken about, in the frame of the end effector [m]."""
    offset: tuple[float, ...] = (0.0,) * 6
    """What the sensor reads in free air (F, T), to be subtracted [N, N·m]."""
    torque_sign: float = 1.0
    """-1 where torques alone turn the other way."""


@dataclass(frozen=True, eq=False)
class PlanarLog:
    """n samples in the plane."""

    times: Float[np.ndarray, " n"]
    poses: Float[np.ndarray, "n 3"]
    """(x, z, phi) [m, m, rad]; phi runs on beyond half a turn."""
    wrenches: Float[np.ndarray, "n 3"]
    """(F_x, F_z, tau) about the end-effector origin, in world axes [N, N, N·m]."""
    commands: Float[np.ndarray, "n 3"] | None
    motion_left_out: Float[np.ndarray, "n 2"]
    """Motion out of the plane since the start [m], and rotation not about its axis [rad]."""
    wrench_left_out: Float[np.ndarray, "n 3"]
    """Force out of the plane, and torque about x and z [N, N·m, N·m]."""
    findings: tuple[Finding, ...] = ()
    """What checks of the recording found, by `times`."""
    command_swing: Float[np.ndarray, " n"] | None = None
    """Rotation of the set points that is not about the plane's axis [rad]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """n poses and set points in the plane, as in `PlanarLog`."""

    poses: Float[np.ndarray, "n 3"]
    commands: Float[np.ndarray, "n 3"] | None
    left_out: Float[np.ndarray, "n 2"]
    command_swing: Float[np.ndarray, " n"] | None
    """Rotation of the set points that is not about the plane's axis [rad]."""


def project(
    log: Log, plane: Plane, wrench: WrenchReading, motion: Motion | None = None
) -> PlanarLog:
    """Bring a recording into the plane; raises `LogError` where a component is missing.

    `motion` is its `motion_in_plane` where that is known already.
    """
    _check_components(log, plane.directions, wrench)
    motion = motion_in_plane(log, plane) if motion is None else motion
    directions = plane.directions
    offset = np.array(wrench.offset)
    force, torque = log.forces - offset[:3], log.torques - offset[3:]
    if wrench.frame == "tool":
        force, torque = log.rotations.apply(force), log.rotations.apply(torque)
    force, torque = wrench.sign * force, wrench.sign * wrench.torque_sign * torque
    if any(wrench.point):
        torque = torque + np.cross(log.rotations.apply(np.array(wrench.point)), force)
    return PlanarLog(
        log.times,
        motion.poses,
        np.column_stack((force @ directions[:2].T, torque @ directions[2])),
        motion.commands,
        motion.left_out,
        np.column_stack((force @ directions[2], torque @ directions[:2].T)),
        log.findings,
        motion.command_swing,
    )


def motion_in_plane(log: Log, plane: Plane) -> Motion:
    """Poses and set points in the plane; raises `LogError` where `tool_x` is not in it."""
    directions = plane.directions
    axis = directions[2]
    place = (log.positions - np.array(plane.origin)) @ directions.T
    start = log.rotations[0]
    angle, swing = _turn(log.rotations, start, axis)
    zero = 0.0
    if plane.tool_x is not None:
        pointing = directions @ start.apply(np.array(plane.tool_x, dtype=float))
        if np.hypot(pointing[0], pointing[1]) < 0.5 * np.linalg.norm(plane.tool_x):
            raise LogError(
                log.path,
                f"tool_x {plane.tool_x} points out of the plane at the start",
                "name a direction of the end effector that lies in the plane",
            )
        zero = float(np.arctan2(pointing[1], pointing[0]))
    commands = command_swing = None
    if log.command_positions is not None and log.command_rotations is not None:
        target = (log.command_positions - np.array(plane.origin)) @ directions.T
        turned, command_swing = _turn(log.command_rotations, start, axis)
        commands = np.column_stack((target[:, :2], np.unwrap(turned) + zero))
    return Motion(
        np.column_stack((place[:, :2], np.unwrap(angle) + zero)),
        commands,
        np.column_stack((place[:, 2] - place[0, 2], swing)),
        command_swing,
    )


def _turn(
    rotations: Rotation, start: Rotation, axis: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Turn about an axis of the world since the start, and the angle of what is left [rad]."""
    quaternions = (rotations * start.inv()).as_quat()
    about = quaternions[:, :3] @ axis
    angle = 2.0 * np.arctan2(about, quaternions[:, 3])
    angle = np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
    # Of the rest, a turn about an axis at right angles, the scalar part is the length of these two.
    swing = 2.0 * np.arctan2(
        np.linalg.norm(quaternions[:, :3] - about[:, None] * axis, axis=1),
        np.hypot(about, quaternions[:, 3]),
    )
    return angle, swing


def _check_components(
    log: Log, directions: Float[np.ndarray, "3 3"], wrench: WrenchReading
) -> None:
    spans = np.abs(directions[:2]).max(0) > 1e-9
    turns = np.abs(directions[2]) > 1e-9
    needed = [(p + a, s) for p in ("", "u_", "F_") for a, s in zip(AXES, spans, strict=True)]
    needed += [("T_" + a, t) for a, t in zip(AXES, turns, strict=True)]
    planar = log.numbers is not None and log.numbers.kind == "planar angle"
    if wrench.frame == "tool" and not planar:
        needed += [(kind + a, True) for kind in ("F_", "T_") for a in AXES]
    lacking = [name for name, need in needed if need and name in log.missing]
    if lacking:
        raise LogError(
            log.path,
            f"{', '.join(dict.fromkeys(lacking))} not recorded, but needed for this plane",
            "map them, or choose --plane_x, --plane_z and --wrench_frame that do without",
        )
