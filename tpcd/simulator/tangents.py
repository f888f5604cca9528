"""Derivatives of the quasi-static step: of first touch and settling, strung together.

Each part of a step is a flight to the first touch and a settling from there; the
derivatives of the whole step grow part by part, by start pose, gaps and levers and by what else is
asked. `settle` must have left its solution in the `Space`, and `linear_system` be filled there.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.geometry.candidates import frame
from tpcd.geometry.query import bent
from tpcd.loops import inner
from tpcd.simulator.events import touch_row
from tpcd.simulator.response import respond

GRAZING = 1e-9
"""Share of the way's motion towards a terrain below which a touch only grazes it."""


class Slopes(NamedTuple):
    """Derivatives of one element; matrices (3, 3) by pose or command, rows (3) by the rest, for
    k loaded rows at most.

    `whole` (3 + 2 t, 3) of the step so far by the start, then rows by gaps, then by levers;
    `kept` a copy of it; `land` (6, 3) of the first touch by start and command, `land_gap`
    (t, 3) by gaps; `response` (6, 3) of one settling by start and command, `by_terrain`
    (2 t, 3) rows by gaps and by levers, `follow` (3, k) and `yields` (3, 3) to get them with.
    `rate` (3) of the pose with the share of the path.

    What else is asked, in rows of `further`, `further_kept` a copy of it: nothing, or by friction
    (t), or by friction (t), compliance (t), angle of the normal (t), stiffness (3), command before
    (3) and command (3); and after these `inputs` rows by the coordinates x and z of each outline
    point that was touched. Those are `touched` (s, 2) point and terrain, `count` (1) of them.
    """

    whole: np.ndarray
    kept: np.ndarray
    land: np.ndarray
    land_gap: np.ndarray
    response: np.ndarray
    by_terrain: np.ndarray
    follow: np.ndarray
    yields: np.ndarray
    rate: np.ndarray
    further: np.ndarray
    further_kept: np.ndarray
    touched: np.ndarray
    count: np.ndarray
    inputs: int


NOTHING_MORE, BY_SCENE, BY_ALL = 0, 1, 2
"""What is asked besides `whole`: no more, derivatives by friction and outline, or by all inputs."""


@inner
@no_type_check
def further_inputs(asked, terrains):
    """Rows of `Slopes.further` before those of points."""
    if asked == BY_ALL:
        return 3 * terrains + 9
    return terrains if asked == BY_SCENE else 0


