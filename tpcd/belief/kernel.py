"""The history likelihood in compiled loops, one particle after the other.

The same formulas as `kalman` and `likelihood`, with the steps of `tpcd.simulator.kernel`: a
particle steps a transition, filters its residual, and is given up as soon as it cannot reach
its threshold any more. Nothing is allocated for each particle. Imported only where numba is.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from tpcd.belief import kernel_filter
from tpcd.belief.kernel_filter import (
    assimilate,
    begin,
    expect_gap,
    follow,
    new_filter,
    pass_over,
)
from tpcd.simulator.kernel import source_stamp
from tpcd.simulator.kernel_element import step_element
from tpcd.simulator.kernel_geometry import World, new_chains
from tpcd.simulator.kernel_inner import inner
from tpcd.simulator.kernel_request import (
    Answer,
    Request,
    new_planes,
    own_law,
    prepare,
    set_stiffness,
)
from tpcd.simulator.kernel_settle import JAMMED
from tpcd.simulator.kernel_slopes import new_slopes
from tpcd.simulator.kernel_space import new_space


class Measured(NamedTuple):
    """What is known and asked of m particles over n transitions between r = n + 1 rows.

    `poses` (c, r, 3) and their `variance`, the same for all particles (c = 1) or one for each;
    `give` (c, r, 3) is that of `Conditions`. Values and `slopes` (n, j) of the bumps; `rest` (c, n)
    what the terms after each one can still add; `least` (m) what must be reached; `sd` (m) of the
    misfit; `limit` of an innovation's square. `used` (n) says which transitions count: the others
    part the history.
    """

    poses: np.ndarray
    variance: np.ndarray
    give: np.ndarray
    bumps: np.ndarray
    slopes: np.ndarray
    rest: np.ndarray
    least: np.ndarray
    sd: np.ndarray
    used: np.ndarray
    limit: float


class Given(NamedTuple):
    """What the arm is asked and what it meets, for m particles and r rows, or 1 of either.

    `commands` and `stiffness` (.., .., 3); `turns` (.., .., 1) the angle of the object in the
    hand besides its mount; planes `normals` (.., .., t, 2), `offsets`, `friction` (.., .., t).
    """

    commands: np.ndarray
    stiffness: np.ndarray
    turns: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    friction: np.ndarray
    substeps: int
    finest: float
    largest_turn: float
    follow_path: bool


class Found(NamedTuple):
    """Where the answers go: log likelihood (m), field mean (m, c) and covariance (m, c, c),
    innovations and the logarithms of their units (m, n, 3) where they are asked for (else m = 0),
    and derivatives (m, d, n, 3) of the innovations by d entries of theta. `poses` (m, n, 3),
    `modes` (m, n, t) and `contacts` (m, n, t, 4) of the settled steps where they are asked for.
    """

    total: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    jammed: np.ndarray
    whitened: np.ndarray
    log_scale: np.ndarray
    slopes: np.ndarray
    poses: np.ndarray
    modes: np.ndarray
    contacts: np.ndarray


def _compile_explain_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def explain_range(points, law, given, measured, by_theta, found, first, last):
        if stamp >= 0:
            _explain_range(points, law, given, measured, by_theta, found, first, last)

    return explain_range


@njit(inline="always")
@no_type_check
def _explain_range(points, law, given, measured, by_theta, found, first, last):
    """Evaluate the particles from `first` up to `last`; `points` (m, 2, p) are their outlines."""
    terrains, count = given.offsets.shape[2], points.shape[2]
    steps, size = measured.used.shape[0], found.mean.shape[1]
    entries = by_theta.offsets.shape[1]
    chains, space = new_chains(terrains, count), new_space(terrains)
    slopes = new_slopes(terrains, entries)
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
    normals, offsets, friction = new_planes(terrains)
    law = own_law(law)
    for i in range(first, last):
        found.total[i] = -np.inf
        if not math.isfinite(measured.sd[i]) or not measured.least[i] < np.inf:
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
        here = World(points[i : i + 1], normals, offsets, friction)
        _meet(here, given, i, 0)
        extent = prepare(here, 0, law, request, 0, steps, chains)
        begin(state, measured, seen, measured.sd[i])
        total = 0.0
        for k in range(steps):
            if not measured.used[k]:
                pass_over(state, measured, seen, k, size)
                continue
            _meet(here, given, i, k + 1)
            expect_gap(state, measured, k, here.offsets[0])
            set_stiffness(law, given.stiffness[firm, k + 1 if given.stiffness.shape[1] > 1 else 0])
            begins, ends = _turns(given, turned, k)
            for a in range(3):
                starts[k, a] = measured.poses[seen, k, a] - state.mean[size + a]
            starts[k, 2] += begins
            step_element(
                here, 0, chains, law, extent, request, k, answer, space, slopes, poses, by_theta, i
            )
            answer.poses[k, 2] -= ends
            for a in range(3):
                answer.poses[k, a] += measured.give[seen, k + 1, a]
            if answer.statuses[k] == JAMMED:
                found.jammed[i] = True
                break
            if found.poses.shape[0] > 0:
                _keep(found, answer, i, k)
            total += assimilate(state, measured, answer, seen, k, measured.sd[i])
            if found.whitened.shape[0] > 0 and math.isfinite(total):
                for a in range(3):
                    found.whitened[i, k, a] = state.innovation[a]
                    found.log_scale[i, k, a] = math.log(state.factor[a, a])
                follow(state, slopes.theta, found.slopes, i, k, size)
            if not (total + measured.rest[seen, k] >= measured.least[i] and math.isfinite(total)):
                total = -np.inf
                break
        if found.jammed[i]:
            continue
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
def _meet(here, given, i, row):
    """Take over the planes of a particle at a row."""
    each, rows = given.offsets.shape[0] > 1, given.offsets.shape[1] > 1
    p, r = i if each else 0, row if rows else 0
    for t in range(given.offsets.shape[2]):
        here.normals[0, t, 0] = given.normals[p, r, t, 0]
        here.normals[0, t, 1] = given.normals[p, r, t, 1]
        here.offsets[0, t], here.friction[0, t] = given.offsets[p, r, t], given.friction[p, r, t]


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


explain_range = _compile_explain_range(source_stamp(sys.modules[__name__], kernel_filter))
"""Evaluate particles `first` up to `last`: (points, law, given, measured, by_theta, found,
first, last).

Fills their part of `found` in place and releases the interpreter lock meanwhile.
"""
