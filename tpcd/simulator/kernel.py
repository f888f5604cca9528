"""Compiled loops of the quasi-static step for half-plane terrains.

The same model as `settle`, `flight` and `implicit`, one transition after the other without
allocation: the lowest point of each terrain joins a short list of candidates in every
round, the contact problem of the list is solved, and its active rows give a Newton step on
Coulomb's law that spares most rounds of the fixed point. Imported only where numba is.

Arrays of one scene: `points` (2, p) outline in the end-effector frame, `normals` (t, 2),
`offsets` (t), `friction` (t). Contact rows are stored as in `ContactSet`.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange

from tpcd.qp.compiled import normalise_rows, solve_whitened_3
from tpcd.qp.problem import Status

LIST = 6
"""Candidate points kept for each terrain."""
NEWTON_ROUNDS = 6
"""Rounds in which the Newton step on Coulomb's law is tried; later ones are plain fixed point."""
_PROBE = 0.02
_FREE_GAP = 1e-5
_NEAR = 1e-4
_SEARCH = 12
_SOLVED = int(Status.SOLVED)
CONVERGED, NOT_CONVERGED, RELAXED, INVALID = 0, 1, 2, 3
_FAST = {"nnan", "nsz", "contract"}


@njit(cache=True, fastmath=_FAST)
@no_type_check
def _heights(points, a, b, scratch):
    """Least of a x + b z over the points, leaving all values in `scratch`."""
    lowest = np.inf
    for i in range(points.shape[1]):
        value = a * points[0, i] + b * points[1, i]
        scratch[i] = value
        if value < lowest:
            lowest = value
    return lowest


@njit(cache=True)
@no_type_check
def _index_of(scratch, value):
    for i in range(scratch.shape[0]):
        if scratch[i] == value:
            return i
    return 0


@njit(cache=True)
@no_type_check
def _lowest(points, normals, offsets, x, z, angle, scratch):
    """Smallest gap over all terrains at a pose, with its point and terrain."""
    cosine, sine = math.cos(angle), math.sin(angle)
    best, best_point, best_terrain = np.inf, 0, 0
    for t in range(normals.shape[0]):
        nx, nz = normals[t, 0], normals[t, 1]
        low = _heights(points, cosine * nx + sine * nz, cosine * nz - sine * nx, scratch)
        gap = low + nx * x + nz * z - offsets[t]
        if gap < best:
            best, best_point, best_terrain = gap, _index_of(scratch, low), t
    return best, best_point, best_terrain


@njit(cache=True)
@no_type_check
def _first_touch(points, normals, offsets, start, command, scratch):
    """Free fraction of the way from start to command, with the touching point and terrain."""
    value_low, point, terrain = _lowest(
        points, normals, offsets, start[0], start[1], start[2], scratch
    )
    if value_low <= _FREE_GAP:
        return 0.0, point, terrain
    value_high, point, terrain = _lowest(
        points, normals, offsets, command[0], command[1], command[2], scratch
    )
    if value_high >= 0.0:
        return 1.0, point, terrain
    low, high, last = 0.0, 1.0, 0
    for _ in range(_SEARCH):
        trial = (low * value_high - high * value_low) / (value_high - value_low)
        gap, point, terrain = _lowest(
            points,
            normals,
            offsets,
            start[0] + trial * (command[0] - start[0]),
            start[1] + trial * (command[1] - start[1]),
            start[2] + trial * (command[2] - start[2]),
            scratch,
        )
        if gap >= 0.0:
            low, value_low = trial, gap
            if last > 0:
                value_high *= 0.5
            last = 1
        else:
            high, value_high = trial, gap
            if last < 0:
                value_low *= 0.5
            last = -1
        if gap >= 0.0 and gap <= 1e-9 or high - low <= 1e-9:
            break
    return low, point, terrain


@njit(cache=True)
@no_type_check
def _add_candidate(listed, counts, t, point):
    """Put a point on the list of terrain t; when full it replaces the oldest probe."""
    for k in range(min(counts[t], LIST)):
        if listed[t, k] == point:
            return
    listed[t, counts[t] % LIST] = point
    counts[t] += 1


