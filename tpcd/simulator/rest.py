"""The rest pose of one substep: where the arm's spring, contact and friction balance.

The pose x' minimises 1/2 (x' - u)^T K (x' - u) subject to, for every outline point i, every terrain
and both sides s = +1, -1,

    gap_i(x') + s mu slip_i(x') + mu sigma_i + y >= 0,                                          (1)

slip being the tangential motion of the point since the start of the substep. With sigma = 0 this is
the convex friction of Anitescu ("Optimization-based simulation of nonsmooth rigid multibody
dynamics", 2006); sigma = |slip|, found as a fixed point, is Coulomb friction (De Saxce and Feng,
"The bipotential method", 1998). y is how far that terrain yields, c times the load on it: with a
compliance c it is one more variable, which costs y^2 / 2c, in units in which its spring costs as
much as that of the arm. Then floor and wall share the load of what both hold, which friction alone
leaves open.

In every round the lowest points of each terrain join a short list of candidates, (1) is linearised
for them at the last pose and solved, and its active rows give a Newton step on Coulomb's law that
spares most rounds of the fixed point. So the answer holds for the turned outline and not only for
its first linearisation. Nothing is allocated inside.

With mu >= 1 an object that starts in penetration between two terrains can be jammed: no motion
satisfies its rows. It is answered without friction, which is mostly possible and pushes it out the
shortest way; terrains that face each other jam without friction too, and then give way a little.
`wedging` says where better answers are looked for.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from tpcd.geometry.candidates import lowest_point, nearest, object_normal
from tpcd.geometry.query import query, spread
from tpcd.loops import inner
from tpcd.qp.active_set import solve_whitened, solve_whitened_3
from tpcd.qp.elastic import RELAXATION
from tpcd.qp.problem import Status
from tpcd.simulator.record import StepStatus
from tpcd.simulator.response import linear_system, respond
from tpcd.simulator.workspace import LIST

PROBE_ANGLE = 0.02
"""Rotation [rad] whose lowest points are candidates too, so that a flat face shows both ends."""
NEWTON_ROUNDS = 6
"""Rounds in which a Newton step on Coulomb's law is tried; later ones are plain fixed point."""
PATIENCE = 3
"""Times as many rounds from the pose without friction."""
SLIGHT = 10.0
"""Times the tolerance, up to which a point has not moved along a terrain."""
NEAR = 1e-4
"""A terrain further away than this is no candidate under Coulomb friction [m]."""
CONVERGED, START_INSIDE = int(StepStatus.CONVERGED), int(StepStatus.START_INSIDE)
NOT_CONVERGED, RELAXED = int(StepStatus.NOT_CONVERGED), int(StepStatus.RELAXED)
INVALID = int(StepStatus.INVALID_INPUT)
WANTED = INVALID + 1
"""Status of an element that waits for the solution of a contact problem by another backend."""
_SOFT = math.sqrt(RELAXATION)
"""What a row that gives way has on its own variable, in whitened units."""
_SOLVED, _SHORT = int(Status.SOLVED), int(Status.ITERATION_LIMIT)


