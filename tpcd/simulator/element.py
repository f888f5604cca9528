"""One quasi-static transition: rest, flight to the first touch, settling, and the path of the
command where contact changes or turns.

Away from contact an impedance-controlled arm settles on its command, so the motion from a free
start is the straight line from pose to command, and friction acts only from the first touch on.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from tpcd.geometry.candidates import first_touch, touching
from tpcd.geometry.query import bent
from tpcd.loops import inner
from tpcd.simulator.events import NOTHING, next_event, respond_until
from tpcd.simulator.path import (
    AIM,
    ALMOST,
    GLANCE,
    LOOK,
    MOST_SOUGHT,
    PASSED,
    TRY,
    contact_modes,
    ends_alike,
    least_part,
    next_part,
    part_end,
    parts_of_path,
    shorter_part,
    sticking,
)
from tpcd.simulator.record import REST_TOLERANCE, START_DEPTH
from tpcd.simulator.request import sound, wrap
from tpcd.simulator.residual import depth_inside, distance_from_rest
from tpcd.simulator.response import linear_system
from tpcd.simulator.rest import (
    CONVERGED,
    INVALID,
    NOT_CONVERGED,
    RELAXED,
    START_INSIDE,
    WANTED,
    hold_both_sides,
    settle,
)
from tpcd.simulator.tangents import (
    append_further,
    append_part,
    begin_further,
    clear_further,
    copy_rows,
    follow_command,
    further_rows,
    landing_response,
    settling_response,
)
from tpcd.simulator.wedging import LIGHTER, may_wedge

PLAIN, LOOSE, SLIPPING, WEDGED, FRICTIONLESS = 0, 1, 2, 3, 4
"""Attempts at settling (see `wedging`): as it is; without friction what may be wedged or is jammed;
from there with it again; if that is no better, as it is after all, or what jams without it."""

RESTING, STRAIGHT, WALKING, STRAIGHT_AFTER_ALL = 0, 1, 2, 3
"""Stages of a step."""


@inner(error_model="numpy", forceinline=True)
@no_type_check
def step_element(
    world, o, chains, law, extent, request, b, answer, space, slopes, poses
):  # fmt: skip
    """One transition: rest on what was touched, go to the command, follow its path if need be.

    Leaves the derivatives by further inputs in `slopes.further`.
    """
    start, before, command, part = poses[0], poses[1], poses[2], poses[3]
    landing, pose, kept_pose = poses[4], poses[5], poses[6]
    whole, terrains = slopes.whole, world.friction.shape[1]
    height = 3 + 2 * terrains
    finite = math.isfinite(extent) and sound(world, o, law)
    for a in range(3):
        start[a], before[a] = request.starts[b, a], request.previous[b, a]
        command[a] = request.commands[b, a]
        finite = finite and math.isfinite(start[a] + before[a] + command[a])
    if not finite:
        answer.statuses[b], answer.residuals[b] = INVALID, np.inf
        answer.poses[b], answer.modes[b] = np.nan, 0
        answer.from_start[b], answer.from_gap[b] = np.nan, np.nan
        answer.from_lever[b], answer.contacts[b] = np.nan, np.nan
        if answer.from_inputs.shape[1] > 0:
            answer.from_inputs[b], answer.from_points[b] = np.nan, np.nan
        return
    before[2] = start[2] + wrap(before[2] - start[2])
    command[2] = start[2] + wrap(command[2] - start[2])
    whole[:] = 0.0
    begin_further(slopes)
    for a in range(3):
        pose[a] = start[a]
        whole[a, a] = 1.0
    # First the start is put on what it rests against, then the whole way is gone at once; in parts
    # where contact changes or what is touched turns, and at once again if that went worse.
    rested, parts, straight = request.rested, 1, CONVERGED
    modes, status, residual, relaxed = 0, CONVERGED, 0.0, False
    stage, done, length, spent = (STRAIGHT if rested else RESTING), 0.0, 1.0, 0
    # Convex friction pushes on what it does not touch: no gap or load foretells its changes.
    locates = request.finest < 1.0 and law.coulomb
    kind, seeks, moving, ahead, inside, bends = TRY, False, False, np.inf, False, False
    if rested:
        space.load[:] = 0.0
        inside = depth_inside(world, o, chains, pose, space.load) > START_DEPTH
        modes = sticking(touching(world, o, chains, pose), terrains)
        _keep(slopes, pose, kept_pose, height)
    while True:
        share = 0.0 if stage == RESTING else 1.0
        if stage == WALKING:
            share = part_end(done, length, parts)
        for a in range(3):
            part[a] = before[a] + share * (command[a] - before[a]) if share < 1.0 else command[a]
            start[a] = pose[a]
        follows, ended, left, now = 1.0 - share if rested else 0.0, CONVERGED, 0.0, 0
        fraction, point, terrain = first_touch(world, o, chains, start, part)
        relaxed, jammed, slid = False, False, False
        for a in range(3):
            landing[a] = start[a] + fraction * (part[a] - start[a])
            pose[a] = landing[a] if fraction < 1.0 else part[a]
        if fraction < 1.0:
            attempt, first, most = PLAIN, CONVERGED, np.inf
            while True:
                ended, left = settle(
                    world, o, chains, law, extent, landing, part, space, pose,
                    attempt != SLIPPING, attempt == FRICTIONLESS,
                )  # fmt: skip
                if ended == WANTED:
                    answer.statuses[b] = WANTED
                    return
                load = 0.0
                for j in range(len(space.room)):
                    load += space.multiplier[j]
                if attempt == PLAIN:
                    first, most = ended, load
                    if not may_wedge(world, o, law, space, ended) and ended != RELAXED:
                        break
                following = _after(attempt, first, ended, law.coulomb, load < LIGHTER * most)
                if following == attempt:
                    break
                for t in range(terrains):
                    if attempt == PLAIN:
                        space.friction[t] = world.friction[o, t]
                    loose = following in (LOOSE, FRICTIONLESS)
                    world.friction[o, t] = 0.0 if loose else space.friction[t]
                attempt = following
            slid = space.slid[0]
            relaxed = attempt == FRICTIONLESS
            jammed = relaxed and ended == RELAXED
            now = contact_modes(space, terrains)
        gone = share - done
        idle = stage != WALKING or not locates or spent == MOST_SOUGHT
        fits = idle or gone <= least_part(kind, request.finest) * (1.0 + ALMOST)
        fits = fits or ends_alike(modes, now, terrains, slid)
        if not idle and (kind == AIM or not fits):
            spent += 1
        seeks = (seeks or not fits) and spent < MOST_SOUGHT
        if not fits:
            for a in range(3):
                pose[a] = start[a]
            if relaxed:
                for t in range(terrains):
                    world.friction[o, t] = space.friction[t]
            kind, length = shorter_part(kind, moving, ahead, gone, request.finest)
            continue
        ahead, event = np.inf, NOTHING
        if relaxed:
            ended = RELAXED
        if fraction == 1.0:
            for j in range(len(space.room)):
                space.chosen[j, 0] = -1
            whole[:] = 0.0
            for a in range(3):
                whole[a, a] = follows
            follow_command(slopes, terrains, share, rested)
        else:
            status, residual = max(status, ended), max(residual, left)
            landing_response(world, o, start, part, fraction, point, terrain, slopes)
            turn = (math.cos(pose[2]), math.sin(pose[2]))
            if law.coulomb:
                hold_both_sides(space)
            linear_system(world, o, law, part, pose, turn, space)
            if share == 1.0:
                off = distance_from_rest(world, o, chains, law, extent, part, pose, turn, space)
                residual = max(residual, off)
                if off > REST_TOLERANCE * law.tolerance:
                    status = max(status, NOT_CONVERGED)
            settling_response(law, terrains, space, slopes)
            if stage == WALKING and share < 1.0 and not jammed:
                ahead, event = next_event(
                    world, o, chains, law, before, command, pose, space, slopes.rate
                )
                room = min(PASSED * gone, part_end(done, 1.0 / parts, parts) - share)
                if kind == AIM and ahead < room:
                    respond_until(world, o, law, event, pose, space, slopes)
                else:
                    event = NOTHING
            append_part(slopes, follows)
            if slopes.inputs > 0:
                append_further(
                    world, o, law, relaxed, (point, terrain), event, landing, part, share, rested,
                    pose, space, slopes,
                )  # fmt: skip
            if jammed:
                # What yields to everything has no derivative.
                whole[:] = 0.0
                clear_further(slopes)
            if event[0] >= 0:
                share += ahead
                for a in range(3):
                    pose[a] += ahead * slopes.rate[a]
            if relaxed:
                for t in range(terrains):
                    world.friction[o, t] = space.friction[t]
        if stage == RESTING:
            if fraction == 0.0:
                inside = depth_inside(world, o, chains, landing, space.load) > START_DEPTH
            modes, status, residual, stage = now, CONVERGED, 0.0, STRAIGHT
            _keep(slopes, pose, kept_pose, height)
        elif stage == STRAIGHT:
            way = math.hypot(command[0] - before[0], command[1] - before[1])
            bends = bent(world.surfaces) and (fraction < 1.0 or modes != 0)
            parts = parts_of_path(
                request, way, command[2] - before[2], modes, now, terrains, slid, bends
            )
            if parts == 1:
                break
            stage, straight, length = WALKING, status, 1.0 / parts
            if locates and not ends_alike(modes, now, terrains, slid):
                seeks, kind, length = True, LOOK, GLANCE
            _restore(slopes, pose, kept_pose, height)
            status, residual = CONVERGED, 0.0
        elif stage == WALKING and share < 1.0:
            modes, done, moving = now, share, True
            if event[0] >= 0:
                ahead = 0.0
            longest = part_end(done, 1.0 / parts, parts) - done
            kind, length = next_part(event[0] >= 0, seeks, ahead, longest)
        elif stage == WALKING and status > straight and not bends:
            stage, status, residual = STRAIGHT_AFTER_ALL, CONVERGED, 0.0
            _restore(slopes, pose, kept_pose, height)
        else:
            break
    if status == CONVERGED and inside:
        status = START_INSIDE
    for a in range(3):
        answer.poses[b, a] = pose[a]
    for t in range(terrains):
        answer.modes[b, t] = now >> 2 * t & 3
    _contacts(world, o, pose, space, answer.contacts, b)
    if relaxed:
        answer.contacts[b, :, 1] = 0.0
    answer.statuses[b], answer.residuals[b] = status, residual
    copy_rows(whole, 0, answer.from_start[b], 3)
    copy_rows(whole, 3, answer.from_gap[b], terrains)
    copy_rows(whole, 3 + terrains, answer.from_lever[b], terrains)
    if answer.from_inputs.shape[1] > 0:
        copy_rows(slopes.further, 0, answer.from_inputs[b], slopes.inputs)
        answer.from_points[b] = 0.0
        for i in range(slopes.count[0]):
            for c in range(2):
                for a in range(3):
                    row = slopes.inputs + 2 * i + c
                    answer.from_points[b, slopes.touched[i, 0], c, a] += slopes.further[row, a]


@inner
@no_type_check
def _after(attempt, first, ended, coulomb, lighter):
    """The attempt at settling that follows one that ended so, when the `first` did not satisfy or
    may be wedged; itself where none does."""
    if attempt == PLAIN:
        return LOOSE if coulomb else FRICTIONLESS
    if attempt == LOOSE and ended != RELAXED:
        return SLIPPING
    taken = attempt == SLIPPING and ended == CONVERGED and (lighter or first != CONVERGED)
    if attempt in (LOOSE, SLIPPING) and not taken:
        return FRICTIONLESS if first == RELAXED else WEDGED
    return attempt


@inner
@no_type_check
def _keep(slopes, pose, kept_pose, height):
    """Keep the state that the path begins in."""
    copy_rows(slopes.whole, 0, slopes.kept, height)
    copy_rows(slopes.further, 0, slopes.further_kept, further_rows(slopes))
    for a in range(3):
        kept_pose[a] = pose[a]


@inner
@no_type_check
def _restore(slopes, pose, kept_pose, height):
    """Go back to the state that the path begins in."""
    copy_rows(slopes.kept, 0, slopes.whole, height)
    copy_rows(slopes.further_kept, 0, slopes.further, further_rows(slopes))
    for a in range(3):
        pose[a] = kept_pose[a]


@inner(error_model="numpy", forceinline=True)
@no_type_check
def _contacts(world, o, pose, space, contacts, b):
    """Forces of each terrain and the arm of their point, weighted by load."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    contacts[b] = 0.0
    for j in range(len(space.room)):
        load = space.multiplier[j]
        if space.chosen[j, 0] < 0 or not load > 0.0:
            continue
        t, k = space.chosen[j, 1], space.chosen[j, 2]
        x, z = space.place[t, k, 0], space.place[t, k, 1]
        contacts[b, t, 0] += load
        contacts[b, t, 1] += load * space.side[j] * world.friction[o, t]
        contacts[b, t, 2] += load * (cosine * x - sine * z)
        contacts[b, t, 3] += load * (sine * x + cosine * z)
    for t in range(contacts.shape[1]):
        if contacts[b, t, 0] > 0.0:
            contacts[b, t, 2] /= contacts[b, t, 0]
            contacts[b, t, 3] /= contacts[b, t, 0]