@njit(cache=True)
@no_type_check
def _scan(points, normals, offsets, pose, turn, reach, listed, counts, scratch):
    """List the lowest point of every terrain within reach, the object turned by `turn`."""
    cosine, sine = math.cos(pose[2] + turn), math.sin(pose[2] + turn)
    for t in range(normals.shape[0]):
        nx, nz = normals[t, 0], normals[t, 1]
        low = _heights(points, cosine * nx + sine * nz, cosine * nz - sine * nx, scratch)
        if counts[t] > 0 or low + nx * pose[0] + nz * pose[1] - offsets[t] <= reach:
            _add_candidate(listed, counts, t, _index_of(scratch, low))


@njit(cache=True)
@no_type_check
def _contact(points, normals, offsets, t, i, pose, cosine, sine, out):
    """Gap, tangential position and Jacobian rows of point i against terrain t.

    `out`: gap, tangential position, normal row (3), tangent row (3), n·arm, t·arm.
    """
    nx, nz = normals[t, 0], normals[t, 1]
    arm_x = cosine * points[0, i] - sine * points[1, i]
    arm_z = sine * points[0, i] + cosine * points[1, i]
    x, z = arm_x + pose[0], arm_z + pose[1]
    out[0] = nx * x + nz * z - offsets[t]
    out[1] = nz * x - nx * z
    out[2], out[3], out[4] = nx, nz, nz * arm_x - nx * arm_z
    out[5], out[6], out[7] = nz, -nx, -nx * arm_x - nz * arm_z
    out[8] = nx * arm_x + nz * arm_z
    out[9] = nz * arm_x - nx * arm_z


@njit(cache=True)
@no_type_check
def _tangential(points, normals, t, i, pose):
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    x = cosine * points[0, i] - sine * points[1, i] + pose[0]
    z = sine * points[0, i] + cosine * points[1, i] + pose[1]
    return normals[t, 1] * x - normals[t, 0] * z


