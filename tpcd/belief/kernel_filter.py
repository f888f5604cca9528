"""The filter of one particle in compiled loops: coefficients of the misfit field and the error
of the last reading, a transition at a time.

The formulas of `filter`. Loops run along rows of matrices, so that the compiler can do
several columns at once; columns of terrains that are not touched are zero and passed over.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from tpcd.loops import inner
from tpcd.simulator.rest import RELAXED

_LOG_2PI = math.log(2.0 * math.pi)


@inner(error_model="numpy", forceinline=True)
@no_type_check
def assimilate(state, measured, answer, seen, k, sd):
    """Filter the residual of transition k; returns its log density, -inf where it has none."""
    design, factor, innovation = state.design, state.factor, state.innovation
    size, variance = state.mean.shape[0] - 3, measured.variance
    total = 0.0
    for a in range(3):
        innovation[a] = measured.poses[seen, k + 1, a] - answer.poses[k, a]
        total += innovation[a]
    if answer.statuses[k] > RELAXED or not math.isfinite(total):
        return -np.inf
    innovation[2] = math.pi - (math.pi - innovation[2]) % (2.0 * math.pi)
    # The step was made with the field's gaps; its design tells what it would be without them.
    for t in range(answer.from_gap.shape[1]):
        for a in range(3):
            innovation[a] += answer.from_gap[k, t, a] * state.gap[t]
    _fill_design(design, measured, answer, k, size)
    for a in range(3):
        for b in range(a + 1):
            factor[a, b] = variance[seen, k + 1, a] if a == b else 0.0
    if size > 0:
        _add_uncovered(factor, measured, answer, k, sd)
    _project(state, size)
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
    _advance(state, variance, seen, k, size)
    return -0.5 * square - 0.5 * log_determinant - 1.5 * _LOG_2PI


@inner(forceinline=True)
@no_type_check
def _fill_design(design, measured, answer, k, size):
    """How the residual of transition k answers the field's coefficients and the start's error."""
    bumps = measured.bumps.shape[1]
    for t in range(answer.from_gap.shape[1]):
        for a in range(3):
            gap, lever = answer.from_gap[k, t, a], answer.from_lever[k, t, a]
            for j in range(bumps):
                design[a, t * bumps + j] = (
                    gap * measured.bumps[k, j] + lever * measured.slopes[k, j]
                )
    for a in range(3):
        for b in range(3):
            design[a, size + b] = -answer.from_start[k, a, b]


@inner(forceinline=True)
@no_type_check
def _add_uncovered(factor, measured, answer, k, sd):
    """What the outline's error is besides the bumps is noise, of the gap and of its slope."""
    uncovered = 1.0
    for j in range(measured.bumps.shape[1]):
        uncovered -= measured.bumps[k, j] ** 2
    uncovered = (max(uncovered, 0.0) + measured.grain**2) * sd * sd
    steep = measured.roughness**2 * sd * sd
    gap, lever = answer.from_gap, answer.from_lever
    for t in range(gap.shape[1]):
        for a in range(3):
            for b in range(a + 1):
                factor[a, b] += uncovered * gap[k, t, a] * gap[k, t, b]
                factor[a, b] += steep * lever[k, t, a] * lever[k, t, b]


@inner(forceinline=True)
@no_type_check
def _project(state, size):
    """Covariances of the residual with the state and with itself, and the field taken out of the
    innovation."""
    mean, covariance, design = state.mean, state.covariance, state.design
    cross, factor, innovation = state.cross, state.factor, state.innovation
    width = size + 3
    cross[:] = 0.0
    for r in range(width):
        d0, d1, d2 = design[0, r], design[1, r], design[2, r]
        if d0 == 0.0 and d1 == 0.0 and d2 == 0.0:
            continue
        if r < size:
            innovation[0] -= d0 * mean[r]
            innovation[1] -= d1 * mean[r]
            innovation[2] -= d2 * mean[r]
        for s in range(width):
            cross[0, s] += d0 * covariance[r, s]
            cross[1, s] += d1 * covariance[r, s]
            cross[2, s] += d2 * covariance[r, s]
    for r in range(width):
        for a in range(3):
            for b in range(a + 1):
                factor[a, b] += design[a, r] * cross[b, r]


@inner(forceinline=True)
@no_type_check
def _advance(state, variance, seen, k, size):
    """The state after a transition, from the whitened innovation and the cross covariance.

    The field goes on; the error of this pose takes the place of the error of the last one.
    """
    mean, covariance, gain = state.mean, state.covariance, state.cross
    factor, innovation = state.factor, state.innovation
    width = size + 3
    for a in range(3):
        row = size + a
        mean[row] = 0.0
        for s in range(width):
            covariance[row, s] = covariance[s, row] = 0.0
        for b in range(3):
            gain[b, row] = variance[seen, k + 1, a] if a == b else 0.0
        covariance[row, row] = variance[seen, k + 1, a]
    first, second, third = 1.0 / factor[0, 0], 1.0 / factor[1, 1], 1.0 / factor[2, 2]
    for s in range(width):
        g0 = gain[0, s] * first
        g1 = (gain[1, s] - factor[1, 0] * g0) * second
        g2 = (gain[2, s] - factor[2, 0] * g0 - factor[2, 1] * g1) * third
        gain[0, s], gain[1, s], gain[2, s] = g0, g1, g2
        mean[s] += g0 * innovation[0] + g1 * innovation[1] + g2 * innovation[2]
    for r in range(width):
        g0, g1, g2 = gain[0, r], gain[1, r], gain[2, r]
        if g0 == 0.0 and g1 == 0.0 and g2 == 0.0:
            continue
        for s in range(width):
            covariance[r, s] -= g0 * gain[0, s] + g1 * gain[1, s] + g2 * gain[2, s]


@inner(error_model="numpy")
@no_type_check
def follow(state, theta, slopes, i, k, size):
    """Derivatives of the innovation and of the mean by theta, at a fixed gain (Gauss-Newton).

    `theta` are those of the settled pose from a given start; after `assimilate`.
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
                value += gain[a, r] * slopes[i, e, k, a]
            by_theta[e, r] = value


@inner(error_model="numpy")
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


@inner(error_model="numpy")
@no_type_check
def _forward(factor, vector):
    """Solve L y = vector in place."""
    for i in range(3):
        value = vector[i]
        for k in range(i):
            value -= factor[i, k] * vector[k]
        vector[i] = value / factor[i, i]


@inner
@no_type_check
def by_scene(slopes, by_theta, i, found):
    """Derivatives (d, 3) of a settled pose by the d entries of theta of particle i, whose scene
    moves with them: those by friction, gaps and touched points are strung together."""
    terrains = slopes.land_gap.shape[0]
    for e in range(found.shape[0]):
        for a in range(3):
            value = 0.0
            for t in range(terrains):
                value -= slopes.whole[3 + t, a] * by_theta.offsets[i, e, t]
                value += slopes.further[t, a] * by_theta.friction[i, e, t]
            for s in range(slopes.count[0]):
                p, r = slopes.touched[s, 0], slopes.inputs + 2 * s
                value += slopes.further[r, a] * by_theta.points[i, e, 0, p]
                value += slopes.further[r + 1, a] * by_theta.points[i, e, 1, p]
            found[e, a] = value
