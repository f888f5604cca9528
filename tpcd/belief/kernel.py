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

from tpcd.simulator.kernel import Answer, Request, prepare, source_stamp, step_element
from tpcd.simulator.kernel_geometry import new_chains
from tpcd.simulator.kernel_settle import RELAXED, new_space
from tpcd.simulator.kernel_slopes import new_slopes

_LOG_2PI = math.log(2.0 * math.pi)


class Measured(NamedTuple):
    """What is known and asked of m particles over n transitions.

    `poses` (n + 1, 3) and their `variance`; values and `slopes` (n, j) of the bumps; `rest`
    (n) what the terms after each one can still add; `least` (m) what must be reached; `sd` (m) of
    the misfit; `limit` of an innovation's square.
    """

    poses: np.ndarray
    variance: np.ndarray
    bumps: np.ndarray
    slopes: np.ndarray
    rest: np.ndarray
    least: np.ndarray
    sd: np.ndarray
    limit: float


class Found(NamedTuple):
    """Where the answers go: log likelihood (m), field mean (m, c) and covariance (m, c, c),
    innovations and the logarithms of their units (m, n, 3) where they are asked for (else m = 0),
    and derivatives (m, d, n, 3) of the innovations by d entries of theta.
    """

    total: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    jammed: np.ndarray
    whitened: np.ndarray
    log_scale: np.ndarray
    slopes: np.ndarray


class Filter(NamedTuple):
    """The state of one particle's filter and what one transition needs; s = c + 3.

    `by_theta` (d, s) are the derivatives of the mean.
    """

    mean: np.ndarray
    covariance: np.ndarray
    design: np.ndarray
    cross: np.ndarray
    factor: np.ndarray
    innovation: np.ndarray
    by_theta: np.ndarray


def _compile_explain_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def explain_range(world, law, request, measured, by_theta, found, first, last):
        if stamp >= 0:
            _explain_range(world, law, request, measured, by_theta, found, first, last)

    return explain_range


@njit(nogil=True, error_model="numpy")
@no_type_check
def _explain_range(world, law, request, measured, by_theta, found, first, last):
    """Evaluate the particles from `first` up to `last`."""
    terrains, count = world.normals.shape[1], world.points.shape[2]
    steps, size = measured.rest.shape[0], found.mean.shape[1]
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
    )
    state = Filter(
        np.zeros(size + 3),
        np.zeros((size + 3, size + 3)),
        np.zeros((3, size + 3)),
        np.zeros((size + 3, 3)),
        np.zeros((3, 3)),
        np.zeros(3),
        np.zeros((entries, size + 3)),
    )
    # Each particle starts its transitions at poses of its own.
    starts = request.starts.copy()
    request = Request(
        request.owner,
        starts,
        request.previous,
        request.commands,
        request.rested,
        request.substeps,
        request.follow_path,
    )
    for i in range(first, last):
        found.total[i] = -np.inf
        if not math.isfinite(measured.sd[i]) or not measured.least[i] < np.inf:
            continue
        extent = prepare(world, i, law, request, 0, steps, chains)
        _begin(state, measured, measured.sd[i])
        total = 0.0
        for k in range(steps):
            for a in range(3):
                starts[k, a] = measured.poses[k, a] - state.mean[size + a]
            step_element(
                world, i, chains, law, extent, request, k, answer, space, slopes, poses, by_theta
            )
            if answer.statuses[k] == RELAXED:
                found.jammed[i] = True
                break
            total += _assimilate(state, measured, answer, k, measured.sd[i])
            if found.whitened.shape[0] > 0 and math.isfinite(total):
                for a in range(3):
                    found.whitened[i, k, a] = state.innovation[a]
                    found.log_scale[i, k, a] = math.log(state.factor[a, a])
                _follow(state, slopes.theta, found.slopes, i, k, size)
            if not (total + measured.rest[k] >= measured.least[i] and math.isfinite(total)):
                total = -np.inf
                break
        if found.jammed[i]:
            continue
        found.total[i] = total
        for a in range(size):
            found.mean[i, a] = state.mean[a]
            for b in range(size):
                found.covariance[i, a, b] = state.covariance[a, b]


@njit(_nrt=False)
@no_type_check
def _begin(state, measured, sd):
    """The state before any transition."""
    width = state.mean.shape[0]
    state.by_theta[:] = 0.0
    for a in range(width):
        state.mean[a] = 0.0
        for b in range(width):
            state.covariance[a, b] = 0.0
        state.covariance[a, a] = sd * sd if a < width - 3 else measured.variance[0, a - width + 3]