@njit(cache=True)
@no_type_check
def _build_rows(
    points, normals, offsets, friction, start, command, pose, root, coulomb, compliance,
    listed, counts, load, rows, values, sizes, row_point, row_terrain, row_side, frame,
):
    """Whitened rows of all listed candidates, linearised at `pose`; returns their number."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    m = 0
    for t in range(normals.shape[0]):
        for k in range(min(counts[t], LIST)):
            i = listed[t, k]
            _contact(points, normals, offsets, t, i, pose, cosine, sine, frame)
            slip = frame[1] - _tangential(points, normals, t, i, start)
            common = frame[0] + compliance * load[t]
            if coulomb:
                common += friction[t] * abs(slip)
            for s in range(2):
                side = 1.0 - 2.0 * s
                slope = side * friction[t]
                value = common + slope * slip
                size = abs(common) + abs(slope * slip)
                for a in range(3):
                    row = frame[2 + a] + slope * frame[5 + a]
                    rows[m, a] = row / root[a]
                    part = row * (command[a] - pose[a])
                    value += part
                    size += abs(part)
                values[m], sizes[m] = value, size
                row_point[m], row_terrain[m], row_side[m] = i, t, side
                m += 1
    return m


@njit(cache=True)
@no_type_check
def _linear_system(
    points, normals, offsets, friction, start, command, pose, stiffness, coulomb, compliance,
    chosen, multiplier, side, slipping, system, frame,
):
    """Residuals and matrices of the rest equations at `pose`, as in `implicit`.

    `chosen` (3, 2) point and terrain, -1 where free. Fills `system` (9, 3): constraint
    rows, force rows, inverse stiffness, force residual, row residual; returns the 3 x 3
    inverse of the Schur complement in rows 9-11 and the start rows in 12-14.
    """
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    turning = 0.0
    for a in range(3):
        system[7, a] = stiffness[a] * (pose[a] - command[a])
    for j in range(3):
        system[8, j] = 0.0
        for a in range(3):
            system[j, a] = 0.0
            system[3 + j, a] = 0.0
            system[12 + j, a] = 0.0
        if chosen[j, 0] < 0:
            continue
        i, t = chosen[j, 0], chosen[j, 1]
        _contact(points, normals, offsets, t, i, pose, cosine, sine, frame)
        slope = side[j] * friction[t]
        drag = 0.0 if (coulomb and slipping[j]) else slope
        slip = frame[1] - _tangential(points, normals, t, i, start)
        load = 0.0
        for k in range(3):
            if chosen[k, 0] >= 0 and chosen[k, 1] == t:
                load += multiplier[k]
        system[8, j] = frame[0] + drag * slip + compliance * load
        for a in range(3):
            system[j, a] = frame[2 + a] + drag * frame[5 + a]
            force = frame[2 + a] + slope * frame[5 + a]
            system[3 + j, a] = force
            system[7, a] -= multiplier[j] * force
        turning += multiplier[j] * (frame[8] + slope * frame[9])
        cosine_start, sine_start = math.cos(start[2]), math.sin(start[2])
        _contact(points, normals, offsets, t, i, start, cosine_start, sine_start, frame)
        for a in range(3):
            system[12 + j, a] = -drag * frame[5 + a]
    for a in range(3):
        system[6, a] = 1.0 / (stiffness[a] + (turning if a == 2 else 0.0))
    for j in range(3):
        for k in range(3):
            value = 1.0 if j == k else 0.0
            if chosen[j, 0] >= 0 and chosen[k, 0] >= 0:
                value = compliance if chosen[j, 1] == chosen[k, 1] else 0.0
                for a in range(3):
                    value += system[j, a] * system[6, a] * system[3 + k, a]
            elif j != k:
                value = 0.0
            system[9 + j, k] = value
    return _invert(system)


@njit(cache=True)
@no_type_check
def _invert(system):
    """Invert the 3 x 3 matrix in rows 9-11 in place; False where it is singular."""
    a, b, c = system[9, 0], system[9, 1], system[9, 2]
    d, e, f = system[10, 0], system[10, 1], system[10, 2]
    g, h, k = system[11, 0], system[11, 1], system[11, 2]
    first, second, third = e * k - f * h, f * g - d * k, d * h - e * g
    determinant = a * first + b * second + c * third
    scale = (abs(a) + abs(b) + abs(c)) * (abs(d) + abs(e) + abs(f)) * (abs(g) + abs(h) + abs(k))
    if not abs(determinant) > 1e-12 * scale:
        for j in range(3):
            for l in range(3):
                system[9 + j, l] = 0.0
        return False
    r = 1.0 / determinant
    system[9, 0], system[9, 1], system[9, 2] = first * r, (c * h - b * k) * r, (b * f - c * e) * r
    system[10, 0], system[10, 1], system[10, 2] = second * r, (a * k - c * g) * r, (c * d - a * f) * r
    system[11, 0], system[11, 1], system[11, 2] = third * r, (b * g - a * h) * r, (a * e - b * d) * r
    return True


@njit(cache=True)
@no_type_check
def _respond(system, chosen, force, row, out):
    """Pose change for right-hand sides of the force balance and of the loaded rows."""
    m0 = m1 = m2 = 0.0
    for j in range(3):
        if chosen[j, 0] < 0:
            continue
        right = row[j]
        for a in range(3):
            right -= system[j, a] * system[6, a] * force[a]
        m0 += system[9, j] * right
        m1 += system[10, j] * right
        m2 += system[11, j] * right
    for a in range(3):
        push = force[a]
        if chosen[0, 0] >= 0:
            push += m0 * system[3, a]
        if chosen[1, 0] >= 0:
            push += m1 * system[4, a]
        if chosen[2, 0] >= 0:
            push += m2 * system[5, a]
        out[a] = system[6, a] * push


@njit(cache=True)
@no_type_check
def _settle(
    points, normals, offsets, friction, start, command, stiffness, root, extent, coulomb,
    rounds, tolerance, compliance, scratch, listed, counts, load, rows, values, sizes, lengths,
    multipliers, row_point, row_terrain, row_side, motion, slots, work, frame, system,
    chosen, multiplier, side, slipping, pose, vector, force, row_right,
):
    """Settle one element; leaves pose and loaded contacts, returns status and residual."""
    terrains = normals.shape[0]
    for t in range(terrains):
        counts[t] = 0
        load[t] = 0.0
    for a in range(3):
        pose[a] = start[a]
    status, residual = NOT_CONVERGED, np.inf
    # Convex friction pushes on bodies that it does not touch; Coulomb friction does not, so
    # there a terrain matters only once something has come to it.
    reach = _NEAR if coulomb else np.inf
    for j in range(3):
        chosen[j, 0] = -1
        multiplier[j] = 0.0
    for k in range(rounds):
        _scan(points, normals, offsets, pose, 0.0, reach, listed, counts, scratch)
        if k == 0 and not coulomb:
            _scan(points, normals, offsets, pose, _PROBE, reach, listed, counts, scratch)
            _scan(points, normals, offsets, pose, -_PROBE, reach, listed, counts, scratch)
        m = _build_rows(
            points, normals, offsets, friction, start, command, pose, root, coulomb, compliance,
            listed, counts, load, rows, values, sizes, row_point, row_terrain, row_side, frame,
        )
        normalise_rows(rows, values, sizes, lengths, m)
        found, _ = solve_whitened_3(rows, values, sizes, m, motion, multipliers, slots, work)
        if found != _SOLVED:
            return RELAXED, np.inf
        change = 0.0
        for a in range(3):
            target = command[a] + motion[a] / root[a]
            step = abs(target - pose[a])
            change = max(change, step) if a < 2 else change + step * extent
            pose[a] = target
        for t in range(terrains):
            load[t] = 0.0
        for j in range(3):
            chosen[j, 0] = -1
            multiplier[j] = 0.0
            r = slots[j]
            if r >= 0 and multipliers[r] > 0.0:
                i, t = row_point[r], row_terrain[r]
                chosen[j, 0], chosen[j, 1] = i, t
                multiplier[j] = multipliers[r] / lengths[r]
                side[j] = row_side[r]
                load[t] += multiplier[j]
                slip = _tangential(points, normals, t, i, pose) - _tangential(
                    points, normals, t, i, start
                )
                slipping[j] = abs(slip) > 10.0 * tolerance
        for j in range(3):
            for l in range(3):
                if (
                    j != l and chosen[j, 0] >= 0 and chosen[j, 0] == chosen[l, 0]
                    and chosen[j, 1] == chosen[l, 1]
                ):
                    slipping[j] = False
        residual = change
        if change <= tolerance:
            status = CONVERGED
            break
        if k < NEWTON_ROUNDS and _linear_system(
            points, normals, offsets, friction, start, command, pose, stiffness, coulomb,
            compliance, chosen, multiplier, side, slipping, system, frame,
        ):
            for a in range(3):
                force[a] = -system[7, a]
                row_right[a] = -system[8, a]
            _respond(system, chosen, force, row_right, vector)
            # A step beyond what this round moved comes from a wrong guess of the contacts.
            if abs(vector[0]) + abs(vector[1]) + abs(vector[2]) * extent <= 2.0 * change:
                for a in range(3):
                    pose[a] += vector[a]
    return status, residual


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
@no_type_check
def step_all(
    points, normals, offsets, friction, owner, starts, previous, commands, rested, stiffness,
    coulomb, substeps, follow_path, rounds, tolerance, compliance, chunks,
    poses, modes, statuses, residuals, from_start, from_gap, from_lever,
):
    """Step every transition; `owner` names the scene of each. Outputs are filled in place.

    `rested` says that nothing was commanded before, so that `previous` equals the start.
    """
    count, terrains = starts.shape[0], normals.shape[1]
    for chunk in prange(chunks):
        scratch = np.empty(points.shape[2])
        listed, counts = np.zeros((terrains, LIST), np.int64), np.zeros(terrains, np.int64)
        load, width = np.zeros(terrains), 2 * terrains * LIST
        rows, values, sizes = np.empty((width, 3)), np.empty(width), np.empty(width)
        lengths, multipliers = np.empty(width), np.empty(width)
        row_point, row_terrain = np.zeros(width, np.int64), np.zeros(width, np.int64)
        row_side, motion, slots = np.empty(width), np.empty(3), np.zeros(3, np.int64)
        work, frame, system = np.empty((8, 3)), np.empty(10), np.empty((15, 3))
        chosen, multiplier, side = np.zeros((3, 2), np.int64), np.zeros(3), np.zeros(3)
        slipping = np.zeros(3, np.bool_)
        start, before, command = np.empty(3), np.empty(3), np.empty(3)
        part, landing, pose, first = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
        vector, force, row_right = np.empty(3), np.empty(3), np.empty(3)
        # Derivatives: rows 0-2 of the whole step by the start, then by gaps, then by levers.
        height = 3 + 2 * terrains
        whole, kept, response = np.zeros((height, 3)), np.zeros((height, 3)), np.zeros((9, 3))
        by_terrain, land = np.zeros((2 * terrains, 3)), np.zeros((6, 3))
        land_gap = np.zeros((terrains, 3))
        root = np.sqrt(stiffness)
        owned, extent = -1, 0.0
        for b in range(chunk * count // chunks, (chunk + 1) * count // chunks):
            o = owner[b]
            if o != owned:
                extent = 0.0
                for i in range(points.shape[2]):
                    extent = max(extent, points[o, 0, i] ** 2 + points[o, 1, i] ** 2)
                extent, owned = math.sqrt(extent), o
            finite = math.isfinite(extent)
            for t in range(terrains):
                finite = finite and math.isfinite(offsets[o, t]) and math.isfinite(friction[o, t])
            for a in range(3):
                start[a], before[a], command[a] = starts[b, a], previous[b, a], commands[b, a]
                finite = finite and math.isfinite(start[a] + before[a] + command[a])
            if not finite:
                statuses[b], residuals[b] = INVALID, np.inf
                poses[b], modes[b] = np.nan, 0
                from_start[b], from_gap[b], from_lever[b] = np.nan, np.nan, np.nan
                continue
            before[2] = start[2] + _wrap(before[2] - start[2])
            command[2] = start[2] + _wrap(command[2] - start[2])
            whole[:] = 0.0
            for a in range(3):
                pose[a] = start[a]
                whole[a, a] = 1.0
            touching, status, residual = 0, CONVERGED, 0.0
            # Run 0 puts the start on what it rests against, run 1 goes straight to the
            # command, runs 2.. follow the command's path where contact has changed.
            run, last = (1 if rested else 0), 1
            if rested:
                touching = _touching(points[o], normals[o], offsets[o], pose, scratch)
            while run <= last:
                if run == 1:
                    first[:], kept[:] = pose, whole
                    share = 1.0
                elif run == 0:
                    share = 0.0
                else:
                    share = (run - 1) / substeps
                if run == 2:
                    pose[:], whole[:] = first, kept
                    status, residual = CONVERGED, 0.0
                for a in range(3):
                    part[a] = before[a] + share * (command[a] - before[a])
                    start[a] = pose[a]
                fraction, point, terrain = _first_touch(
                    points[o], normals[o], offsets[o], start, part, scratch
                )
                for a in range(3):
                    landing[a] = start[a] + fraction * (part[a] - start[a])
                    pose[a] = landing[a]
                if fraction == 1.0:
                    for j in range(3):
                        chosen[j, 0] = -1
                    whole[:] = 0.0
                    for a in range(3):
                        whole[a, a] = 1.0 - share if rested else 0.0
                else:
                    _landing_response(
                        points[o], normals[o], offsets[o], start, part, fraction, point, terrain,
                        land, land_gap, frame,
                    )
                    ended, left = _settle(
                        points[o], normals[o], offsets[o], friction[o], landing, part, stiffness,
                        root, extent, coulomb, rounds, tolerance, compliance, scratch, listed,
                        counts, load, rows, values, sizes, lengths, multipliers, row_point,
                        row_terrain, row_side, motion, slots, work, frame, system, chosen,
                        multiplier, side, slipping, pose, vector, force, row_right,
                    )
                    if ended == RELAXED:
                        status = RELAXED
                        break
                    status, residual = max(status, ended), max(residual, left)
                    _linear_system(
                        points[o], normals[o], offsets[o], friction[o], landing, part, pose,
                        stiffness, coulomb, compliance, chosen, multiplier, side, slipping,
                        system, frame,
                    )
                    _responses(
                        system, chosen, stiffness, load, terrains, response, by_terrain, force,
                        row_right, vector,
                    )
                    _chain(
                        whole, response, by_terrain, land, land_gap,
                        1.0 - share if rested else 0.0, vector, force,
                    )
                if run == 0:
                    touching, status, residual = _loaded(chosen), CONVERGED, 0.0
                elif run == 1 and substeps > 1:
                    now = _loaded(chosen)
                    changed = now != 0 and now != touching
                    if follow_path or changed and (touching != 0 or now & (now - 1) != 0):
                        last = substeps + 1
                run += 1
            for a in range(3):
                poses[b, a] = pose[a]
            _modes(chosen, multiplier, side, slipping, modes[b])
            statuses[b], residuals[b] = status, residual
            from_start[b] = whole[:3]
            from_gap[b] = whole[3 : 3 + terrains]
            from_lever[b] = whole[3 + terrains :]


@njit(cache=True)
@no_type_check
def _wrap(angle):
    """The angle wrapped to (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@njit(cache=True)
@no_type_check
def _touching(points, normals, offsets, pose, scratch):
    """Bit mask of the terrains within `_FREE_GAP` of the object."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    mask = 0
    for t in range(normals.shape[0]):
        nx, nz = normals[t, 0], normals[t, 1]
        low = _heights(points, cosine * nx + sine * nz, cosine * nz - sine * nx, scratch)
        if low + nx * pose[0] + nz * pose[1] - offsets[t] <= _FREE_GAP:
            mask |= 1 << t
    return mask


@njit(cache=True)
@no_type_check
def _loaded(chosen):
    """Bit mask of the terrains that carry load."""
    mask = 0
    for j in range(3):
        if chosen[j, 0] >= 0:
            mask |= 1 << chosen[j, 1]
    return mask


@njit(cache=True)
@no_type_check
def _landing_response(
    points, normals, offsets, start, command, fraction, point, terrain, land, land_gap, frame
):
    """Derivatives of the first-touch pose by start (rows 0-2), command (3-5) and gaps."""
    land[:], land_gap[:] = 0.0, 0.0
    for a in range(3):
        land[a, a] = 1.0
    if fraction == 0.0:
        return
    pose = start + fraction * (command - start)
    _contact(
        points, normals, offsets, terrain, point, pose, math.cos(pose[2]), math.sin(pose[2]), frame
    )
    approach = 0.0
    for a in range(3):
        approach -= frame[2 + a] * (command[a] - start[a])
    for a in range(3):
        share = (command[a] - start[a]) / approach
        land_gap[terrain, a] = share
        for c in range(3):
            turn = (1.0 if a == c else 0.0) + share * frame[2 + c]
            land[a, c] = (1.0 - fraction) * turn
            land[3 + a, c] = fraction * turn


@njit(cache=True)
@no_type_check
def _responses(
    system, chosen, stiffness, load, terrains, response, by_terrain, force, row, vector
):
    """Derivatives of the settled pose: by start and command (6 rows of `response`, as matrices),
    by the gap and the lever of each terrain (rows of `by_terrain`)."""
    for c in range(3):
        for j in range(3):
            force[j], row[j] = 0.0, -system[12 + j, c]
        _respond(system, chosen, force, row, vector)
        for a in range(3):
            response[a, c] = vector[a]
            row[a] = 0.0
        force[c] = stiffness[c]
        _respond(system, chosen, force, row, vector)
        for a in range(3):
            response[3 + a, c] = vector[a]
    for t in range(terrains):
        for j in range(3):
            force[j] = 0.0
            row[j] = -1.0 if (chosen[j, 0] >= 0 and chosen[j, 1] == t) else 0.0
        _respond(system, chosen, force, row, vector)
        for a in range(3):
            by_terrain[t, a] = vector[a]
            row[a] = 0.0
        force[2] = load[t]
        _respond(system, chosen, force, row, vector)
        for a in range(3):
            by_terrain[terrains + t, a] = vector[a]


@njit(cache=True)
@no_type_check
def _chain(whole, response, by_terrain, land, land_gap, follows, column, middle):
    """Append one settling to the derivatives of the whole step.

    `follows` is how much the command of this part moves with the start pose.
    """
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


@njit(cache=True)
@no_type_check
def _modes(chosen, multiplier, side, slipping, modes):
    """Contact mode against each terrain, from the row that carries the largest load."""
    for t in range(modes.shape[0]):
        modes[t] = 0
        largest = 0.0
        for j in range(3):
            if chosen[j, 0] >= 0 and chosen[j, 1] == t and multiplier[j] > largest:
                largest = multiplier[j]
                modes[t] = 1 if not slipping[j] else (2 if side[j] < 0.0 else 3)