@inner(error_model="numpy", forceinline=True)
@no_type_check
def settle(world, o, chains, law, extent, start, command, space, pose, afresh, give_way):
    """Settle one element, `afresh` from the start or from `pose`; leaves pose and loaded contacts,
    returns status and residual. Where no motion satisfies all rows, it is RELAXED, and they
    `give_way` if they may."""
    terrains, system = world.friction.shape[1], space.system
    for t in range(terrains):
        if afresh:
            space.counts[t] = 0
        space.load[t] = 0.0
    for a in range(3):
        if afresh:
            pose[a] = start[a]
    for j in range(len(space.room)):
        space.chosen[j, 0] = -1
        space.multiplier[j] = 0.0
    status, residual = NOT_CONVERGED, np.inf
    rounds = law.rounds if afresh else PATIENCE * law.rounds
    start_turn = (math.cos(start[2]), math.sin(start[2]))
    still = law.tolerance / _roughest(world, o, law)
    for k in range(rounds):
        turn = (math.cos(pose[2]), math.sin(pose[2]))
        _list_candidates(world, o, chains, law, start, start_turn, pose, turn, k, give_way, space)
        m = _build_rows(world, o, law, command, pose, turn, space)
        found = _solve(m, space)
        if found == WANTED:
            return WANTED, np.inf
        if found != _SOLVED and found != _SHORT:
            status = RELAXED
            if not give_way:
                return status, np.inf
            _give_way(m, space)
        residual = 0.0
        for a in range(3):
            target = command[a] + space.motion[a] / law.root[a]
            step = abs(target - pose[a])
            residual = max(residual, step) if a < 2 else residual + step * extent
            pose[a] = target
        turn = (math.cos(pose[2]), math.sin(pose[2]))
        _choose(world, o, law, pose, turn, space)
        if status == RELAXED:
            break
        if residual <= still:
            status = CONVERGED
            break
        if k < NEWTON_ROUNDS and linear_system(world, o, law, command, pose, turn, space):
            for a in range(3):
                space.force[a] = -system.unbalanced[a]
            for j in range(len(space.room)):
                space.right[j] = -system.violated[j]
            respond(space)
            step = space.change
            # A step beyond what this round moved comes from a wrong guess of the contacts.
            if max(abs(step[0]), abs(step[1])) + abs(step[2]) * extent <= 2.0 * residual:
                for a in range(3):
                    pose[a] += step[a]
    if status == NOT_CONVERGED:
        turn = (math.cos(pose[2]), math.sin(pose[2]))
        for j in range(len(space.room)):
            if space.chosen[j, 0] >= 0:
                look(world, o, space.chosen[j, 1], space.chosen[j, 2], pose, turn, space)
    return status, residual


@inner
@no_type_check
def _roughest(world, o, law):
    """Times what a point slips in a round that Coulomb friction may lift it in the next one, or 1
    where that is less."""
    largest = 1.0
    if law.coulomb:
        for t in range(world.friction.shape[1]):
            largest = max(largest, world.friction[o, t])
    return largest


@inner
@no_type_check
def _recalled(m, space):
    """The solution that another backend found for the m rows; `WANTED` where it has none yet."""
    recall = space.recall
    c = recall.cursor[0]
    if c == recall.cursor[1]:
        recall.cursor[2] = m
        return WANTED
    recall.cursor[0] = c + 1
    for a in range(len(space.room)):
        space.motion[a] = recall.motion[c, a]
    for r in range(m):
        space.multipliers[r] = recall.multipliers[c, r]
    _take_most_loaded(m, space)
    return recall.status[c]


@inner
@no_type_check
def _take_most_loaded(m, space):
    """Take the rows that bear most load for those that carry it."""
    for j in range(len(space.room)):
        best, most = -1, 0.0
        for r in range(m):
            taken = False
            for i in range(j):
                taken = taken or space.slots[i] == r
            if not taken and space.multipliers[r] > most:
                best, most = r, space.multipliers[r]
        space.slots[j] = best


@inner(forceinline=True)
@no_type_check
def _solve(m, space):
    """Solve the contact problem of the m rows that were built."""
    if space.recall.cursor[1] >= 0:
        return _recalled(m, space)
    if len(space.room) == 3:
        found, _ = solve_whitened_3(
            space.rows, space.values, space.sizes, m, space.motion, space.multipliers,
            space.slots, space.work,
        )  # fmt: skip
        return found
    n = len(space.room)
    found, _ = solve_whitened(
        space.rows, space.values, space.sizes, m, n, 10 * (m + n), space.motion,
        space.multipliers, space.slots, space.work,
    )  # fmt: skip
    return found


@inner
@no_type_check
def _give_way(m, space):
    """Solve the m rows that no motion satisfies with a little compliance each, as `qp.elastic`
    says: one more variable a row. The rows that bear most load are in `slots`."""
    k, elastic = len(space.room), space.elastic
    shrink = 1.0 / math.sqrt(1.0 + RELAXATION)
    for r in range(m):
        for a in range(k + m):
            elastic.rows[r, a] = 0.0
        for a in range(k):
            elastic.rows[r, a] = space.rows[r, a] * shrink
        elastic.rows[r, k + r] = _SOFT * shrink
        space.values[r] *= shrink
        space.sizes[r] *= shrink
    solve_whitened(
        elastic.rows, space.values, space.sizes, m, k + m, 10 * (2 * m + k), elastic.motion,
        space.multipliers, elastic.slots, elastic.work,
    )  # fmt: skip
    for a in range(k):
        space.motion[a] = elastic.motion[a]
    for r in range(m):
        space.multipliers[r] *= shrink
    _take_most_loaded(m, space)


