"""The backend `native`: the active-set method over a batch, one element after the other.

Whitening, the dual active-set loop (active_set.py), residual and units in one compiled pass
over the batch; padded rows are skipped. A single thread that releases the interpreter lock.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from torch import Tensor

from tpcd.loops import njit
from tpcd.qp.active_set import solve_rows
from tpcd.qp.problem import ContactQP, QPSolution, Status
from tpcd.qp.whitening import ASYMMETRY_TOLERANCE, PIVOT_TOLERANCE, shared_hessian

_INFEASIBLE = int(Status.INFEASIBLE)
_INVALID = int(Status.INVALID_INPUT)


def solve_native(problem: ContactQP, iteration_limit: int | None = None) -> QPSolution:
    """Solve a checked batch on the CPU; statuses, units and dtype as solve.py promises."""
    n, m, batch = problem.variables, problem.row_count, problem.batch_shape
    count = batch.numel()
    dtype = problem.target.dtype
    hessian = shared_hessian(problem)
    k = n if problem.compliance is None else n + m
    limit = 10 * (m + k) if iteration_limit is None else iteration_limit
    answer = (
        np.empty((count, n)),
        np.zeros((count, m)),
        np.zeros((count, m), np.bool_),
        np.empty(count),
        np.empty(count, np.int64),
        np.empty(count, np.int64),
    )
    arguments = (
        _array(hessian, -1, n, n),
        _array(problem.target, count, n),
        _array(problem.rows, count, m, n),
        _array(problem.offsets, count, m),
        _mask(problem, count, m),
    )
    if n == 3 and problem.compliance is None:
        _solve_batch_3(*arguments, limit, answer)
    else:
        given = problem.compliance
        springs = np.empty((count, 0)) if given is None else _array(given, count, m)
        _solve_batch_n(*arguments, springs, limit, answer)
    motion, multipliers, active, residual, status, iterations = map(torch.from_numpy, answer)
    return QPSolution(
        motion=motion.reshape(*batch, n).to(dtype),
        multipliers=multipliers.reshape(*batch, m).to(dtype),
        active=active.reshape(*batch, m),
        residual=residual.reshape(batch).to(dtype),
        status=status.reshape(batch),
        iterations=iterations.reshape(batch),
    )


def _array(tensor: Tensor, *shape: int) -> np.ndarray:
    """Contiguous float64 view or copy of a tensor."""
    return tensor.detach().reshape(shape).to(torch.float64).contiguous().numpy()


def _mask(problem: ContactQP, count: int, m: int) -> np.ndarray:
    """The row mask, with no columns where every row counts."""
    if problem.row_mask is None:
        return np.empty((count, 0), np.bool_)
    return problem.row_mask.reshape(count, m).contiguous().numpy()


@njit(inline="always", error_model="numpy")
@no_type_check
def _solve_batch(hessian, target, rows, offsets, mask, compliance, limit, n, k, s, yields, answer):
    """Whiten, solve and check one element after the other; `answer` is written in place.

    k = n, or n + m with compliance (`yields`), whose variables are the last m.
    """
    motion, multipliers, active, residual, status, iterations = answer
    count, m = offsets.shape
    factor = np.zeros((n, n))
    inverse = np.empty(n)
    unit = np.zeros((m, k))
    gap = np.empty(m)
    magnitudes = np.empty(m)
    shrinks = np.empty(m)
    whitened = np.empty(k)
    forces = np.empty(m)
    sources = np.empty(m, np.int64)
    slots = np.empty(s, np.int64)
    work = np.empty((s + 5, k))
    definite = False
    for element in range(count):
        if element == 0 or hessian.shape[0] > 1:
            definite = _factorise(hessian[element], n, factor, inverse)
        valid = definite
        for i in range(n):
            valid = valid and np.isfinite(target[element, i])
        kept = 0
        for source in range(m):
            if mask.shape[1] > 0 and not mask[element, source]:
                continue
            row = kept
            sources[row] = source
            kept += 1
            shift = offsets[element, source]
            magnitude = abs(shift)
            square = 0.0
            for i in range(n):
                entry = rows[element, source, i]
                product = entry * target[element, i]
                shift += product
                magnitude += abs(product)
                for j in range(i):
                    entry -= factor[i, j] * unit[row, j]
                entry *= inverse[i]
                unit[row, i] = entry
                square += entry * entry
            if yields:
                spring = compliance[element, source]
                valid = valid and spring >= 0.0
                unit[row, n + row] = np.sqrt(max(spring, 0.0))
                square += spring
            valid = valid and np.isfinite(square) and np.isfinite(magnitude)
            shrink = 1.0 / np.sqrt(square) if square > 0.0 else 1.0
            for i in range(n):
                unit[row, i] *= shrink
            if yields:
                unit[row, n + row] *= shrink
            gap[row] = shift * shrink
            magnitudes[row] = magnitude * shrink
            shrinks[row] = shrink
        code, steps = _INVALID, 0
        if valid:
            code, steps = solve_rows(
                unit, gap, magnitudes, kept, k, s, limit, whitened, forces, slots, work
            )
        iterations[element] = steps
        status[element] = code
        if code in (_INVALID, _INFEASIBLE):
            for i in range(n):
                motion[element, i] = np.nan
            for row in range(m):
                multipliers[element, row] = np.nan
            residual[element] = np.nan
            continue
        worst = 0.0
        for row in range(kept):
            slack = gap[row]
            for i in range(k):
                slack += unit[row, i] * whitened[i]
            worst = max(worst, -slack)
        for a in range(s):
            row = slots[a]
            if row < 0:
                break
            active[element, sources[row]] = True
            multipliers[element, sources[row]] = forces[row] * shrinks[row]
            slack = gap[row]
            for i in range(k):
                slack += unit[row, i] * whitened[i]
            worst = max(worst, abs(slack * forces[row]))
        for i in range(k):
            defect = whitened[i]
            for a in range(s):
                if slots[a] < 0:
                    break
                defect -= forces[slots[a]] * unit[slots[a], i]
            worst = max(worst, abs(defect))
        residual[element] = worst
        for i in range(n - 1, -1, -1):
            entry = whitened[i]
            for j in range(i + 1, n):
                entry -= factor[j, i] * whitened[j]
            whitened[i] = entry * inverse[i]
            motion[element, i] = target[element, i] + whitened[i]


@njit(inline="always", error_model="numpy")
@no_type_check
def _factorise(hessian, n, factor, inverse):
    """Lower Cholesky factor of the symmetric part and 1 / its diagonal; whether it exists."""
    definite = True
    for i in range(n):
        for j in range(i + 1):
            entry = 0.5 * (hessian[i, j] + hessian[j, i])
            if j < i:
                size = np.sqrt(abs(hessian[i, i] * hessian[j, j]))
                if not abs(hessian[i, j] - hessian[j, i]) <= ASYMMETRY_TOLERANCE * size:
                    definite = False
            for k in range(j):
                entry -= factor[i, k] * factor[j, k]
            if j < i:
                factor[i, j] = entry * inverse[j]
            elif entry > PIVOT_TOLERANCE * abs(hessian[i, i]) and np.isfinite(entry):
                factor[i, i] = np.sqrt(entry)
            else:
                definite = False
                factor[i, i] = 1.0
        inverse[i] = 1.0 / factor[i, i]
    return definite


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _solve_batch_3(hessian, target, rows, offsets, mask, limit, answer):
    _solve_batch(hessian, target, rows, offsets, mask, offsets, limit, 3, 3, 3, False, answer)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _solve_batch_n(hessian, target, rows, offsets, mask, compliance, limit, answer):
    n, m = target.shape[1], offsets.shape[1]
    yields = compliance.size > 0
    k = n + m if yields else n
    _solve_batch(
        hessian,
        target,
        rows,
        offsets,
        mask,
        compliance,
        limit,
        n,
        k,
        min(k, m),
        yields,
        answer,
    )
