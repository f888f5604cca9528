"""Compiled derivatives of the quasi-static step: of first touch and settling, strung together.

Each part of a step is a flight to the first touch and a settling from there; the
derivatives of the whole step by start pose, gaps and levers grow part by part. `settle`
must have left its solution in the `Space`, and `linear_system` must be filled there.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.simulator.kernel_events import touch_row
from tpcd.simulator.kernel_geometry import object_normal
from tpcd.simulator.kernel_inner import inner
from tpcd.simulator.kernel_linear import respond

GRAZING = 1e-9
"""Share of the way's motion towards a terrain below which a touch only grazes it."""


class Slopes(NamedTuple):
    """Derivatives of one element; matrices (3, 3) by pose or command, rows (3) by the rest, for
    k loaded rows at most.

    `whole` (3 + 2 t, 3) of the step so far by the start, then rows by gaps, then by levers;
    `kept` a copy of it; `land` (6, 3) of the first touch by start and command, `land_gap`
    (t, 3) by gaps; `response` (6, 3) of one settling by start and command, `by_terrain`
    (2 t, 3) rows by gaps and by levers, `follow` (3, k) and `yields` (3, 3) to get them with.
    `theta` (d, 3) of the step so far by each entry of theta, `theta_kept` a copy of it. `rate` (3)
    of the pose with the share of the path.
    """

    whole: np.ndarray
    kept: np.ndarray
    land: np.ndarray
    land_gap: np.ndarray
    response: np.ndarray
    by_terrain: np.ndarray
    follow: np.ndarray
    yields: np.ndarray
    theta: np.ndarray
    theta_kept: np.ndarray
    rate: np.ndarray


class SceneSlopes(NamedTuple):
    """How the scenes of the batch move with d entries of theta: points (.., d, 2, p) in the
    end-effector frame, offsets and friction (.., d, t) of the terrains. d = 0 asks nothing.
    """

    points: np.ndarray
    offsets: np.ndarray
    friction: np.ndarray


@inner(_nrt=True)
@no_type_check
def new_slopes(terrains, entries, room):
    """Room for the derivatives of one element."""
    return Slopes(
        np.zeros((3 + 2 * terrains, 3)),
        np.zeros((3 + 2 * terrains, 3)),
        np.zeros((6, 3)),
        np.zeros((terrains, 3)),
        np.zeros((6, 3)),
        np.zeros((2 * terrains, 3)),
        np.zeros((3, len(room))),
        np.zeros((3, 3)),
        np.zeros((entries, 3)),
        np.zeros((entries, 3)),
        np.zeros(3),
    )


@inner(error_model="numpy", forceinline=True)
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


@inner(forceinline=True)
@no_type_check
def settling_response(law, terrains, space, slopes):
    """Derivatives of the settled pose by start, command, and gap and lever of each terrain.

    A force on the balance and right-hand sides of the rows change the pose by
    `yields` force + `follow` right, as `respond` does for one of each.
    """
    system, chosen, follow, yields = space.system, space.chosen, slopes.follow, slopes.yields
    for a in range(3):
        for j in range(len(space.room)):
            value = 0.0
            for i in range(len(space.room)):
                value += system.pushes[i, a] * system.inverse[i, j]
            follow[a, j] = system.soft[a] * value
    for a in range(3):
        for c in range(3):
            value = system.soft[a] if a == c else 0.0
            by_start = 0.0
            for j in range(len(space.room)):
                value -= follow[a, j] * system.rows[j, c] * system.soft[c]
                by_start -= follow[a, j] * system.starts[j, c]
            yields[a, c] = value
            slopes.response[a, c] = by_start
            slopes.response[3 + a, c] = value * law.stiffness[c]
        for t in range(terrains):
            value = 0.0
            for j in range(len(space.room)):
                if chosen[j, 0] >= 0 and chosen[j, 1] == t:
                    value -= follow[a, j]
            slopes.by_terrain[t, a] = value
            slopes.by_terrain[terrains + t, a] = yields[a, 2] * space.load[t]


@inner(forceinline=True)
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


