"""The likelihood of a history in compiled loops, one particle after the other.

The same formulas as `likelihood`, without a temporary in memory: a settled pose answers the
misfit field through two vectors for each terrain, gap g and lever l, so that the 3 x c rows
H are g b^T + l s^T with the values b and slopes s of the bumps, and every product with H
splits into products of 3-vectors and of bumps. Imported only where numba is.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

_LOG_2PI = math.log(2.0 * math.pi)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def evaluate_range(
    poses,
    statuses,
    from_start,
    from_gap,
    from_lever,
    settled,
    settled_variance,
    start_variance,
    values,
    slopes,
    sd,
    limit,
    worst_status,
    first,
    last,
    total,
    before,
    means,
    precisions,
):
    """Fill log likelihoods (m) and the field's posterior mean (m, c) and precision (m, c, c).

    Only particles `first` up to `last` are evaluated, so that threads can share the work.
    Model answers are (m, n, ...), measurements (n, 3), bumps (n, j); c = terrains x j.
    """
    steps = statuses.shape[1]
    terrains, bumps = from_gap.shape[2], values.shape[1]
    size = terrains * bumps
    covariance, marginal = np.empty((3, 3)), np.empty((3, 3))
    error, gap, lever = np.empty(3), np.empty((terrains, 3)), np.empty((terrains, 3))
    vector, factor, solved = np.empty(size), np.empty((size, size)), np.empty(size)
    for i in range(first, last):
        precision = precisions[i]
        precision[:] = 0.0
        vector[:] = 0.0
        for a in range(size):
            precision[a, a] = 1.0 / sd**2
        whole = 0.0
        before[i] = 0.0
        for k in range(steps):
            if k == steps - 1 and k > 0:
                before[i] = whole + _gain(precision, vector, factor, solved, sd)
            usable = statuses[i, k] <= worst_status
            for a in range(3):
                error[a] = settled[k, a] - poses[i, k, a]
                usable = usable and math.isfinite(error[a])
            if not usable:
                whole = -np.inf
                continue
            error[2] = math.pi - (math.pi - error[2]) % (2.0 * math.pi)
            _covariances(
                from_start[i, k],
                from_gap[i, k],
                from_lever[i, k],
                settled_variance[k],
                start_variance[k],
                values[k],
                slopes[k],
                sd,
                covariance,
                marginal,
            )
            _grow(covariance, marginal, error, limit)
            log_determinant = _factorise(covariance)
            _forward(covariance, error)
            square = error[0] ** 2 + error[1] ** 2 + error[2] ** 2
            whole += -0.5 * square - 0.5 * log_determinant - 1.5 * _LOG_2PI
            if size:
                for t in range(terrains):
                    for a in range(3):
                        gap[t, a] = from_gap[i, k, t, a]
                        lever[t, a] = from_lever[i, k, t, a]
                    _forward(covariance, gap[t])
                    _forward(covariance, lever[t])
                _accumulate(precision, vector, gap, lever, error, values[k], slopes[k])
        if math.isfinite(whole):
            total[i] = whole + _gain(precision, vector, factor, solved, sd)
        else:
            total[i] = -np.inf
        if not math.isfinite(before[i]):
            before[i] = -np.inf
        for a in range(size):
            means[i, a] = solved[a] if math.isfinite(whole) else 0.0


@njit(cache=True)
@no_type_check
def _covariances(
    from_start,
    from_gap,
    from_lever,
    settled_variance,
    start_variance,
    values,
    slopes,
    sd,
    covariance,
    marginal,
):
    """S of one transition without the field, and with it."""
    vv = vs = ss = 0.0
    for j in range(values.shape[0]):
        vv += values[j] * values[j]
        vs += values[j] * slopes[j]
        ss += slopes[j] * slopes[j]
    uncovered = max(0.0, 1.0 - vv) * sd * sd
    for a in range(3):
        for b in range(3):
            own = settled_variance[a] if a == b else 0.0
            for k in range(3):
                own += from_start[a, k] * from_start[b, k] * start_variance[k]
            field = 0.0
            for t in range(from_gap.shape[0]):
                ga, gb, la, lb = from_gap[t, a], from_gap[t, b], from_lever[t, a], from_lever[t, b]
                own += uncovered * ga * gb
                field += vv * ga * gb + vs * (ga * lb + la * gb) + ss * la * lb
            covariance[a, b] = own
            marginal[a, b] = own + sd * sd * field


@njit(cache=True)
@no_type_check
def _grow(covariance, marginal, error, limit):
    """Add to S what puts an unexplained residual at the limit."""
    factor, whitened = marginal.copy(), error.copy()
    _factorise(factor)
    _forward(factor, whitened)
    square = whitened[0] ** 2 + whitened[1] ** 2 + whitened[2] ** 2
    if square > limit:
        for a in range(3):
            for b in range(3):
                covariance[a, b] += (square / limit - 1.0) * marginal[a, b]


@njit(cache=True)
@no_type_check
def _factorise(matrix):
    """Cholesky factor in the lower triangle, in place; returns the log determinant."""
    result = 0.0
    for j in range(matrix.shape[0]):
        for i in range(j, matrix.shape[0]):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[j, j] = math.sqrt(value)
                result += 2.0 * math.log(matrix[j, j])
            else:
                matrix[i, j] = value / matrix[j, j]
    return result


@njit(cache=True)
@no_type_check
def _forward(factor, vector):
    """Solve L y = vector in place."""
    for i in range(vector.shape[0]):
        value = vector[i]
        for k in range(i):
            value -= factor[i, k] * vector[k]
        vector[i] = value / factor[i, i]


@njit(cache=True)
@no_type_check
def _accumulate(precision, vector, gap, lever, error, values, slopes):
    """Add H^T S^-1 H and H^T S^-1 r of one transition, from whitened vectors."""
    terrains, bumps = gap.shape[0], values.shape[0]
    for t in range(terrains):
        touched = gap[t, 0] != 0.0 or gap[t, 1] != 0.0 or gap[t, 2] != 0.0
        if not touched:
            continue
        by_gap = by_lever = 0.0
        for a in range(3):
            by_gap += gap[t, a] * error[a]
            by_lever += lever[t, a] * error[a]
        for j in range(bumps):
            vector[t * bumps + j] += by_gap * values[j] + by_lever * slopes[j]
        for u in range(terrains):
            gg = gl = lg = ll = 0.0
            for a in range(3):
                gg += gap[t, a] * gap[u, a]
                gl += gap[t, a] * lever[u, a]
                lg += lever[t, a] * gap[u, a]
                ll += lever[t, a] * lever[u, a]
            for j in range(bumps):
                first = gg * values[j] + lg * slopes[j]
                second = gl * values[j] + ll * slopes[j]
                for k in range(bumps):
                    precision[t * bumps + j, u * bumps + k] += (
                        first * values[k] + second * slopes[k]
                    )


@njit(cache=True)
@no_type_check
def _gain(precision, vector, factor, solved, sd):
    """Log of the field's integral, 1/2 v^T A^-1 v - 1/2 log |sd^2 A|; `solved` becomes A^-1 v."""
    size = vector.shape[0]
    if size == 0:
        return 0.0
    factor[:], solved[:] = precision, vector
    log_determinant = _factorise(factor)
    _forward(factor, solved)
    square = 0.0
    for a in range(size):
        square += solved[a] * solved[a]
    for i in range(size - 1, -1, -1):
        value = solved[i]
        for k in range(i + 1, size):
            value -= factor[k, i] * solved[k]
        solved[i] = value / factor[i, i]
    return 0.5 * square - 0.5 * log_determinant - size * math.log(sd)
