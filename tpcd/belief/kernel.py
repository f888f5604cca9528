"""The history likelihood in compiled loops, one particle after the other.

A particle steps a transition, filters its residual as `filter` says, and is given up as soon as it
cannot reach its threshold any more. Nothing is allocated for each particle.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import no_type_check

import numpy as np

from tpcd.belief import kernel_filter, kernel_given, kernel_state
from tpcd.belief.kernel_filter import assimilate, by_scene, follow
from tpcd.belief.kernel_given import PASSES
from tpcd.belief.kernel_state import (
    begin,
    copy_state,
    expect_gap,
    is_explained,
    new_filter,
    pass_over,
)
from tpcd.geometry.candidates import World, frame, nearest, new_chains
from tpcd.geometry.query import meet, own_surfaces
from tpcd.loops import inner, njit
from tpcd.simulator.batch import source_stamp
from tpcd.simulator.element import step_element
from tpcd.simulator.request import (
    Answer,
    Request,
    new_planes,
    own_law,
    prepare,
    set_stiffness,
)
from tpcd.simulator.rest import WANTED
from tpcd.simulator.tangents import BY_SCENE, NOTHING_MORE, new_slopes
from tpcd.simulator.workspace import begin_recall, end_recall, new_space


def _compile_explain_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def explain_range(points, law, given, measured, by_theta, found, tape, which, first, last):
        if stamp >= 0:
            _explain_range(points, law, given, measured, by_theta, found, tape, which, first, last)

    return explain_range


@njit(inline="always")
@no_type_check
def _explain_range(points, law, given, measured, by_theta, found, tape, which, first, last):
    """Evaluate the particles in `which` from `first` up to `last`; `points` (m, 2, p) are the
    outlines of all."""
    terrains, count = given.friction.shape[2], points.shape[2]
    steps, size = measured.used.shape[0], found.mean.shape[1]
    entries = by_theta.offsets.shape[1]
    chains, space = new_chains(terrains, count), new_space(terrains, law.room, tape.motion.shape[1])
    slopes = new_slopes(terrains, count, BY_SCENE if entries else NOTHING_MORE, law.room)
    theta = np.zeros((entries, 3))
    poses = np.zeros((7, 3))
    answer = Answer(
        np.zeros((steps, 3)),
        np.zeros((steps, terrains), np.int64),
        np.zeros(steps, np.int64),
        np.zeros(steps),
        np.zeros((steps, 3, 3)),
        np.zeros((steps, terrains, 3)),
        np.zeros((steps, terrains, 3)),
        np.zeros((steps, terrains, 4)),
        np.zeros((steps, 0, 3)),
        np.zeros((steps, 0, 2, 3)),
    )
    state = new_filter(size, entries, terrains)
    # Each particle starts its transitions at poses of its own.
    starts, previous, commands = (
        np.zeros((steps, 3)), np.zeros((steps, 3)), np.zeros((steps, 3))
    )  # fmt: skip
    request = Request(
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
        np.ones((1, 3)),
        starts,
        previous,
        commands,
        False,
        given.substeps,
        given.finest,
        given.largest_turn,
        given.follow_path,
    )
    where, clearance, friction, compliance = new_planes(terrains)
    here = World(
        np.zeros((1, 2, count)),
        own_surfaces(given.surfaces),
        where,
        clearance,
        friction,
        compliance,
    )
    law = own_law(law)
    for i in which[first:last]:
        if not begin_recall(space, tape, i):
            continue
        found.total[i] = -np.inf
        if not math.isfinite(measured.sd[i]) or not measured.least[i] < np.inf:
            end_recall(space, tape, i)
            continue
        seen = i if measured.poses.shape[0] > 1 else 0
        asked = i if given.commands.shape[0] > 1 else 0
        turned = i if given.turns.shape[0] > 1 else 0
        firm = i if given.stiffness.shape[0] > 1 else 0
        for k in range(steps):
            begins, ends = _turns(given, turned, k)
            for a in range(3):
                starts[k, a] = measured.poses[seen, k, a]
                previous[k, a] = given.commands[asked, k, a]
                commands[k, a] = given.commands[asked, k + 1, a]
                if math.isfinite(measured.give[seen, k + 1, a]):
                    commands[k, a] -= measured.give[seen, k + 1, a]
            starts[k, 2] += begins
            previous[k, 2] += begins
            commands[k, 2] += ends
        _hold(here, points, given, i, 0)
        _meet(here, given, i, 0)
        extent = prepare(here, 0, law, request, 0, steps, chains)
        begin(state, measured, seen, measured.sd[i])
        total, term = 0.0, 0.0
        for k in range(steps):
            if not measured.used[k]:
                pass_over(state, measured, seen, k, size)
                continue
            set_stiffness(law, given.stiffness[firm, k + 1 if given.stiffness.shape[1] > 1 else 0])
            begins, ends = _turns(given, turned, k)
            for a in range(3):
                starts[k, a] = measured.poses[seen, k, a] - state.mean[size + a]
            starts[k, 2] += begins
            expect_gap(state, measured, k)
            copy_state(state.mean, state.covariance, state.mean_before, state.covariance_before)
            for t in range(terrains):
                state.gap_before[t] = state.gap[t]
            explained, stopped, first_term = False, False, 0.0
            if given.warp.shape[3] > 0:
                _hold(here, points, given, i, k + 1)
                extent = prepare(here, 0, law, request, k, k + 1, chains)
            for again in range(PASSES):
                _meet(here, given, i, k + 1)
                for t in range(terrains):
                    here.clearance[0, t] = state.gap[t]
                step_element(here, 0, chains, law, extent, request, k, answer, space, slopes, poses)
                if answer.statuses[k] == WANTED:
                    break
                answer.poses[k, 2] -= ends
                for a in range(3):
                    answer.poses[k, a] += measured.give[seen, k + 1, a]
                term = assimilate(state, measured, answer, seen, k, measured.sd[i])
                if again == 0 and math.isfinite(term):
                    explained, first_term = is_explained(state, measured), term
                    far = expect_gap(state, measured, k) > measured.far
                    stopped = not explained and _stop(
                        here, chains, answer, measured, seen, k, ends, state
                    )
                    if not far and not stopped:
                        break
                elif again == 1 and (
                    (explained and not is_explained(state, measured))
                    or (stopped and not term > first_term)
                ):
                    for t in range(terrains):
                        state.gap[t] = state.gap_before[t]
                else:
                    break
                copy_state(state.mean_before, state.covariance_before, state.mean, state.covariance)
            if answer.statuses[k] == WANTED:
                break
            if found.poses.shape[0] > 0:
                _keep(found, answer, i, k)
            total += term
            if found.whitened.shape[0] > 0 and math.isfinite(total):
                for a in range(3):
                    found.whitened[i, k, a] = state.innovation[a]
                    found.log_scale[i, k, a] = math.log(state.factor[a, a])
                by_scene(slopes, by_theta, i, theta)
                follow(state, theta, found.slopes, i, k, size)
            if not (total + measured.rest[seen, k] >= measured.least[i] and math.isfinite(total)):
                total = -np.inf
                break
        end_recall(space, tape, i)
        found.total[i] = total
        for a in range(size):
            found.mean[i, a] = state.mean[a]
            for b in range(size):
                found.covariance[i, a, b] = state.covariance[a, b]


@inner
@no_type_check
def _turns(given, i, k):
    """The angle of the object in the hand at the start and at the end of transition k."""
    if given.turns.shape[1] > 1:
        return given.turns[i, k, 0], given.turns[i, k + 1, 0]
    return given.turns[i, 0, 0], given.turns[i, 0, 0]


@inner
@no_type_check
def _hold(here, points, given, i, row):
    """Take over the outline of a particle as it is at a row."""
    for a in range(2):
        for j in range(points.shape[2]):
            here.points[0, a, j] = points[i, a, j]
    if given.warp.shape[3] > 0:
        p = i if given.warp.shape[0] > 1 else 0
        r = row if given.warp.shape[1] > 1 else 0
        for a in range(2):
            for j in range(points.shape[2]):
                here.points[0, a, j] += given.warp[p, r, a, j]


@inner
@no_type_check
def _meet(here, given, i, row):
    """Take over the surfaces of a particle at a row, where theta has them."""
    each, rows = given.friction.shape[0] > 1, given.friction.shape[1]
    p, r = i if each else 0, row if rows > 1 else 0
    meet(here.surfaces, given.surfaces, here.where, p * rows + r)
    for t in range(given.friction.shape[2]):
        here.clearance[0, t] = 0.0
        here.friction[0, t] = given.friction[p, r, t]
        here.compliance[0, t] = given.compliance[p, r, t]


@inner
@no_type_check
def _stop(here, chains, answer, measured, seen, k, ends, state):
    """Let terrains that were not touched, but before which the object was held back, be touched at
    the pose that was read; whether there are any."""
    found = False
    angle = measured.poses[seen, k + 1, 2] + ends - measured.give[seen, k + 1, 2]
    x = measured.poses[seen, k + 1, 0] - measured.give[seen, k + 1, 0]
    z = measured.poses[seen, k + 1, 1] - measured.give[seen, k + 1, 1]
    turn = (math.cos(angle), math.sin(angle))
    for t in range(answer.modes.shape[1]):
        gap, p = nearest(here, 0, chains, t, (x, z), turn)
        _, u, v, _, _, _ = frame(
            here, 0, t, here.points[0, 0, p], here.points[0, 1, p], (x, z), turn
        )
        held = u * (measured.poses[seen, k + 1, 0] - answer.poses[k, 0])
        held += v * (measured.poses[seen, k + 1, 1] - answer.poses[k, 1])
        if answer.modes[k, t] != 0 or not held > measured.far:
            continue
        gap -= state.gap_before[t]
        if gap > -state.gap[t]:
            state.gap[t] = -gap
            found = True
    return found


@inner
@no_type_check
def _keep(found, answer, i, k):
    """Keep how the step of transition k settled."""
    for a in range(3):
        found.poses[i, k, a] = answer.poses[k, a]
    for t in range(answer.modes.shape[1]):
        found.modes[i, k, t] = answer.modes[k, t]
        for a in range(4):
            found.contacts[i, k, t, a] = answer.contacts[k, t, a]


explain_range = _compile_explain_range(
    source_stamp(sys.modules[__name__], kernel_filter, kernel_given, kernel_state)
)
"""Evaluate the particles `which[first:last]`: (points, law, given, measured, by_theta, found,
tape, which, first, last).

Fills their part of `found` in place and releases the interpreter lock meanwhile.
"""