@njit(error_model="numpy", _nrt=False)
@no_type_check
def _assimilate(state, measured, answer, k, sd):
    """Filter the residual of transition k; returns its log density, -inf where it has none."""
    mean, covariance, design = state.mean, state.covariance, state.design
    cross, factor, innovation = state.cross, state.factor, state.innovation
    width = mean.shape[0]
    size, variance = width - 3, measured.variance
    total = 0.0
    for a in range(3):
        innovation[a] = measured.poses[k + 1, a] - answer.poses[k, a]
        total += innovation[a]
    if answer.statuses[k] > RELAXED or not math.isfinite(total):
        return -np.inf
    innovation[2] = math.pi - (math.pi - innovation[2]) % (2.0 * math.pi)
    _fill_design(design, measured, answer, k, size)
    for s in range(width):
        for a in range(3):
            value = 0.0
            for r in range(width):
                value += covariance[s, r] * design[a, r]
            cross[s, a] = value
    uncovered = 1.0
    for j in range(measured.bumps.shape[1]):
        uncovered -= measured.bumps[k, j] ** 2
    uncovered = max(uncovered, 0.0) * sd * sd if size > 0 else 0.0
    for a in range(3):
        for r in range(size):
            innovation[a] -= design[a, r] * mean[r]
        for b in range(a + 1):
            value = variance[k + 1, a] if a == b else 0.0
            for t in range(answer.from_gap.shape[1]):
                value += uncovered * answer.from_gap[k, t, a] * answer.from_gap[k, t, b]
            for r in range(width):
                value += design[a, r] * cross[r, b]
            factor[a, b] = value
    log_determinant = _factorise(factor)
    _forward(factor, innovation)
    square = innovation[0] ** 2 + innovation[1] ** 2 + innovation[2] ** 2
    if square > measured.limit:
        # Growing the covariance by a number stretches its factor by the root.
        growth = square / measured.limit
        root = math.sqrt(growth)
        for a in range(3):
            innovation[a] /= root
            for b in range(a + 1):
                factor[a, b] *= root
        log_determinant += 3.0 * math.log(growth)
        square = measured.limit
    _advance(state, variance, k, size)
    return -0.5 * square - 0.5 * log_determinant - 1.5 * _LOG_2PI


@njit(_nrt=False)
@no_type_check
def _fill_design(design, measured, answer, k, size):
    """How the residual of transition k answers the field's coefficients and the start's error."""
    bumps = measured.bumps.shape[1]
    for a in range(3):
        for t in range(answer.from_gap.shape[1]):
            gap, lever = answer.from_gap[k, t, a], answer.from_lever[k, t, a]
            for j in range(bumps):
                design[a, t * bumps + j] = (
                    gap * measured.bumps[k, j] + lever * measured.slopes[k, j]
                )
        for b in range(3):
            design[a, size + b] = -answer.from_start[k, a, b]


@njit(_nrt=False)
@no_type_check
def _advance(state, variance, k, size):
    """The state after a transition, from the whitened innovation and the cross covariance.

    The field goes on; the error of this pose takes the place of the error of the last one.
    """
    mean, covariance, gain = state.mean, state.covariance, state.cross
    for a in range(3):
        mean[size + a] = 0.0
        for r in range(size + 3):
            covariance[size + a, r] = covariance[r, size + a] = 0.0
        for b in range(3):
            gain[size + a, b] = variance[k + 1, a] if a == b else 0.0
        covariance[size + a, size + a] = variance[k + 1, a]
    for r in range(size + 3):
        for a in range(3):
            for b in range(a):
                gain[r, a] -= state.factor[a, b] * gain[r, b]
            gain[r, a] /= state.factor[a, a]
            mean[r] += gain[r, a] * state.innovation[a]
    for r in range(size + 3):
        for s in range(r + 1):
            value = covariance[r, s]
            for a in range(3):
                value -= gain[r, a] * gain[s, a]
            covariance[r, s] = covariance[s, r] = value


@njit(_nrt=False)
@no_type_check
def _follow(state, theta, slopes, i, k, size):
    """Derivatives of the innovation and of the mean by theta, at a fixed gain (Gauss-Newton).

    `theta` are those of the settled pose from a given start; after `_assimilate`.
    """
    by_theta, factor, gain = state.by_theta, state.factor, state.cross
    for e in range(theta.shape[0]):
        for a in range(3):
            value = -theta[e, a]
            for r in range(size + 3):
                value -= state.design[a, r] * by_theta[e, r]
            for b in range(a):
                value -= factor[a, b] * slopes[i, e, k, b]
            slopes[i, e, k, a] = value / factor[a, a]
        for r in range(size + 3):
            value = by_theta[e, r] if r < size else 0.0
            for a in range(3):
                value += gain[r, a] * slopes[i, e, k, a]
            by_theta[e, r] = value


@njit(_nrt=False)
@no_type_check
def _factorise(matrix):
    """Cholesky factor in the lower triangle, in place; returns the log determinant."""
    result = 0.0
    for j in range(3):
        for i in range(j, 3):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[j, j] = math.sqrt(value)
                result += 2.0 * math.log(matrix[j, j])
            else:
                matrix[i, j] = value / matrix[j, j]
    return result


@njit(_nrt=False)
@no_type_check
def _forward(factor, vector):
    """Solve L y = vector in place."""
    for i in range(3):
        value = vector[i]
        for k in range(i):
            value -= factor[i, k] * vector[k]
        vector[i] = value / factor[i, i]


explain_range = _compile_explain_range(source_stamp(sys.modules[__name__]))
"""Evaluate particles `first` up to `last`: (world, law, request, measured, by_theta, found,
first, last).

Fills their part of `found` in place and releases the interpreter lock meanwhile.
"""
