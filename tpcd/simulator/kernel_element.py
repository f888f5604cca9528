"""One quasi-static transition in compiled loops: rest, flight to the first touch, settling, and
the path of the command where contact changes or turns. The same model as `settle`, `flight` and
`implicit`.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from tpcd.simulator.kernel_geometry import first_touch, touching
from tpcd.simulator.kernel_linear import linear_system
from tpcd.simulator.kernel_request import sound, wrap
from tpcd.simulator.kernel_settle import CONVERGED, INVALID, JAMMED, RELAXED, may_wedge, settle
from tpcd.simulator.kernel_slopes import (
    append_part,
    append_theta,
    copy_rows,
    landing_response,
    settling_response,
)
from tpcd.simulator.path import ALMOST
from tpcd.simulator.wedge import LIGHTER

PLAIN, LOOSE, SLIPPING, WEDGED, FRICTIONLESS = 0, 1, 2, 3, 4
"""Attempts at settling (see `wedge`): as it is; what may be wedged or is jammed, without friction;
from there with it again; if that is no better, as it is after all, or what jams without it."""


@njit(nogil=True, error_model="numpy", _nrt=False, forceinline=True)
@no_type_check
def step_element(
    world, o, chains, law, extent, request, b, answer, space, slopes, poses, by_theta, moved
):  # fmt: skip
    """One transition: rest on what was touched, go to the command, follow its path if need be.

    `moved` is the element of `by_theta`.

    Leaves the derivatives by theta, of a given start pose, in `slopes.theta`.
    """
    start, before, command, part = poses[0], poses[1], poses[2], poses[3]
    landing, pose, kept_pose = poses[4], poses[5], poses[6]
    whole, terrains = slopes.whole, world.normals.shape[1]
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
        return
    before[2] = start[2] + wrap(before[2] - start[2])
    command[2] = start[2] + wrap(command[2] - start[2])
    whole[:] = 0.0
    theta, entries = slopes.theta, slopes.theta.shape[0]
    theta[:] = 0.0
    for a in range(3):
        pose[a] = start[a]
        whole[a, a] = 1.0
    touched, status, residual, relaxed = 0, CONVERGED, 0.0, False
    # Run 0 puts the start on what it rests against, run 1 goes straight to the command,
    # runs 2.. follow the command's path where contact has changed, or what is touched turns, and
    # the last one goes straight again where that went worse.
    rested, parts, straight = request.rested, 1, CONVERGED
    run, last = (1 if rested else 0), 1
    if rested:
        touched = touching(world, o, chains, pose)
    while run <= last:
        if run == 1:
            copy_rows(whole, 0, slopes.kept, height)
            copy_rows(theta, 0, slopes.theta_kept, entries)
            for a in range(3):
                kept_pose[a] = pose[a]
            share = 1.0
        elif run == 0:
            share = 0.0
        else:
            share = (run - 1) / parts if parts > 1 else 1.0
        if run == 2 or run > 2 and parts == 1:
            copy_rows(slopes.kept, 0, whole, height)
            copy_rows(slopes.theta_kept, 0, theta, entries)
            for a in range(3):
                pose[a] = kept_pose[a]
            status, residual = CONVERGED, 0.0
        for a in range(3):
            part[a] = before[a] + share * (command[a] - before[a]) if share < 1.0 else command[a]
            start[a] = pose[a]
        follows = 1.0 - share if rested else 0.0
        fraction, point, terrain = first_touch(world, o, chains, start, part)
        for a in range(3):
            landing[a] = start[a] + fraction * (part[a] - start[a])
            pose[a] = landing[a]
        if fraction == 1.0:
            for a in range(3):
                pose[a] = part[a]
                space.chosen[a, 0] = -1
            whole[:], theta[:] = 0.0, 0.0
            for a in range(3):
                whole[a, a] = follows
        else:
            landing_response(world, o, start, part, fraction, point, terrain, slopes)
            attempt, first, most = PLAIN, CONVERGED, np.inf
            while True:
                ended, left = settle(
                    world, o, chains, law, extent, landing, part, space, pose, attempt != SLIPPING
                )
                load = 0.0
                for j in range(3):
                    load += space.multiplier[j]
                if attempt == PLAIN:
                    first, most = ended, load
                    if not may_wedge(world, o, law, space) and ended != RELAXED:
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
            relaxed = attempt == FRICTIONLESS
            if relaxed:
                if ended == RELAXED:
                    status = JAMMED
                    break
                ended = RELAXED
            status, residual = max(status, ended), max(residual, left)
            turn = (math.cos(pose[2]), math.sin(pose[2]))
            linear_system(world, o, law, part, pose, turn, space)
            settling_response(law, terrains, space, slopes)
            append_part(slopes, follows, space.force, space.right)
            append_theta(
                world, o, law, by_theta, moved, (point, terrain), landing, pose, space, slopes
            )
            if relaxed:
                for t in range(terrains):
                    world.friction[o, t] = space.friction[t]
        if run == 0:
            touched, status, residual = _loaded(space), CONVERGED, 0.0
        elif run == 1 and request.substeps > 1:
            now = _loaded(space)
            changed = now != 0 and now != touched
            if request.follow_path or changed and (touched != 0 or now & (now - 1) != 0):
                parts = request.substeps
            if now != 0 or touched != 0:
                turns = abs(command[2] - before[2]) / request.largest_turn
                parts = max(parts, math.ceil(turns - ALMOST))
            if parts > 1:
                straight, last = status, parts + 1
        elif run > 1 and run == last and status > straight:
            parts, straight, last = 1, status, last + 1
        run += 1
    for a in range(3):
        answer.poses[b, a] = pose[a]
    _modes(space, answer.modes, b)
    _contacts(world, o, pose, space, answer.contacts, b)
    if relaxed:
        answer.contacts[b, :, 1] = 0.0
    answer.statuses[b], answer.residuals[b] = status, residual
    copy_rows(whole, 0, answer.from_start[b], 3)
    copy_rows(whole, 3, answer.from_gap[b], terrains)
    copy_rows(whole, 3 + terrains, answer.from_lever[b], terrains)


@njit(_nrt=False)
@no_type_check
def _after(attempt, first, ended, coulomb, lighter):
    """The attempt at settling that follows one that ended so, when the `first` did not satisfy or
    may be wedged; itself where none does."""
    if attempt == PLAIN:
        return LOOSE if coulomb else FRICTIONLESS
    if attempt == LOOSE and ended == CONVERGED:
        return SLIPPING
    taken = attempt == SLIPPING and ended == CONVERGED and (lighter or first != CONVERGED)
    if attempt in (LOOSE, SLIPPING) and not taken:
        return FRICTIONLESS if first == RELAXED else WEDGED
    return attempt


@njit(_nrt=False)
@no_type_check
def _loaded(space):
    """Bit mask of the terrains that carry load."""
    mask = 0
    for j in range(3):
        if space.chosen[j, 0] >= 0:
            mask |= 1 << space.chosen[j, 1]
    return mask


@njit(_nrt=False)
@no_type_check
def _modes(space, modes, b):
    """Contact mode against each terrain, from the row that carries the largest load."""
    for t in range(modes.shape[1]):
        modes[b, t] = 0
        largest = 0.0
        for j in range(3):
            load = space.multiplier[j]
            if space.chosen[j, 0] >= 0 and space.chosen[j, 1] == t and load > largest:
                largest = load
                slip = 2 if space.side[j] < 0.0 else 3
                modes[b, t] = slip if space.slipping[j] else 1


@njit(error_model="numpy", _nrt=False)
@no_type_check
def _contacts(world, o, pose, space, contacts, b):
    """Forces of each terrain and the arm of their point, weighted by load."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    contacts[b] = 0.0
    for j in range(3):
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
