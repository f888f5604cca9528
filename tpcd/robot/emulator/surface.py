"""A world that yields: an outline pushed by a position-controlled hand into floor and wall.

Floor and wall are rigid plates on springs, which give way across and along; the outline's hull
vertices press into them with a stiffness of their own, and hold by Coulomb friction through as
stiff springs which let go at friction times load. Quasi-static: forces follow from the pose and
from where each vertex stuck.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from tpcd.truth.hull import hull_vertices

VERTEX_STIFFNESS = 2e5
"""Of a single vertex against the plate [N/m]; part of the yield of the whole."""


class Plate:
    """One half-plane on a spring, met by points in its own coordinates: along it and above it."""

    def __init__(self, compliance: float, friction: float, count: int) -> None:
        """`compliance` [m/N] is the yield of plate and vertex together, along it and across."""
        total = max(compliance, 1.05 / VERTEX_STIFFNESS)
        self._compliance = total - 1.0 / VERTEX_STIFFNESS
        self._friction = friction
        self._moved = 0.0
        self._anchors = np.full(count, np.nan)  # on the plate

    def press(
        self, along: Float[np.ndarray, " p"], height: Float[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Forces on the points along and across [N], and keep where they stick."""
        tangential, normal = np.zeros_like(along), np.zeros_like(along)
        touching = np.flatnonzero(height < 0)
        if len(touching):
            depths = -height[touching]
            sunk = self._compliance * self._load(depths)
            normal[touching] = VERTEX_STIFFNESS * np.maximum(0.0, depths - sunk)
        held = normal > 0
        fresh = held & np.isnan(self._anchors)
        self._anchors[~held] = np.nan
        self._anchors[fresh] = along[fresh] - self._moved
        self._moved = 0.0
        if held.any():
            most = self._friction * normal[held] / VERTEX_STIFFNESS
            stretch = self._anchors[held] - along[held]
            self._moved = self._dragged(stretch, most)
            held_back = np.clip(stretch + self._moved, -most, most)
            self._anchors[held] = along[held] - self._moved + held_back
            tangential[held] = VERTEX_STIFFNESS * held_back
        return tangential, normal

    def _dragged(self, stretch: Float[np.ndarray, " c"], most: Float[np.ndarray, " c"]) -> float:
        """How far along itself the plate is dragged until its spring holds the vertices' [m]."""
        share = VERTEX_STIFFNESS * self._compliance
        # What is out of balance grows with the plate's way, in straight pieces from bend to bend.
        bends = np.sort(np.concatenate((-stretch - most, -stretch + most)))
        springs = np.clip(stretch + bends[:, None], -most, most)
        off = bends + share * springs.sum(axis=1)
        if off[0] > 0 or off[-1] < 0:  # all vertices slip
            return float(bends[0] - off[0] if off[0] > 0 else bends[-1] - off[-1])
        return float(np.interp(0.0, off, bends))

    def _load(self, depths: Float[np.ndarray, " c"]) -> float:
        """Total force at which plate and vertices are in equilibrium: piecewise linear."""
        total, force = 0.0, 0.0
        for count, depth in enumerate(sorted(depths.tolist(), reverse=True), start=1):
            if depth <= self._compliance * force:
                break
            total += depth
            share = VERTEX_STIFFNESS * self._compliance
            force = VERTEX_STIFFNESS * total / (1.0 + count * share)
        return force


class CompliantWorld:
    """An outline in the hand over a floor and beside a wall, both yielding."""

    def __init__(
        self,
        vertices_ee: Float[np.ndarray, "p 2"],
        friction: float,
        floor_height: float,
        wall_position: float,
        compliance: float,
    ) -> None:
        """Vertices in the end-effector frame [m], compliance [m/N]."""
        self._points = hull_vertices(vertices_ee)
        self._floor_height, self._wall_position = floor_height, wall_position
        count = len(self._points)
        self._floor = Plate(compliance, friction, count)
        self._wall = Plate(compliance, friction, count)

    def wrench(self, pose: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        """Of the world on the object about the end effector [N, N, N·m], at a pose in the world
        of the task; poses must follow each other closely."""
        cosine, sine = math.cos(float(pose[2])), math.sin(float(pose[2]))
        arm = self._points @ np.array([[cosine, sine], [-sine, cosine]])
        x, z = arm[:, 0] + pose[0], arm[:, 1] + pose[1]
        along_floor, off_floor = self._floor.press(x, z - self._floor_height)
        along_wall, off_wall = self._wall.press(z, self._wall_position - x)
        force_x, force_z = along_floor - off_wall, off_floor + along_wall
        torque = arm[:, 0] * force_z - arm[:, 1] * force_x
        return np.array([force_x.sum(), force_z.sum(), torque.sum()])