@inner(forceinline=True)
@no_type_check
def _list_candidates(
    world, o, chains, law, start, start_turn, pose, turn, k, give_way, space
):  # fmt: skip
    """List the points that could carry load at a pose, in round k; turns as (cos, sin). Where rows
    may `give_way`, a jammed face is held at both ends from the start."""
    for t in range(world.friction.shape[1]):
        curved = spread(world.surfaces, world.where[0], t) > 0.0
        if law.coulomb or k == 0 or curved:
            gap, point = nearest(world, o, chains, t, (pose[0], pose[1]), turn)
            # Coulomb friction acts only where a terrain is touched; convex friction pushes
            # on bodies that it does not touch.
            if law.coulomb and space.counts[t] == 0 and gap > NEAR:
                continue
            _add(world, o, t, point, start, start_turn, space)
        if curved or law.coulomb and not (give_way and k == 0):
            continue
        u, v = object_normal(world, o, t, turn[0], turn[1])
        u_start, v_start = object_normal(world, o, t, start_turn[0], start_turn[1])
        for side in range(2):
            # At first a flat face shows both its ends; later the row of side s asks for
            # gap + s mu slip of every point, which need not be least where the gap is.
            sign = 1.0 - 2.0 * side
            if k == 0:
                du, dv = PROBE_ANGLE * sign * v, -PROBE_ANGLE * sign * u
            else:
                slope = world.friction[o, t] * sign
                du, dv = slope * (v - v_start), -slope * (u - u_start)
            _, point = lowest_point(world, o, chains, t, u + du, v + dv)
            _add(world, o, t, point, start, start_turn, space)


@inner
@no_type_check
def _add(world, o, t, point, start, start_turn, space):
    """Put a point on the list of terrain t; when full it replaces the oldest."""
    for k in range(min(space.counts[t], LIST)):
        if space.listed[t, k] == point:
            return
    k = space.counts[t] % LIST
    space.counts[t] += 1
    space.listed[t, k] = point
    x, z = world.points[o, 0, point], world.points[o, 1, point]
    place = space.place
    place[t, k, 0], place[t, k, 1] = x, z
    place[t, k, 2] = start_turn[0] * x - start_turn[1] * z
    place[t, k, 3] = start_turn[1] * x + start_turn[0] * z
    place[t, k, 4], place[t, k, 5] = start[0] + place[t, k, 2], start[1] + place[t, k, 3]


@inner(forceinline=True)
@no_type_check
def look(world, o, t, k, pose, turn, space):
    """Record the contact of a listed candidate at a pose; also its slip since the part's start."""
    place, record = space.place, space.record
    ax = turn[0] * place[t, k, 0] - turn[1] * place[t, k, 1]
    az = turn[1] * place[t, k, 0] + turn[0] * place[t, k, 1]
    x, z = pose[0] + ax, pose[1] + az
    gap, nx, nz, bend = query(world.surfaces, world.where[0], t, x, z)
    gap += world.clearance[o, t]
    height, along = nx * ax + nz * az, nz * ax - nx * az
    record[t, k, 0], record[t, k, 1], record[t, k, 2] = gap, nx, nz
    record[t, k, 3], record[t, k, 4], record[t, k, 5] = height, along, bend
    return gap, nx, nz, height, along, nz * (x - place[t, k, 4]) - nx * (z - place[t, k, 5])


