"""Compiled loops of the quasi-static step for half-plane terrains.

The same model as `settle`, `flight` and `implicit`, one transition after the other without
allocation: `kernel_geometry` finds lowest points and first touches, `kernel_settle` the rest
pose, `kernel_slopes` the derivatives, and this file strings the parts of a step together.
Imported only where numba is.

Inner functions run without numba's reference counts (`_nrt=False`): they allocate nothing,
and counting every array they touch took half of the time.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from tpcd.qp import compiled
from tpcd.simulator import kernel_geometry, kernel_settle, kernel_slopes
from tpcd.simulator.kernel_geometry import (
    World,
    build_chains,
    first_touch,
    new_chains,
    touching,
)
from tpcd.simulator.kernel_settle import (
    CONVERGED,
    INVALID,
    JAMMED,
    PROBE,
    RELAXED,
    Law,
    linear_system,
    new_space,
    settle,
)
from tpcd.simulator.kernel_slopes import (
    SceneSlopes,
    append_part,
    append_theta,
    copy_rows,
    landing_response,
    new_slopes,
    settling_response,
)


class Request(NamedTuple):
    """What is asked of b transitions: outline, planes, start pose, command before and command.

    `owner` and `place` (b) say whose points and whose planes of the `World` a transition has.
    `stiffness` is (b or 1, 3). `rested` says that nothing was commanded before, so that
    `previous` equals the start.
    """

    owner: np.ndarray
    place: np.ndarray
    stiffness: np.ndarray
    starts: np.ndarray
    previous: np.ndarray
    commands: np.ndarray
    rested: bool
    substeps: int
    follow_path: bool


class Answer(NamedTuple):
    """Where the answers go; the fields of `Transition` but the wrench.

    `contacts` (b, t, 4) are normal and tangential force, and the arm of the contact point from
    the end effector in world axes.
    """

    poses: np.ndarray
    modes: np.ndarray
    statuses: np.ndarray
    residuals: np.ndarray
    from_start: np.ndarray
    from_gap: np.ndarray
    from_lever: np.ndarray
    contacts: np.ndarray


def source_stamp(*more: ModuleType) -> int:
    """A number for the sources of everything compiled here, and in more modules.

    numba's cache looks only at the file of the function it keeps, so what changes in the
    files it calls must be part of the key, or old code would run.
    """
    digest = hashlib.sha256()
    own = sys.modules[__name__]
    for module in (own, kernel_geometry, kernel_settle, kernel_slopes, compiled, *more):
        digest.update(Path(str(module.__file__)).read_bytes())
    return int.from_bytes(digest.digest()[:6], "big")


def _compile_step_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def step_range(world, law, request, answer, first, last):
        if stamp >= 0:
            _step_range(world, law, request, answer, first, last)

    return step_range


@njit(nogil=True, error_model="numpy")
@no_type_check
def _step_range(world, law, request, answer, first, last):
    """Step the transitions from `first` up to `last`."""
    terrains, count = world.normals.shape[1], world.points.shape[2]
    chains, space = new_chains(terrains, count), new_space(terrains)
    slopes = new_slopes(terrains, 0)
    by_theta = SceneSlopes(
        np.zeros((1, 0, 2, 1)), np.zeros((1, 0, terrains)), np.zeros((1, 0, terrains))
    )
    poses = np.zeros((7, 3))
    normals, offsets, friction = new_planes(terrains)
    law = own_law(law)
    b = first
    while b < last:
        # Transitions of one outline that follow each other share its chains.
        o, end = request.owner[b], b + 1
        while end < last and request.owner[end] == o:
            end += 1
        here = World(world.points[o : o + 1], normals, offsets, friction)
        set_planes(here, world.normals, world.offsets, world.friction, request.place[b])
        extent = prepare(here, 0, law, request, b, end, chains)
        for element in range(b, end):
            set_planes(here, world.normals, world.offsets, world.friction, request.place[element])
            set_stiffness(law, request.stiffness[element if request.stiffness.shape[0] > 1 else 0])
            step_element(
                here, 0, chains, law, extent, request, element, answer, space, slopes, poses,
                by_theta, 0,
            )  # fmt: skip
        b = end


@njit
@no_type_check
def new_planes(terrains):
    """Room for the planes of one transition."""
    return np.zeros((1, terrains, 2)), np.zeros((1, terrains)), np.zeros((1, terrains))


@njit
@no_type_check
def own_law(law):
    """A copy of the law whose stiffness can be set for each transition."""
    return Law(np.ones(3), np.ones(3), law.coulomb, law.rounds, law.tolerance, law.compliance)


@njit(_nrt=False)
@no_type_check
def set_planes(here, normals, offsets, friction, place):
    """Take over the planes at a place of (.., t, 2) and (.., t)."""
    for t in range(here.offsets.shape[1]):
        here.normals[0, t, 0], here.normals[0, t, 1] = normals[place, t, 0], normals[place, t, 1]
        here.offsets[0, t], here.friction[0, t] = offsets[place, t], friction[place, t]


@njit(error_model="numpy")
@no_type_check
def set_stiffness(law, stiffness):
    """Take over a stiffness (3) and its root."""
    for a in range(3):
        law.stiffness[a], law.root[a] = stiffness[a], math.sqrt(stiffness[a])


@njit(_nrt=False)
@no_type_check
def prepare(world, o, law, request, first, last, chains):
    """Chains of a scene for some transitions; returns how far its outline reaches [m]."""
    extent = _reach(world, o)
    if math.isfinite(extent):
        low, high = _angles(request, first, last)
        lean = 0.0 if law.coulomb else _largest(world.friction, o) * (high - low)
        build_chains(world, o, low, high, 2.0 * PROBE + lean, chains)
    return extent


@njit(_nrt=False)
@no_type_check
def _reach(world, o):
    """Distance of the furthest point from the end effector [m]; not finite for a bad outline."""
    largest, total = 0.0, 0.0
    for i in range(world.points.shape[2]):
        square = world.points[o, 0, i] ** 2 + world.points[o, 1, i] ** 2
        total += square
        largest = max(largest, square)
    # A NaN is no maximum, but it spoils the sum.
    return math.sqrt(largest) if math.isfinite(total) else np.nan


@njit(_nrt=False)
@no_type_check
def _sound(world, o, law):
    """Whether planes and stiffness are finite, and the stiffness positive."""
    total = 0.0
    for t in range(world.normals.shape[1]):
        total += abs(world.offsets[o, t]) + abs(world.friction[o, t])
        total += abs(world.normals[o, t, 0]) + abs(world.normals[o, t, 1])
    for a in range(3):
        total += law.root[a] if law.stiffness[a] > 0.0 else np.inf
    return math.isfinite(total)


@njit(_nrt=False)
@no_type_check
def _angles(request, first, last):
    """Least and largest object angle on the straight ways of some transitions [rad]."""
    low, high = np.inf, -np.inf
    for b in range(first, last):
        start = request.starts[b, 2]
        for angle in (
            start,
            start + wrap(request.previous[b, 2] - start),
            start + wrap(request.commands[b, 2] - start),
        ):
            if math.isfinite(angle):
                low, high = min(low, angle), max(high, angle)
    return (low, high) if low <= high else (0.0, 0.0)


@njit(_nrt=False)
@no_type_check
def _largest(values, o):
    largest = 0.0
    for t in range(values.shape[1]):
        largest = max(largest, abs(values[o, t]))
    return largest


@njit(_nrt=False)
@no_type_check
def wrap(angle):
    """The angle wrapped to (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@njit(nogil=True, error_model="numpy", _nrt=False)
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
    finite = math.isfinite(extent) and _sound(world, o, law)
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
    # runs 2.. follow the command's path where contact has changed.
    rested, substeps = request.rested, request.substeps
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
            share = (run - 1) / substeps
        if run == 2:
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
            ended, left = settle(world, o, chains, law, extent, landing, part, space, pose)
            relaxed = ended == RELAXED
            if relaxed:
                for t in range(terrains):
                    space.friction[t], world.friction[o, t] = world.friction[o, t], 0.0
                ended, left = settle(world, o, chains, law, extent, landing, part, space, pose)
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
        elif run == 1 and substeps > 1:
            now = _loaded(space)
            changed = now != 0 and now != touched
            if request.follow_path or changed and (touched != 0 or now & (now - 1) != 0):
                last = substeps + 1
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


step_range = _compile_step_range(source_stamp())
"""Step the transitions `first` up to `last`: (world, law, request, answer, first, last).

Fills their part of the answer in place and releases the interpreter lock meanwhile.
"""
