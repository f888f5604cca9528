"""Compiled derivatives of the quasi-static step: of first touch and settling, strung together.

Each part of a step is a flight to the first touch and a settling from there; the
derivatives of the whole step by start pose, gaps and levers grow part by part. `settle`
must have left its solution in the `Space`, and `linear_system` must be filled there.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from tpcd.simulator.kernel_geometry import object_normal

GRAZING = 1e-9
"""Share of the way's motion towards a terrain below which a touch only grazes it."""


class Slopes(NamedTuple):
    """Derivatives of one element; matrices (3, 3) by pose or command, rows (3) by the rest.

    `whole` (3 + 2 t, 3) of the step so far by the start, then rows by gaps, then by levers;
    `kept` a copy of it; `land` (6, 3) of the first touch by start and command, `land_gap`
    (t, 3) by gaps; `response` (6, 3) of one settling by start and command, `by_terrain`
    (2 t, 3) rows by gaps and by levers, `follow` and `yields` (3, 3) to get them with.
    """

    whole: np.ndarray
    kept: np.ndarray
    land: np.ndarray
    land_gap: np.ndarray
    response: np.ndarray
    by_terrain: np.ndarray
    follow: np.ndarray
    yields: np.ndarray


@njit
@no_type_check
def new_slopes(terrains):
    """Room for the derivatives of one element."""
    return Slopes(
        np.zeros((3 + 2 * terrains, 3)),
        np.zeros((3 + 2 * terrains, 3)),
        np.zeros((6, 3)),
        np.zeros((terrains, 3)),
        np.zeros((6, 3)),
        np.zeros((2 * terrains, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
    )


@njit(error_model="numpy", _nrt=False)
@no_type_check
def landing_response(world, o, start, command, fraction, point, terrain, slopes):
    """Derivatives of the first-touch pose by start (rows 0-2), command (3-5) and gaps."""
    land, land_gap = slopes.land, slopes.land_gap
    land[:], land_gap[:] = 0.0, 0.0
    for a in range(3):
        land[a, a] = 1.0
    if fraction == 0.0:
        return
    angle = start[2] + fraction * (command[2] - start[2])
    u, v = object_normal(world, o, terrain, math.cos(angle), math.sin(angle))
    row = (
        world.normals[o, terrain, 0],
        world.normals[o, terrain, 1],
        v * world.points[o, 0, point] - u * world.points[o, 1, point],
    )
    approach, way = 0.0, 0.0
    for a in range(3):
        approach -= row[a] * (command[a] - start[a])
        way += abs(row[a] * (command[a] - start[a]))
    # A touch that grazes has no derivative; leave out how its time changes.
    inverse = 1.0 / approach if approach > GRAZING * way else 0.0
    for a in range(3):
        share = (command[a] - start[a]) * inverse
        land_gap[terrain, a] = share
        for c in range(3):
            turn = (1.0 if a == c else 0.0) + share * row[c]
            land[a, c] = (1.0 - fraction) * turn
            land[3 + a, c] = fraction * turn


@njit(_nrt=False)
@no_type_check
def settling_response(law, terrains, space, slopes):
    """Derivatives of the settled pose by start, command, and gap and lever of each terrain.

    A force on the balance and right-hand sides of the rows change the pose by
    `yields` force + `follow` right, as `respond` does for one of each.
    """
    system, chosen, follow, yields = space.system, space.chosen, slopes.follow, slopes.yields
    for a in range(3):
        for j in range(3):
            value = 0.0
            for i in range(3):
                value += system[3 + i, a] * system[9 + i, j]
            follow[a, j] = system[6, a] * value
    for a in range(3):
        for c in range(3):
            value = system[6, a] if a == c else 0.0
            by_start = 0.0
            for j in range(3):
                value -= follow[a, j] * system[j, c] * system[6, c]
                by_start -= follow[a, j] * system[12 + j, c]
            yields[a, c] = value
            slopes.response[a, c] = by_start
            slopes.response[3 + a, c] = value * law.stiffness[c]
        for t in range(terrains):
            value = 0.0
            for j in range(3):
                if chosen[j, 0] >= 0 and chosen[j, 1] == t:
                    value -= follow[a, j]
            slopes.by_terrain[t, a] = value
            slopes.by_terrain[terrains + t, a] = yields[a, 2] * space.load[t]


@njit(_nrt=False)
@no_type_check
def append_part(slopes, follows, column, middle):
    """Append one settling to the derivatives of the whole step.

    `follows` is how much the command of this part moves with the start pose.
    """
    whole, response, by_terrain = slopes.whole, slopes.response, slopes.by_terrain
    land, land_gap = slopes.land, slopes.land_gap
    terrains = land_gap.shape[0]
    for c in range(3):
        for a in range(3):
            column[a] = whole[a, c]
        for a in range(3):
            middle[a] = follows * land[3 + a, c]
            for k in range(3):
                middle[a] += land[a, k] * column[k]
        for a in range(3):
            value = follows * response[3 + a, c]
            for k in range(3):
                value += response[a, k] * middle[k]
            whole[a, c] = value
    for r in range(2 * terrains):
        for a in range(3):
            column[a] = whole[3 + r, a]
        for a in range(3):
            middle[a] = land_gap[r, a] if r < terrains else 0.0
            for k in range(3):
                middle[a] += land[a, k] * column[k]
        for a in range(3):
            value = by_terrain[r, a]
            for k in range(3):
                value += response[a, k] * middle[k]
            whole[3 + r, a] = value


@njit(_nrt=False)
@no_type_check
def copy_rows(source, first, target, count):
    """Copy rows of three from `first` on; numba's slices would allocate."""
    for r in range(count):
        for a in range(3):
            target[r, a] = source[first + r, a]