@inner(error_model="numpy", forceinline=True)
@no_type_check
def _build_rows(world, o, law, command, pose, turn, space):
    """Unit whitened rows of all listed candidates, linearised at `pose`; returns their number."""
    rows, values, sizes, lengths = space.rows, space.values, space.sizes, space.lengths
    away_x, away_z, away_turn = command[0] - pose[0], command[1] - pose[1], command[2] - pose[2]
    root_x, root_z, root_turn = 1.0 / law.root[0], 1.0 / law.root[1], 1.0 / law.root[2]
    m = 0
    for t in range(world.friction.shape[1]):
        mu, yields = world.friction[o, t], math.sqrt(world.compliance[o, t])
        for k in range(min(space.counts[t], LIST)):
            # Height and tangential position of the point over the end effector: the angle moves
            # the one by the other.
            common, nx, nz, height, along, slip = look(world, o, t, k, pose, turn, space)
            if law.coulomb:
                common += mu * abs(slip)
            for s in range(2):
                side = 1.0 - 2.0 * s
                slope = side * mu
                row_x, row_z, row_turn = nx + slope * nz, nz - slope * nx, along - slope * height
                part_x, part_z, part_turn = row_x * away_x, row_z * away_z, row_turn * away_turn
                values[m] = common + slope * slip + part_x + part_z + part_turn
                sizes[m] = (
                    abs(common) + abs(slope * slip) + abs(part_x) + abs(part_z) + abs(part_turn)
                )
                row_x, row_z, row_turn = row_x * root_x, row_z * root_z, row_turn * root_turn
                rows[m, 0], rows[m, 1], rows[m, 2] = row_x, row_z, row_turn
                lengths[m] = row_x * row_x + row_z * row_z + row_turn * row_turn
                if len(space.room) > 3:
                    for a in range(3, len(space.room)):
                        rows[m, a] = yields if a == 3 + t else 0.0
                    lengths[m] += yields * yields
                space.source[m, 0], space.source[m, 1] = t, 2 * k + s
                m += 1
    # The roots and divisions in a loop of their own, which the processor does side by side.
    for r in range(m):
        lengths[r] = math.sqrt(lengths[r])
        values[r] /= lengths[r]
        sizes[r] /= lengths[r]
    for r in range(m):
        inverse = 1.0 / lengths[r]
        for a in range(len(space.room)):
            rows[r, a] *= inverse
    return m


@inner(forceinline=True)
@no_type_check
def _choose(world, o, law, pose, turn, space):
    """Read the loaded rows off the solved problem."""
    for t in range(world.friction.shape[1]):
        space.load[t] = 0.0
    space.slid[0] = False
    for j in range(len(space.room)):
        space.chosen[j, 0] = -1
        space.multiplier[j] = 0.0
        r = space.slots[j]
        if r < 0 or not space.multipliers[r] > 0.0:
            continue
        t, k = space.source[r, 0], space.source[r, 1] // 2
        space.chosen[j, 0], space.chosen[j, 1], space.chosen[j, 2] = space.listed[t, k], t, k
        space.multiplier[j] = space.multipliers[r] / space.lengths[r]
        space.side[j] = 1.0 - 2.0 * (space.source[r, 1] % 2)
        space.load[t] += space.multiplier[j]
        _, _, _, _, _, slip = look(world, o, t, k, pose, turn, space)
        space.slipping[j] = abs(slip) > SLIGHT * law.tolerance
        space.slid[0] = space.slid[0] or space.slipping[j]
    for j in range(len(space.room)):
        if space.chosen[j, 0] < 0:
            continue
        one_sided, held = True, False
        for i in range(len(space.room)):
            if i != j and space.chosen[i, 0] >= 0 and space.chosen[i, 1] == space.chosen[j, 1]:
                held = held or space.chosen[i, 0] == space.chosen[j, 0]
                one_sided = one_sided and space.side[i] == space.side[j]
        # A point that is held by both its sides has not slipped; where all of a terrain's load
        # is at one edge of the friction cone, slip begins, however little it still is.
        space.slipping[j] = not held and (one_sided or space.slipping[j])


@inner
@no_type_check
def hold_both_sides(space):
    """Hold a face that rests on one side of one point and the other side of another, as it does
    where nothing pulls along it, by the first point's other side too: it bears nothing, but
    without it the face could turn and slip together, which rows without load forbid. Of Coulomb
    friction only: a convex row may be loaded by a point that does not touch."""
    for j in range(len(space.room)):
        for i in range(j):
            if space.chosen[j, 0] < 0 or space.chosen[i, 0] < 0 or space.slipping[j]:
                continue
            apart = space.chosen[i, 0] != space.chosen[j, 0] and space.side[i] != space.side[j]
            if not apart or space.chosen[i, 1] != space.chosen[j, 1] or space.slipping[i]:
                continue
            free, others = -1, 0
            for f in range(len(space.room)):
                if space.chosen[f, 0] < 0:
                    free = f
                elif space.chosen[f, 1] == space.chosen[j, 1]:
                    others += 1
            if free >= 0 and others == 2:
                for a in range(3):
                    space.chosen[free, a] = space.chosen[i, a]
                space.multiplier[free], space.side[free] = 0.0, -space.side[i]
                space.slipping[free] = False
                return
