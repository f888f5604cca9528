"""Contact forces that MuJoCo found on floor and wall, and friction that depends on them.

Arrays over the surfaces have the axes (floor, wall). Tangents are +x on the floor and +z on
the wall, turned with a tilted surface. Everything is per surface and not per point: points
of one flat face on one surface slide together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from tpcd.truth.injected_effects import ActiveEffects
from tpcd.truth.injected_world import SURFACES

FRICTION_EFFECTS = ("directional_friction", "static_kinetic", "load_friction", "friction_field")
"""Effects that change friction while MuJoCo integrates."""
REFERENCE_LOAD = 3.0
"""Load at which load-dependent friction has its nominal value [N]."""
LOAD_RANGE = (0.1, 30.0)
"""Loads beyond these count as these [N]."""
LOAD_TIME = 0.05
"""Time constant with which friction follows the load [s]: contacts chatter while they slide,
and the mean counts; a ramp takes forty times as long."""
SLIDING_SHARE = 0.999
"""Share of the largest friction force from which a surface counts as sliding."""
LIFT_TIME = 0.1
"""A surface not touched for longer has lost the object; shorter gaps are chatter [s]."""
SLIDING_LOAD = 0.02
"""Load under which static friction does not drop, since a light contact may chatter [N]."""


@dataclass(frozen=True)
class SurfaceLoads:
    """Forces on the object from each surface."""

    normal: Float[np.ndarray, " 2"]
    """Sum of compressions, without adhesion [N]."""
    tangential: Float[np.ndarray, " 2"]
    """Sum along the tangent [N]."""
    capacity: Float[np.ndarray, " 2"]
    """Largest sum of friction forces that these compressions allow [N]."""

    @property
    def is_sliding(self) -> np.ndarray:
        """Whether friction carries all that it can (2,)."""
        loaded = self.normal > SLIDING_LOAD
        return loaded & (np.abs(self.tangential) >= SLIDING_SHARE * self.capacity)


def surface_loads(data: Any, surface_of_geom: Int[np.ndarray, " g"]) -> SurfaceLoads:
    """Loads of the contacts in MuJoCo's data; `surface_of_geom` is -1 for the object."""
    sums = np.zeros((3, len(SURFACES)))
    if data.ncon:
        contacts = data.contact
        first, second = contacts.geom.T
        # MuJoCo's force acts on the second geom along a frame that starts with the normal.
        is_second = surface_of_geom[first] >= 0
        surface = np.where(is_second, surface_of_geom[first], surface_of_geom[second])
        in_force = contacts.efc_address >= 0
        rows = np.where(in_force, contacts.efc_address, 0)[:, None] + np.arange(3)
        local = data.efc_force[rows] * in_force[:, None]
        frames = contacts.frame.reshape(-1, 3, 3)
        force = np.einsum("cf,cfw->cw", local, frames) * np.where(is_second, 1, -1)[:, None]
        normal = frames[:, 0] * np.where(is_second, 1, -1)[:, None]
        along = force[:, 0] * normal[:, 2] - force[:, 2] * normal[:, 0]
        values = (local[:, 0], along, local[:, 0] * contacts.friction[:, 0])
        for total, value in zip(sums, values, strict=True):
            np.add.at(total, surface, value)
    return SurfaceLoads(*sums)


class FrictionLaw:
    """Friction of both surfaces from what happened so far.

    `nominal` is friction before anything depends on the motion, `time_step` the time from
    one call of `coefficients` to the next [s].
    """

    def __init__(
        self, effects: ActiveEffects, nominal: tuple[float, float], time_step: float
    ) -> None:
        self._effects = effects
        self._nominal = nominal
        self._time_step = time_step
        self.reset()

    def reset(self) -> None:
        """Forget all, as on a start without contact."""
        self._load = np.zeros(2)
        self._direction = np.zeros(2)
        self._apart = np.zeros(2)
        self.rest()

    def rest(self) -> None:
        """All contacts stand still: static friction counts again."""
        self._sliding = np.zeros(2, dtype=bool)
        # What is read next was still found under the friction of before.
        self._is_fresh = True

    def coefficients(self, loads: SurfaceLoads) -> Float[np.ndarray, " 2"]:
        """Friction of each surface after these loads, to hold until the next ones."""
        effects, touching = self._effects, loads.normal > 0
        factors = np.ones(2)
        if ratio := effects.get("directional_friction", "log_ratio"):
            # Friction on an object that goes along the tangent points against it.
            self._direction = np.where(touching, -np.sign(loads.tangential), self._direction)
            factors = factors * np.exp(ratio * self._direction)
        if "load_friction" in effects:
            follow = min(1.0, self._time_step / LOAD_TIME)
            self._load = self._load + follow * (loads.normal - self._load)
            relative = np.clip(self._load, *LOAD_RANGE) / REFERENCE_LOAD
            factors = factors * relative ** effects.get("load_friction", "exponent")
        if "static_kinetic" in effects:
            self._apart = np.where(touching, 0.0, self._apart + self._time_step)
            self._sliding = self._sliding | (loads.is_sliding & (not self._is_fresh))
            self._sliding &= self._apart < LIFT_TIME
            self._is_fresh = False
            factors = factors * np.where(
                self._sliding, 1.0, effects.get("static_kinetic", "ratio")
            )  # fmt: skip
        return np.array(self._nominal) * factors


def nominal_friction(friction: float, effects: ActiveEffects) -> tuple[float, float]:
    """Friction of floor and wall before anything depends on the motion."""
    return friction, friction * math.exp(effects.get("wall_friction", "log_ratio"))