@inner
@no_type_check
def append_theta(
    world, o, law, by_theta, moved, relaxed, touch, event, landing, pose, space, slopes
):  # fmt: skip
    """Append one settling to the derivatives of the whole step by theta.

    `moved` is the element of `by_theta`, `relaxed` says that friction was left out, `touch` (point,
    terrain) of the first touch in the pose `landing`, `event` (see `kernel_events`) what the
    settled pose is passed on to. At a given pose, an entry of theta leaves a force on the balance
    and right-hand sides of the rows.
    """
    point, terrain = touch
    land, response, theta = slopes.land, slopes.response, slopes.theta
    start_turn = (math.cos(landing[2]), math.sin(landing[2]))
    turn = (math.cos(pose[2]), math.sin(pose[2]))
    for e in range(theta.shape[0]):
        for a in range(3):
            space.force[a] = 0.0
        for j in range(len(space.room)):
            space.right[j] = 0.0
            if space.chosen[j, 0] < 0:
                continue
            p, t, k = space.chosen[j, 0], space.chosen[j, 1], space.chosen[j, 2]
            nx, nz = world.normals[o, t, 0], world.normals[o, t, 1]
            u, v = object_normal(world, o, t, turn[0], turn[1])
            u_start, v_start = object_normal(world, o, t, start_turn[0], start_turn[1])
            x, z = by_theta.points[moved, e, 0, p], by_theta.points[moved, e, 1, p]
            height, along = u * x + v * z, v * x - u * z
            slope = space.side[j] * world.friction[o, t]
            more = 0.0 if relaxed else space.side[j] * by_theta.friction[moved, e, t]
            drag, more_drag = (0.0, 0.0) if law.coulomb and space.slipping[j] else (slope, more)
            at_x, at_z = space.place[t, k, 0], space.place[t, k, 1]
            slip = v * at_x - u * at_z + nz * pose[0] - nx * pose[1] - space.place[t, k, 2]
            gap = height - by_theta.offsets[moved, e, t]
            space.right[j] = -(gap + drag * (along - (v_start * x - u_start * z)))
            space.right[j] -= more_drag * slip
            load = space.multiplier[j]
            space.force[0] += load * more * nz
            space.force[1] -= load * more * nx
            space.force[2] += load * (along - slope * height - more * (u * at_x + v * at_z))
        respond(space)
        _pass_theta(world, o, by_theta, moved, e, event, pose, space, slopes.rate)
        u, v = object_normal(world, o, terrain, start_turn[0], start_turn[1])
        gap = u * by_theta.points[moved, e, 0, point] + v * by_theta.points[moved, e, 1, point]
        gap -= by_theta.offsets[moved, e, terrain]
        for a in range(3):
            space.force[a] = theta[e, a]
        for a in range(3):
            space.right[a] = gap * slopes.land_gap[terrain, a]
            for k in range(3):
                space.right[a] += land[a, k] * space.force[k]
        for a in range(3):
            value = space.change[a]
            for k in range(3):
                value += response[a, k] * space.right[k]
            theta[e, a] = value


@inner
@no_type_check
def _pass_theta(world, o, by_theta, moved, e, event, pose, space, rate):
    """Let the change of the pose with an entry of theta be that at an event, which moves too."""
    which, point, inverse = event
    if which < 0:
        return
    if which < len(space.room):
        later = space.gain[which]
    else:
        row, t = space.right, which - len(space.room)
        touch_row(world, o, t, point, pose, row)
        u, v = object_normal(world, o, t, math.cos(pose[2]), math.sin(pose[2]))
        later = u * by_theta.points[moved, e, 0, point] + v * by_theta.points[moved, e, 1, point]
        later -= by_theta.offsets[moved, e, t]
        for a in range(3):
            later += row[a] * space.change[a]
    for a in range(3):
        space.change[a] += rate[a] * inverse * later


@inner
@no_type_check
def copy_rows(source, first, target, count):
    """Copy rows of three from `first` on; numba's slices would allocate."""
    for r in range(count):
        for a in range(3):
            target[r, a] = source[first + r, a]
