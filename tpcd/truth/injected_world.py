"""The MuJoCo model of a scene with effects, and the surface of its floor.

The object hangs in three nested bodies: the arm with its joints x, z, phi, the grip (a
sprung hinge where the grasp is compliant) and the outline, which may be moved in the hand.
Each of floor and wall is a body, with sprung slides along normal and tangent where it is
compliant. MuJoCo has planes only on bodies that cannot move, so sprung ones carry boxes of
2 m whose face is the surface. Every point of the object meets each surface in a pair of its
own, so that friction can be set for each.

A curved floor is one plane per point of the object, laid tangent to the floor below that
point before every integration step. What touches a floor that bulges need not be on the
hull, so there points are taken along the outline itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tpcd.truth.injected_effects import ActiveEffects
from tpcd.truth.mujoco_scene import (
    INERTIAL_XML,
    POINT_RADIUS,
    MujocoSettings,
    contact_softness_xml,
    impedance_xml,
    options_xml,
)

SURFACES = ("floor", "wall")
"""In this order wherever an array has one entry for each."""
SPRING_TIME = 0.02
"""Square root of mass over stiffness of springs [s]: critically damped, they follow the ramp
within twice this time; much shorter ones would be unstable at time steps of 2 ms."""
STEP_LENGTH = 0.005
"""Length over which the step in the floor rises [m]."""
LARGEST_TURN = 0.35
"""Angle from upright up to which the object can meet a bulging floor [rad]."""
BUMP_WIDTH = 0.012
"""Standard deviation of the bump in the floor, which has the form of a normal density [m], wider by
its skew on the right and narrower on the left."""
BOX = 1.0
"""Half the side of the boxes [m]."""


@dataclass(frozen=True)
class FloorShape:
    """Height of the floor over its pivot at (0, floor height), along the body of the floor."""

    slope: float = 0.0
    curvature: float = 0.0
    """[1/m]"""
    step_height: float = 0.0
    step_x: float = 0.0
    """The step rises from here over `STEP_LENGTH` [m]."""
    ripple_height: float = 0.0
    """Amplitude of a wave along the floor [m]."""
    ripple_length: float = 1.0
    """Length of the wave [m]."""
    ripple_skew: float = 0.0
    """Share of a second wave, half as long."""
    bump_height: float = 0.0
    """Of a single bump, a dent where negative [m]."""
    bump_x: float = 0.0
    """Where it is highest [m]."""
    bump_skew: float = 0.0
    """Share by which it is wider to the right than in the mean, and narrower to the left."""

    @property
    def is_flat(self) -> bool:
        """Whether one plane will do."""
        return self.curvature == 0.0 and self.is_smooth

    @property
    def is_smooth(self) -> bool:
        """Whether it has nothing but a tilt and a curvature."""
        return self.step_height == self.ripple_height == self.bump_height == 0.0

    @property
    def ripple_number(self) -> float:
        """Radians of the wave for each metre."""
        return 2.0 * math.pi / self.ripple_length

    def height(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Height [m] at x [m]."""
        share = np.clip((x - self.step_x) / STEP_LENGTH, 0.0, 1.0)
        step = self.step_height * share**2 * (3.0 - 2.0 * share)
        wave = self.ripple_number * x
        ripple = self.ripple_height * (np.sin(wave) + self.ripple_skew * np.sin(2 * wave))
        return self.slope * x + self.curvature * x**2 / 2 + step + ripple + self._bump(x)

    def rise(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Angle of the floor from x towards z [rad] at x [m]."""
        share = np.clip((x - self.step_x) / STEP_LENGTH, 0.0, 1.0)
        step = self.step_height * 6.0 * share * (1.0 - share) / STEP_LENGTH
        number = self.ripple_number
        wave = np.cos(number * x) + 2 * self.ripple_skew * np.cos(2 * number * x)
        ripple = self.ripple_height * number * wave
        bump = -(x - self.bump_x) / self._bump_width(x) ** 2 * self._bump(x)
        return np.arctan(self.slope + self.curvature * x + step + ripple + bump)

    def _bump(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        return self.bump_height * np.exp(-0.5 * ((x - self.bump_x) / self._bump_width(x)) ** 2)

    def _bump_width(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        return BUMP_WIDTH * (1.0 + self.bump_skew * np.sign(x - self.bump_x))


def floor_shape(effects: ActiveEffects) -> FloorShape:
    """The floor's shape; a tilted floor is straight through its pivot."""
    return FloorShape(
        math.tan(effects.get("floor_tilt", "angle")),
        effects.get("floor_curvature", "curvature"),
        effects.get("floor_step", "height"),
        effects.get("floor_step", "x"),
        effects.get("floor_ripple", "height"),
        effects.get("floor_ripple", "length") or 1.0,
        effects.get("floor_ripple", "skew"),
        effects.get("floor_bump", "height"),
        effects.get("floor_bump", "x"),
        effects.get("floor_bump", "skew"),
    )


def floor_points(
    outline_ee: Float[np.ndarray, "p 2"],
    hull: Float[np.ndarray, "h 2"],
    shape: FloorShape,
    angle: float,
) -> Float[np.ndarray, "q 2"]:
    """Points of the object in the end-effector frame that may meet the floor [m].

    A flat floor or a hollow one meets the hull's vertices alone. Elsewhere points are set so
    close along the outline that the floor enters by 5 µm between them (or every 1 mm), and
    kept if they come near the lowest one at some turn within `LARGEST_TURN` of `angle`.
    """
    if shape.is_smooth and shape.curvature >= 0.0:
        return hull
    bend = abs(shape.curvature) + 6.0 * abs(shape.step_height) / STEP_LENGTH**2
    bend += abs(shape.ripple_height) * shape.ripple_number**2 * (1.0 + 4.0 * abs(shape.ripple_skew))
    bend += abs(shape.bump_height) / (BUMP_WIDTH * (1.0 - abs(shape.bump_skew))) ** 2
    spacing = min(max(math.sqrt(8.0 * 5e-6 / bend), 1e-3), 4e-3)
    points = []
    for first, second in zip(outline_ee, np.roll(outline_ee, -1, axis=0), strict=True):
        count = max(1, math.ceil(float(np.linalg.norm(second - first)) / spacing))
        points.append(first + np.arange(count)[:, None] / count * (second - first))
    candidates = np.concatenate((hull, *points))
    span = float(np.ptp(hull, axis=0).max())
    bulge = abs(shape.curvature) * span**2 / 2 + abs(shape.step_height) + 1e-4
    bulge += 2.0 * abs(shape.ripple_height) * (1.0 + abs(shape.ripple_skew))
    bulge += abs(shape.bump_height)
    turns = angle + np.linspace(-LARGEST_TURN, LARGEST_TURN, 41)
    heights = candidates @ np.array([np.sin(turns), np.cos(turns)])
    near = (heights - heights.min(axis=0) < bulge).any(axis=1)
    return candidates[near]


def world_xml(
    hull: Float[np.ndarray, "h 2"],
    touching_floor: Float[np.ndarray, "q 2"],
    friction: float,
    floor_height: float,
    wall_position: float,
    stiffness: Float[np.ndarray, " 3"],
    effects: ActiveEffects,
    settings: MujocoSettings,
) -> str:
    """The model as MuJoCo XML; the arm's joints come first among its coordinates.

    Geoms are named floor_point_i and wall_point_i on the object, floor_i and wall_0 around
    it; pairs follow in this order too, the floor's before the wall's.
    """
    loss = effects.get("arm_friction", "force")
    # As rigid as MuJoCo can be: while dry friction holds, the arm creeps by 1e-7 m/s.
    rigid = f'solreffriction="{2 * settings.time_step!r} 1" solimpfriction="0.9999 0.9999 1 0.5 2"'
    held = f'frictionloss="{loss!r}" {rigid}' if loss else ""
    joints, actuators = impedance_xml(stiffness, settings, (held, held, ""))
    grip = ""
    if compliance := effects.get("grasp_compliance", "compliance"):
        # As armature, this inertia does not make the arm itself heavier.
        armature = f'armature="{SPRING_TIME**2 / compliance!r}"'
        grip = f'<joint type="hinge" axis="0 -1 0" {armature} {_spring_xml(compliance)}/>'
    shape = floor_shape(effects)
    planes = 1 if shape.is_flat else len(touching_floor)
    pull = effects.get("adhesion", "force")
    lean = effects.get("wall_tilt", "angle")
    log_ratio = effects.get("wall_friction", "log_ratio")
    softness = contact_softness_xml(settings)
    return f"""
    <mujoco>
      {options_xml(settings)}
      <worldbody>
        <body name="arm">
          {INERTIAL_XML}
          {joints}
          <body name="grip">
            {INERTIAL_XML}
            {grip}
            <body name="object">
              {INERTIAL_XML}
              {_points_xml("floor", touching_floor)}
              {_points_xml("wall", hull)}
            </body>
          </body>
        </body>
        {_surface_xml("floor", (0.0, floor_height), math.atan(shape.slope), planes, effects)}
        {_surface_xml("wall", (wall_position, 0.0), math.pi / 2 + lean, 1, effects)}
      </worldbody>
      <contact>
        {_pairs_xml("floor", len(touching_floor), planes, friction, softness)}
        {_pairs_xml("wall", len(hull), 1, friction * math.exp(log_ratio), softness)}
      </contact>
      <actuator>
        {actuators}
        {"".join(_adhesion_xml(name, pull) for name in SURFACES) if pull else ""}
      </actuator>
    </mujoco>"""


def _points_xml(surface: str, points: np.ndarray) -> str:
    return "".join(
        f'<geom name="{surface}_point_{i}" type="sphere" size="{POINT_RADIUS!r}"'
        f' pos="{x!r} 0 {z!r}" contype="0" conaffinity="0"/>'
        for i, (x, z) in enumerate(points.tolist())
    )


def _surface_xml(
    name: str, pivot: tuple[float, float], rise: float, planes: int, effects: ActiveEffects
) -> str:
    """A body at the pivot with its surfaces; its tangent is turned by `rise` from x."""
    along = effects.get("tangential_compliance", "compliance")
    across = effects.get(f"{name}_compliance", "compliance")
    tangent = f"{math.cos(rise)!r} 0 {math.sin(rise)!r}"
    normal = f"{-math.sin(rise)!r} 0 {math.cos(rise)!r}"
    kind, size, depth = "plane", "1 1 1", POINT_RADIUS
    if along or across:
        kind, size, depth = "box", f"{BOX} {BOX} {BOX}", POINT_RADIUS + BOX
    x, z = depth * math.sin(rise), -depth * math.cos(rise)
    geoms = "".join(
        f'<geom name="{name}_{i}" type="{kind}" size="{size}" pos="{x!r} 0 {z!r}"'
        f' zaxis="{normal}" mass="0" contype="0" conaffinity="0"/>'
        for i in range(planes)
    )
    # Springs in bodies of their own: each has the mass that makes it fast enough.
    outer = _slide_xml(normal, across) if across else ""
    inner = _slide_xml(tangent, along) if along else ""
    place = f'pos="{pivot[0]!r} 0 {pivot[1]!r}"'
    return f'<body {place}>{outer}<body name="{name}">{inner}{geoms}</body></body>'


def _slide_xml(axis: str, compliance: float) -> str:
    mass = SPRING_TIME**2 / compliance
    return (
        f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="{mass!r} {mass!r} {mass!r}"/>'
        f'<joint type="slide" axis="{axis}" {_spring_xml(compliance)}/>'
    )


def _spring_xml(compliance: float) -> str:
    return f'stiffness="{1 / compliance!r}" damping="{2 * SPRING_TIME / compliance!r}"'


def _pairs_xml(surface: str, points: int, planes: int, friction: float, softness: str) -> str:
    return "".join(
        f'<pair geom1="{surface}_{i if planes > 1 else 0}" geom2="{surface}_point_{i}" condim="3"'
        f' friction="{friction!r} {friction!r} 0 0 0" {softness}/>'
        for i in range(points)
    )


def _adhesion_xml(surface: str, pull: float) -> str:
    return f'<adhesion body="{surface}" ctrlrange="0 {pull!r}" gain="1"/>'
