"""Scenes of the independent truth as MuJoCo's XML, and its numerical settings.

Settings were tuned on closed forms (tests/test_truth_mujoco.py). Inertia and damping are K
times one constant for every axis, since otherwise free motion bends and friction sees
another path. A contact time constant below about 5 time steps chatters; a low impratio lets
contact between floor and wall creep.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

POINT_RADIUS = 1e-6
"""Of the spheres that stand for points of the outline; planes are set back by it [m]."""
INERTIAL_XML = '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
"""Next to no mass: the arm's inertia sits in its joints."""


@dataclass(frozen=True)
class MujocoSettings:
    """Numerical settings of the truth; the defaults are the tuned ones."""

    time_step: float = 0.002
    """Integration step [s]."""
    damping_time: float = 0.3
    """Damping over stiffness of every axis [s]: the time constant of free motion."""
    inertia_time: float = 0.1
    """Square root of inertia over stiffness of every axis [s]."""
    ramp_time: float = 2.0
    """Least time in which the command moves from the last one to the next [s]."""
    longest_ramp: float = 100.0
    """Longest such time [s]: moves of more than 0.4 m or 1 rad are faster than `ramp_speed`."""
    ramp_speed: tuple[float, float] = (0.004, 0.01)
    """Speed of the command [m/s, rad/s]: the arm lags by `damping_time` times its speed,
    and friction sees another path. Large moves in 2 s end up to 3 mm elsewhere."""
    hold_time: float = 15.0
    """Longest time the command is held for the arm to settle [s]."""
    settled_force: float = 2e-4
    """The arm stands still when damping carries less than this on every axis [N, N, N·m]."""
    contact_steps: float = 7.0
    """Contact time constant in time steps."""
    impedance: tuple[float, float, float] = (0.9, 0.99, 2e-6)
    """MuJoCo's contact impedance d at first touch, d at depth, and that depth [m]. Soft at
    first touch keeps light contact (0.3 N) from chattering; stiff at depth keeps the
    penetration at 5 N near 3 µm, which matters for the torque between floor and wall."""
    impratio: float = 1e3
    """Stiffness of friction over that of normal contact. 1e2 lets jammed contact creep (5 % of
    steps do not settle); 1e3 and 1e4 agree to 0.1 mN, but at 1e4 MuJoCo 3 complains."""
    noslip_iterations: int = 10
    """Iterations of the solver that removes slip left by the soft friction; without effect
    at this impratio, needed at lower ones."""


def scene_xml(
    hull: np.ndarray,
    friction: float,
    floor_height: float,
    wall_position: float,
    stiffness: np.ndarray,
    settings: MujocoSettings,
) -> str:
    """The model as MuJoCo XML; MuJoCo's x and z are ours, and phi turns about -y."""
    contact = f'condim="3" friction="{friction!r} 0 0" {contact_softness_xml(settings)}'
    joints, actuators = impedance_xml(stiffness, settings)
    spheres = "".join(
        f'<geom type="sphere" size="{POINT_RADIUS!r}" pos="{x!r} 0 {z!r}" {contact}'
        ' contype="1" conaffinity="0"/>'
        for x, z in hull.tolist()
    )
    plane = f'type="plane" size="1 1 1" {contact} contype="0" conaffinity="1"'
    return f"""
    <mujoco>
      {options_xml(settings)}
      <worldbody>
        <geom {plane} pos="0 0 {floor_height - POINT_RADIUS!r}" zaxis="0 0 1"/>
        <geom {plane} pos="{wall_position + POINT_RADIUS!r} 0 0" zaxis="-1 0 0"/>
        <body>
          {INERTIAL_XML}
          {joints}
          {spheres}
        </body>
      </worldbody>
      <actuator>{actuators}</actuator>
    </mujoco>"""


def options_xml(settings: MujocoSettings) -> str:
    """Compiler and integrator of a scene."""
    return f"""<compiler angle="radian"/>
      <option timestep="{settings.time_step!r}" gravity="0 0 0" integrator="implicitfast"
              cone="elliptic" impratio="{settings.impratio!r}"
              solver="Newton" iterations="100" tolerance="1e-12"
              noslip_iterations="{settings.noslip_iterations}" noslip_tolerance="1e-12"/>"""


def contact_softness_xml(settings: MujocoSettings) -> str:
    """Attributes of a contact that say how soft it is."""
    light, deep, depth = settings.impedance
    return (
        f'solref="{settings.contact_steps * settings.time_step!r} 1" '
        f'solimp="{light!r} {deep!r} {depth!r} 0.5 2"'
    )


def impedance_xml(
    stiffness: np.ndarray, settings: MujocoSettings, attributes: tuple[str, str, str] = ("", "", "")
) -> tuple[str, str]:
    """Joints of the arm along x, z and about phi, and their position actuators.

    `attributes` are further ones for the three joints.
    """
    joints, actuators = [], []
    for name, kind, axis, value, further in zip(
        ("x", "z", "phi"), ("slide", "slide", "hinge"), ("1 0 0", "0 0 1", "0 -1 0"),
        stiffness.tolist(), attributes, strict=True,
    ):  # fmt: skip
        joints.append(
            f'<joint name="{name}" type="{kind}" axis="{axis}"'
            f' damping="{value * settings.damping_time!r}"'
            f' armature="{value * settings.inertia_time**2!r}" {further}/>'
        )
        actuators.append(f'<position joint="{name}" kp="{value!r}"/>')
    return "".join(joints), "".join(actuators)