@inner(_nrt=True)
@no_type_check
def new_slopes(terrains, points, asked, room):
    """Room for the derivatives of one element with so many outline points."""
    inputs = further_inputs(asked, terrains)
    slots = points * terrains if inputs else 0
    return Slopes(
        np.zeros((3 + 2 * terrains, 3)),
        np.zeros((3 + 2 * terrains, 3)),
        np.zeros((6, 3)),
        np.zeros((terrains, 3)),
        np.zeros((6, 3)),
        np.zeros((2 * terrains, 3)),
        np.zeros((3, len(room))),
        np.zeros((3, 3)),
        np.zeros(3),
        np.zeros((inputs + 2 * slots, 3)),
        np.zeros((inputs + 2 * slots, 3)),
        np.zeros((slots, 2), np.int64),
        np.zeros(1, np.int64),
        inputs,
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
    here = (
        start[0] + fraction * (command[0] - start[0]), start[1] + fraction * (command[1] - start[1])
    )  # fmt: skip
    _, nx, nz, _, along, _ = frame(
        world, o, terrain, world.points[o, 0, point], world.points[o, 1, point], here,
        (math.cos(angle), math.sin(angle)),
    )  # fmt: skip
    row = (nx, nz, along)
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
                value += system.push[i, a] * system.inverse[i, j]
            follow[a, j] = value
    for a in range(3):
        for c in range(3):
            value = system.soft[a, c]
            by_start = 0.0
            for j in range(len(space.room)):
                value -= follow[a, j] * system.left[j, c]
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
def append_part(slopes, follows):
    """Append one settling to the derivatives of the whole step.

    `follows` is how much the command of this part moves with the start pose.
    """
    whole, by_terrain, nothing = slopes.whole, slopes.by_terrain, (0.0, 0.0, 0.0)
    terrains = slopes.land_gap.shape[0]
    for c in range(3):
        column = (whole[0, c], whole[1, c], whole[2, c])
        column = _string(slopes, column, nothing, 0.0, 0, follows, c)
        whole[0, c], whole[1, c], whole[2, c] = column
    for r in range(2 * terrains):
        direct = (by_terrain[r, 0], by_terrain[r, 1], by_terrain[r, 2])
        gap, t = (1.0, r) if r < terrains else (0.0, 0)
        _string_row(slopes, whole, 3 + r, direct, gap, t, 0.0, 0)


@inner(forceinline=True)
@no_type_check
def _string_row(slopes, rows, r, direct, gap, t, share, axis):
    """`_string` on a row in place."""
    row = _string(slopes, (rows[r, 0], rows[r, 1], rows[r, 2]), direct, gap, t, share, axis)
    rows[r, 0], rows[r, 1], rows[r, 2] = row


@inner(forceinline=True)
@no_type_check
def _string(slopes, before, direct, gap, t, share, axis):
    """The derivative (3) of the settled pose by an input, from that `before` this part.

    With landing l (start, command, gap) and rest pose r (l, command), by the chain rule

        dr = R_l (L_s before + L_g gap + L_c share) + R_c share + direct,

    where `gap` is how the first touch's gap to terrain t moves with the input, `share` how much of
    it is in the part's command along `axis`, and `direct` what it does to the rest itself.
    """
    land, land_gap, response = slopes.land, slopes.land_gap, slopes.response
    x, y, w = before
    p = share * land[3, axis] + gap * land_gap[t, 0]
    q = share * land[4, axis] + gap * land_gap[t, 1]
    s = share * land[5, axis] + gap * land_gap[t, 2]
    p = p + land[0, 0] * x + land[0, 1] * y + land[0, 2] * w
    q = q + land[1, 0] * x + land[1, 1] * y + land[1, 2] * w
    s = s + land[2, 0] * x + land[2, 1] * y + land[2, 2] * w
    i = direct[0] + share * response[3, axis]
    j = direct[1] + share * response[4, axis]
    k = direct[2] + share * response[5, axis]
    i = i + response[0, 0] * p + response[0, 1] * q + response[0, 2] * s
    j = j + response[1, 0] * p + response[1, 1] * q + response[1, 2] * s
    k = k + response[2, 0] * p + response[2, 1] * q + response[2, 2] * s
    return i, j, k


@inner
@no_type_check
def begin_further(slopes):
    """Nothing depends on further inputs yet, and no point was touched."""
    slopes.count[0] = 0
    clear_further(slopes)


@inner
@no_type_check
def clear_further(slopes):
    """Let the pose depend on no further input."""
    for r in range(further_rows(slopes)):
        for a in range(3):
            slopes.further[r, a] = 0.0


@inner
@no_type_check
def further_rows(slopes):
    """Rows of `further` in use."""
    return slopes.inputs + 2 * slopes.count[0]


@inner
@no_type_check
def follow_command(slopes, terrains, share, rested):
    """Further derivatives of an object that goes to the command freely, to a share of its path."""
    first = 3 * terrains + 3
    clear_further(slopes)
    if slopes.inputs > terrains:
        for a in range(3):
            slopes.further[first + a, a] = 0.0 if rested else 1.0 - share
            slopes.further[first + 3 + a, a] = share


@inner
@no_type_check
def append_further(
    world, o, law, relaxed, touch, event, landing, command, share, rested, pose, space, slopes
):  # fmt: skip
    """Append one settling to the derivatives of the whole step by further inputs.

    `relaxed` says that friction was left out, `touch` (point, terrain) of the first touch in the
    pose `landing`, `event` (see `events`) what the settled pose is passed on to, `share` how
    far on the path the part's `command` is, which is `rested` when the path begins at the start. At
    a given pose, an input leaves a force on the balance and right-hand sides of the rows.
    """
    point, terrain = touch
    which, passed, terrains = event[0], event[1], slopes.land_gap.shape[0]
    further, nothing = slopes.further, (0.0, 0.0, 0.0)
    coming = which - len(space.room)
    turn = (math.cos(pose[2]), math.sin(pose[2]))
    landed = (math.cos(landing[2]), math.sin(landing[2]))
    for t in range(terrains):
        direct = nothing
        if space.load[t] > 0.0 and not relaxed:
            _clear(space)
            _by_friction(law, t, turn, pose, space)
            direct = _direct(world, o, event, 0.0, pose, space, slopes.rate)
        _string_row(slopes, further, t, direct, 0.0, 0, 0.0, 0)
    if slopes.inputs > terrains:
        for t in range(terrains):
            _clear(space)
            for j in range(len(space.room)):
                if space.chosen[j, 0] >= 0 and space.chosen[j, 1] == t:
                    space.right[j] = -space.load[t]
            direct = _direct(world, o, event, 0.0, pose, space, slopes.rate)
            _string_row(slopes, further, terrains + t, direct, 0.0, 0, 0.0, 0)
            # Of what is curved this is not asked.
            _clear(space)
            _by_normal(world, o, law, t, turn, pose, space)
            later = _turned_gap(world, o, t, passed, turn, pose) if t == coming else 0.0
            direct = _direct(world, o, event, later, pose, space, slopes.rate)
            gap = _turned_gap(world, o, t, point, landed, landing) if t == terrain else 0.0
            _string_row(slopes, further, 2 * terrains + t, direct, gap, terrain, 0.0, 0)
        first = 3 * terrains
        for a in range(3):
            _clear(space)
            space.force[a] = command[a] - pose[a]
            direct = _direct(world, o, event, 0.0, pose, space, slopes.rate)
            _string_row(slopes, further, first + a, direct, 0.0, 0, 0.0, 0)
            before = 0.0 if rested else 1.0 - share
            _string_row(slopes, further, first + 3 + a, nothing, 0.0, 0, before, a)
            _string_row(slopes, further, first + 6 + a, nothing, 0.0, 0, share, a)
    _touch(slopes, point, terrain)
    if coming >= 0:
        _touch(slopes, passed, coming)
    for j in range(len(space.room)):
        if space.chosen[j, 0] >= 0:
            _touch(slopes, space.chosen[j, 0], space.chosen[j, 1])
    _, touch_x, touch_z, _, _, _ = frame(
        world, o, terrain, world.points[o, 0, point], world.points[o, 1, point],
        (landing[0], landing[1]), landed,
    )  # fmt: skip
    for i in range(slopes.count[0]):
        p, t = slopes.touched[i, 0], slopes.touched[i, 1]
        first_met, met = p == point and t == terrain, p == passed and t == coming
        held = False
        for j in range(len(space.room)):
            held = held or (space.chosen[j, 0] == p and space.chosen[j, 1] == t)
        for c in range(2):
            # In world axes the coordinate c moves the point by (x, z), and its start by the other.
            x, z = (turn[0], turn[1]) if c == 0 else (-turn[1], turn[0])
            from_x, from_z = (landed[0], landed[1]) if c == 0 else (-landed[1], landed[0])
            direct = nothing
            if held or met:
                _clear(space)
                _by_point(world, o, law, p, t, turn, pose, x, z, from_x, from_z, space)
                later = 0.0
                if met:
                    touch_row(world, o, t, p, pose, space.change)
                    later = space.change[0] * x + space.change[1] * z
                direct = _direct(world, o, event, later, pose, space, slopes.rate)
            gap = touch_x * from_x + touch_z * from_z if first_met else 0.0
            _string_row(slopes, further, slopes.inputs + 2 * i + c, direct, gap, terrain, 0.0, 0)


@inner
@no_type_check
def _touch(slopes, point, terrain):
    """Give rows of their own to the coordinates of a point that touches a terrain."""
    for i in range(slopes.count[0]):
        if slopes.touched[i, 0] == point and slopes.touched[i, 1] == terrain:
            return
    i = slopes.count[0]
    slopes.count[0] += 1
    slopes.touched[i, 0], slopes.touched[i, 1] = point, terrain
    for r in range(slopes.inputs + 2 * i, slopes.inputs + 2 * i + 2):
        for a in range(3):
            slopes.further[r, a] = 0.0
            slopes.further_kept[r, a] = 0.0


@inner
@no_type_check
def _clear(space):
    """No force on the balance, and no change of the rows."""
    for a in range(3):
        space.force[a] = 0.0
    for j in range(len(space.room)):
        space.right[j] = 0.0


@inner
@no_type_check
def _direct(world, o, event, gap, pose, space, rate):
    """What the forces and right-hand sides in `space` do to the settled pose, or to the pose at the
    event, which moves too: by the load that comes to zero there, or by the gap that does, which
    moves by `gap` besides."""
    which, point, inverse = event
    respond(space)
    x, y, w = space.change[0], space.change[1], space.change[2]
    if which >= 0:
        if which < len(space.room):
            later = space.gain[which]
        else:
            touch_row(world, o, which - len(space.room), point, pose, space.right)
            later = gap + space.right[0] * x + space.right[1] * y + space.right[2] * w
        x, y, w = (
            x + rate[0] * inverse * later, y + rate[1] * inverse * later,
            w + rate[2] * inverse * later,
        )  # fmt: skip
    return x, y, w


@inner
@no_type_check
def _come(space, t, k, turn, pose):
    """How far candidate k of terrain t has come since the part's start, in world axes."""
    x, z = space.place[t, k, 0], space.place[t, k, 1]
    dx = pose[0] + turn[0] * x - turn[1] * z - space.place[t, k, 4]
    return dx, pose[1] + turn[1] * x + turn[0] * z - space.place[t, k, 5]


@inner
@no_type_check
def _by_friction(law, t, turn, pose, space):
    """Forces and right-hand sides of more friction on terrain t."""
    for j in range(len(space.room)):
        if space.chosen[j, 0] < 0 or space.chosen[j, 1] != t:
            continue
        k, push = space.chosen[j, 2], space.multiplier[j] * space.side[j]
        nx, nz = space.record[t, k, 1], space.record[t, k, 2]
        if not (law.coulomb and space.slipping[j]):
            dx, dz = _come(space, t, k, turn, pose)
            space.right[j] = -space.side[j] * (nz * dx - nx * dz)
        space.force[0] += push * nz
        space.force[1] -= push * nx
        space.force[2] -= push * space.record[t, k, 3]


@inner
@no_type_check
def _by_point(world, o, law, p, t, turn, pose, x, z, from_x, from_z, space):
    """Forces and right-hand sides of an outline point that is moved by (x, z) where it touches
    terrain t, and by (`from_x`, `from_z`) where it was at the part's start."""
    for j in range(len(space.room)):
        if space.chosen[j, 0] != p or space.chosen[j, 1] != t:
            continue
        k, load = space.chosen[j, 2], space.multiplier[j]
        nx, nz = space.record[t, k, 1], space.record[t, k, 2]
        height, along = nx * x + nz * z, nz * x - nx * z
        slope = space.side[j] * world.friction[o, t]
        drag = 0.0 if law.coulomb and space.slipping[j] else slope
        shifted = along - (nz * from_x - nx * from_z)
        if bent(world.surfaces):
            # Along what is curved the normal turns, dn = k t ds, and the tangent, dt = -k n ds.
            dx, dz = _come(space, t, k, turn, pose)
            turned = space.record[t, k, 5] * along
            shifted -= turned * (nx * dx + nz * dz)
            space.force[0] += load * turned * (nz - slope * nx)
            space.force[1] -= load * turned * (nx + slope * nz)
            space.force[2] -= (
                load * turned * (space.record[t, k, 3] + slope * space.record[t, k, 4])
            )
        space.right[j] = -(height + drag * shifted)
        space.force[2] += load * (along - slope * height)


@inner
@no_type_check
def _by_normal(world, o, law, t, turn, pose, space):
    """Forces and right-hand sides of a plane t that is turned, its normal n to its tangent -t."""
    for j in range(len(space.room)):
        if space.chosen[j, 0] < 0 or space.chosen[j, 1] != t:
            continue
        k, load = space.chosen[j, 2], space.multiplier[j]
        nx, nz = space.record[t, k, 1], space.record[t, k, 2]
        height, along = space.record[t, k, 3], space.record[t, k, 4]
        slope = space.side[j] * world.friction[o, t]
        drag = 0.0 if law.coulomb and space.slipping[j] else slope
        dx, dz = _come(space, t, k, turn, pose)
        space.right[j] = along + nz * pose[0] - nx * pose[1] - drag * (nx * dx + nz * dz)
        space.force[0] += load * (slope * nx - nz)
        space.force[1] += load * (slope * nz + nx)
        space.force[2] += load * (height + slope * along)


@inner
@no_type_check
def _turned_gap(world, o, t, point, turn, pose):
    """How the gap of a point to a plane t moves as its normal turns."""
    _, nx, nz, _, along, _ = frame(
        world, o, t, world.points[o, 0, point], world.points[o, 1, point], (pose[0], pose[1]), turn
    )
    return -(along + nz * pose[0] - nx * pose[1])


@inner
@no_type_check
def copy_rows(source, first, target, count):
    """Copy rows of three from `first` on; numba's slices would allocate."""
    for r in range(count):
        for a in range(3):
            target[r, a] = source[first + r, a]
