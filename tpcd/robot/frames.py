"""The plane in which an arm works, and how its six numbers become three and come back.

The arm reports the pose of its tool centre point (TCP) as position [m] and rotation vector [rad]
in its base frame, and the wrench [N, N·m] at the TCP along the base's axes. The task's world has x
to the right and z up, phi counter-clockwise from x towards z. The user says which axes of base or
tool are x and z; phi turns about n = x × z and is zero at the tool's orientation at the start. The
position along n and the two other angles are held.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

LARGEST_LEAN = 0.03
"""Out of the plane, of a tool that starts [rad]."""
AXIS = re.compile(r"([+-]?)(?:(base|tool)_)?([xyz])")


@dataclass(frozen=True)
class TaskFrame:
    """World of the task in the base frame, and the tool's orientation where phi is zero."""

    x_axis: Float[np.ndarray, " 3"]
    """Unit vector of the world's x in the base frame."""
    z_axis: Float[np.ndarray, " 3"]
    """Unit vector of the world's z in the base frame."""
    origin: Float[np.ndarray, " 3"]
    """Origin of the world in the base frame [m]; its part along n is where the plane is held."""
    reference: Float[np.ndarray, " 3"]
    """Rotation vector of the tool at phi = 0 in the base frame [rad]."""

    @property
    def normal(self) -> Float[np.ndarray, " 3"]:
        """n = x × z, about which phi turns."""
        return np.cross(self.x_axis, self.z_axis)


def task_frame(
    tcp: Float[np.ndarray, " 6"],
    x_axis: str = "+x",
    z_axis: str = "+z",
    origin: tuple[float, float, float] | None = None,
    tool_zero: tuple[float, float, float] | None = None,
) -> TaskFrame:
    """The frame of an arm whose TCP stands in the plane.

    Axes are named `x`, `-y`, `base_z` for the base's, `tool_x`, `-tool_z` for the tool's. Without
    `origin` [m] in the base frame the world begins at the TCP; without `tool_zero`, a rotation
    vector [rad], phi is zero as the tool stands. Raises ValueError for other names, for axes that
    are not at right angles, and for a tool that leans out of the plane.
    """
    reference = tcp[3:].astype(float) if tool_zero is None else np.array(tool_zero, dtype=float)
    turn = Rotation.from_rotvec(reference)
    x, z = _axis("x_axis", x_axis, turn), _axis("z_axis", z_axis, turn)
    if abs(float(x @ z)) > 1e-3:
        angle = np.degrees(np.arccos(np.clip(x @ z, -1, 1)))
        raise ValueError(
            f"x_axis {x_axis} and z_axis {z_axis} are {angle:.1f} degrees apart, expected 90;"
            " name two axes of the plane in which the object moves"
        )
    z = z - (x @ z) * x
    z = z / np.linalg.norm(z)
    place = tcp[:3].astype(float) if origin is None else np.array(origin, dtype=float)
    normal = np.cross(x, z)
    # The plane goes through the TCP, wherever the origin was measured.
    place = place + (tcp[:3] - place) @ normal * normal
    frame = TaskFrame(x, z, place, reference)
    _, lean = out_of_plane(frame, tcp)
    if lean > LARGEST_LEAN:
        raise ValueError(
            f"the tool leans {lean:.3f} rad out of the plane of {x_axis} and {z_axis}, expected at"
            f" most {LARGEST_LEAN:g} rad; turn it upright, or give its present angle as zero"
        )
    return frame


def planar_pose(frame: TaskFrame, tcp: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " 3"]:
    """(x, z, phi) [m, m, rad] of a TCP pose in the base frame."""
    offset = tcp[:3] - frame.origin
    turned = _turned(frame, tcp)
    return np.array([offset @ frame.x_axis, offset @ frame.z_axis, turned @ frame.normal])


def out_of_plane(frame: TaskFrame, tcp: Float[np.ndarray, " 6"]) -> tuple[float, float]:
    """How far a TCP pose is off the plane [m], and how much it leans out of it [rad]."""
    turned, normal = _turned(frame, tcp), frame.normal
    lean = turned - (turned @ normal) * normal
    return float(abs((tcp[:3] - frame.origin) @ normal)), float(np.linalg.norm(lean))


def tcp_pose(frame: TaskFrame, pose: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 6"]:
    """The TCP pose in the base frame that is (x, z, phi) in the plane."""
    place = frame.origin + pose[0] * frame.x_axis + pose[1] * frame.z_axis
    turn = Rotation.from_rotvec(pose[2] * frame.normal) * Rotation.from_rotvec(frame.reference)
    return np.concatenate((place, turn.as_rotvec()))


def planar_wrench(frame: TaskFrame, wrench: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " 3"]:
    """(F_x, F_z, tau) [N, N, N·m] about the TCP, of a wrench at the TCP along base axes that the
    world exerts on what the arm holds."""
    force, torque = wrench[:3], wrench[3:]
    return np.array([force @ frame.x_axis, force @ frame.z_axis, torque @ frame.normal])


def tcp_wrench(frame: TaskFrame, wrench: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 6"]:
    """A planar wrench along base axes [N, N·m]; nothing acts out of the plane."""
    force = wrench[0] * frame.x_axis + wrench[1] * frame.z_axis
    return np.concatenate((force, wrench[2] * frame.normal))


def _turned(frame: TaskFrame, tcp: np.ndarray) -> np.ndarray:
    """Rotation vector from the reference to the tool, in base axes."""
    turn = Rotation.from_rotvec(tcp[3:]) * Rotation.from_rotvec(frame.reference).inv()
    return turn.as_rotvec()


def _axis(option: str, name: str, tool: Rotation) -> np.ndarray:
    found = AXIS.fullmatch(name.strip().lower())
    if found is None:
        raise ValueError(f"{option} is {name!r}, expected an axis such as x, -y, base_z or -tool_x")
    axis = np.zeros(3)
    axis["xyz".index(found[3])] = -1.0 if found[1] == "-" else 1.0
    return tool.apply(axis) if found[2] == "tool" else axis
