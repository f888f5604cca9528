"""The native engine: the exact engine's algorithm as a scalar loop compiled by numba.

Same method, same tolerances and same tie-breaking as exact.py (which has the mathematics);
one element after the other, nothing allocated inside. Import this module only where numba
is installed.

For other compiled code, the scalar solvers can be called from any `numba.njit` function:

    normalise_rows(rows, offsets, magnitudes, lengths, m)
    status, iterations = solve_whitened_3(
        rows, offsets, magnitudes, m, motion, multipliers, slots, work
    )
    status, iterations = solve_elastic_3(
        rows, offsets, magnitudes, m, motion, multipliers, slots
    )

They work in whitened coordinates with target 0: minimise 1/2 |w|^2 subject to
rows[i]·w + offsets[i] >= 0 for i < m, with the arrays (all float64, C-contiguous)

    rows        (>= m, 3)  in: UNIT rows L^-1 a / length (`normalise_rows` makes them so)
    offsets     (>= m)     in: whitened offsets, divided by the same length; finite
    magnitudes  (>= m)     in: size of the numbers each offset is the sum of (>= |offset|);
                           1e-13 times it is the violation that is left as rounding
    motion      (3)        out: w
    multipliers (>= m)     out: of the unit rows, zero on inactive rows
    slots       (3) int64  out: indices of the active rows, -1 where free
    work        (8, 3)     scratch

and the answer `status` is an int code of `Status` (SOLVED, INFEASIBLE, ITERATION_LIMIT).
`solve_elastic_3` answers what `solve_whitened_3` found INFEASIBLE (it allocates).
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from torch import Tensor

from tpcd.errors import SolverError
from tpcd.qp.elastic import RELAXATION
from tpcd.qp.exact import DEPENDENCE_TOLERANCE, RATIO_TOLERANCE, VIOLATION_TOLERANCE
from tpcd.qp.problem import ContactQP, QPSolution, Status
from tpcd.qp.whitening import PIVOT_TOLERANCE, shared_hessian


def solve_native(problem: ContactQP, iteration_limit: int | None = None) -> QPSolution:
    """Solve a checked batch on the CPU; statuses, units and dtype as solve.py promises."""
    if problem.target.device.type != "cpu":
        raise SolverError(f"engine native runs on the CPU, not on {problem.target.device}")
    n, m, batch = problem.variables, problem.row_count, problem.batch_shape
    count = batch.numel()
    dtype = problem.target.dtype
    rows, offsets, compliance = problem.rows, problem.offsets, problem.compliance
    if problem.row_mask is not None:
        rows = rows.where(problem.row_mask[..., None], 0.0)
        offsets = offsets.where(problem.row_mask, 1.0)
        compliance = None if compliance is None else compliance.where(problem.row_mask, 0.0)
    hessian = shared_hessian(problem)
    k = n if compliance is None else n + m
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
        torch.finfo(dtype).eps ** 0.5,
        _array(problem.target, count, n),
        _array(rows, count, m, n),
        _array(offsets, count, m),
    )
    if n == 3 and compliance is None:
        _solve_batch_3(*arguments, limit, answer)
    else:
        springs = np.empty((count, 0)) if compliance is None else _array(compliance, count, m)
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


_SOLVED = int(Status.SOLVED)
_INFEASIBLE = int(Status.INFEASIBLE)
_ITERATION_LIMIT = int(Status.ITERATION_LIMIT)
_INVALID = int(Status.INVALID_INPUT)
_SQUARE_TOLERANCE = DEPENDENCE_TOLERANCE**2
_SAFE_SQUARE = 0.25
"""A rest longer than half its unit row has lost no digits and needs no second pass."""


@njit(inline="always", error_model="numpy")
def _solve_rows(rows, offsets, magnitudes, m, n, s, limit, motion, multipliers, slots, work):
    """Dual active set of m unit rows in n variables; see `solve_whitened_3` for the arrays.

    There are s slots, at least min(n, m); the first `used` hold the active rows. `work` is
    (s + 5, n): the dual basis by slot in its first s lines, then share, rest, correction,
    slot multipliers, leaving.
    """
    share, rest, change, force, leaving = s, s + 1, s + 2, s + 3, s + 4
    for i in range(n):
        motion[i] = 0.0
    for row in range(m):
        multipliers[row] = 0.0
    pending = -1
    pending_force = 0.0
    used = 0
    status = _ITERATION_LIMIT
    steps = 0
    while True:
        if pending < 0:
            norm = 0.0
            for i in range(n):
                norm += abs(motion[i])
            worst = 0.0
            for row in range(m):
                excess = offsets[row] + VIOLATION_TOLERANCE * (magnitudes[row] + norm)
                for i in range(n):
                    excess += rows[row, i] * motion[i]
                if excess < worst:
                    taken = False
                    for a in range(used):
                        taken = taken or slots[a] == row
                    if not taken:
                        worst = excess
                        pending = row
            if pending < 0:
                status = _SOLVED
                break
        if steps == limit:
            break
        steps += 1

        # Split the row into a share of the active rows and the rest outside their span.
        violation = offsets[pending]
        square = 0.0
        for i in range(n):
            entry = rows[pending, i]
            violation += entry * motion[i]
            square += entry * entry
            work[rest, i] = entry
        size = 1.0
        if used > 0:
            for a in range(used):
                work[share, a] = 0.0
            for attempt in range(2):
                for a in range(used):
                    part = 0.0
                    for i in range(n):
                        part += work[a, i] * work[rest, i]
                    work[change, a] = part
                    work[share, a] += part
                for a in range(used):
                    part = work[change, a]
                    for i in range(n):
                        work[rest, i] -= part * rows[slots[a], i]
                square = 0.0
                for i in range(n):
                    square += work[rest, i] * work[rest, i]
                if attempt == 0 and square > _SAFE_SQUARE:
                    break
            for a in range(used):
                size += abs(work[share, a])
        independent = used < n and square > _SQUARE_TOLERANCE * size * size

        partial_step = np.inf
        blocking = 0
        for a in range(used):
            if work[share, a] > RATIO_TOLERANCE:
                ratio = work[force, a] / work[share, a]
                if ratio < partial_step:
                    partial_step = ratio
                    blocking = a
        inverse = 1.0 / square if independent else np.inf
        full_step = max(-violation, 0.0) * inverse if independent else np.inf
        length = min(full_step, partial_step)
        if length == np.inf:
            status = _INFEASIBLE
            break
        if independent:
            for i in range(n):
                motion[i] += length * work[rest, i]
        for a in range(used):
            work[force, a] -= length * work[share, a]
        pending_force += length

        if independent and full_step <= partial_step:
            for i in range(n):
                entry = work[rest, i] * inverse
                work[used, i] = entry
                for a in range(used):
                    work[a, i] -= work[share, a] * entry
            slots[used] = pending
            work[force, used] = pending_force
            used += 1
            pending = -1
            pending_force = 0.0
        else:
            square = 0.0
            used -= 1
            for i in range(n):
                entry = work[blocking, i]
                square += entry * entry
                work[leaving, i] = entry
                work[blocking, i] = work[used, i]
            slots[blocking] = slots[used]
            work[force, blocking] = work[force, used]
            for a in range(used):
                part = 0.0
                for i in range(n):
                    part += work[a, i] * work[leaving, i]
                part /= square
                for i in range(n):
                    work[a, i] -= part * work[leaving, i]

    # The answer afresh from the active rows, with one refinement step.
    if used > 0:
        for i in range(n):
            entry = 0.0
            for a in range(used):
                entry -= offsets[slots[a]] * work[a, i]
            motion[i] = entry
        for a in range(used):
            part = -offsets[slots[a]]
            for i in range(n):
                part -= rows[slots[a], i] * motion[i]
            work[change, a] = part
        for a in range(used):
            for i in range(n):
                motion[i] += work[change, a] * work[a, i]
        for a in range(used):
            part = 0.0
            for i in range(n):
                part += work[a, i] * motion[i]
            multipliers[slots[a]] = max(part, 0.0)
    for a in range(used, s):
        slots[a] = -1
    return status, steps


@njit(cache=True, nogil=True, error_model="numpy")
def solve_whitened_3(rows, offsets, magnitudes, m, motion, multipliers, slots, work):
    """Solve one whitened problem of 3 variables; arrays as in the file's opening."""
    return _solve_rows(
        rows, offsets, magnitudes, m, 3, 3, 10 * (m + 3), motion, multipliers, slots, work
    )


@njit(cache=True, nogil=True, error_model="numpy")
def solve_whitened(rows, offsets, magnitudes, m, n, limit, motion, multipliers, slots, work):
    """Solve one whitened problem of n variables with room for min(n, m) slots.

    As `solve_whitened_3`, with rows (>= m, n), motion (n), slots (min(n, m)) and
    work (len(slots) + 5, n); at most `limit` steps.
    """
    return _solve_rows(
        rows, offsets, magnitudes, m, n, len(slots), limit, motion, multipliers, slots, work
    )


@njit(inline="always", error_model="numpy")
def _solve_batch(
    hessian, asymmetry, target, rows, offsets, compliance, limit, n, k, s, yields, answer
):
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
    slots = np.empty(s, np.int64)
    work = np.empty((s + 5, k))
    definite = False
    for element in range(count):
        if element == 0 or hessian.shape[0] > 1:
            definite = _factorise(hessian[element], n, asymmetry, factor, inverse)
        valid = definite
        for i in range(n):
            valid = valid and np.isfinite(target[element, i])
        for row in range(m):
            shift = offsets[element, row]
            magnitude = abs(shift)
            square = 0.0
            for i in range(n):
                product = rows[element, row, i] * target[element, i]
                shift += product
                magnitude += abs(product)
                entry = rows[element, row, i]
                for j in range(i):
                    entry -= factor[i, j] * unit[row, j]
                entry *= inverse[i]
                unit[row, i] = entry
                square += entry * entry
            if yields:
                spring = compliance[element, row]
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
            code, steps = _solve_rows(
                unit, gap, magnitudes, m, k, s, limit, whitened, forces, slots, work
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
        for row in range(m):
            slack = gap[row]
            for i in range(k):
                slack += unit[row, i] * whitened[i]
            worst = max(worst, -slack)
        for a in range(s):
            row = slots[a]
            if row < 0:
                break
            active[element, row] = True
            multipliers[element, row] = forces[row] * shrinks[row]
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
def _factorise(hessian, n, asymmetry, factor, inverse):
    """Lower Cholesky factor of the symmetric part and 1 / its diagonal; whether it exists."""
    definite = True
    for i in range(n):
        for j in range(i + 1):
            entry = 0.5 * (hessian[i, j] + hessian[j, i])
            if j < i:
                size = np.sqrt(abs(hessian[i, i] * hessian[j, j]))
                if not abs(hessian[i, j] - hessian[j, i]) <= asymmetry * size:
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
def _solve_batch_3(hessian, asymmetry, target, rows, offsets, limit, answer):
    _solve_batch(hessian, asymmetry, target, rows, offsets, offsets, limit, 3, 3, 3, False, answer)


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_batch_n(hessian, asymmetry, target, rows, offsets, compliance, limit, answer):
    n, m = target.shape[1], offsets.shape[1]
    yields = compliance.size > 0
    k = n + m if yields else n
    _solve_batch(
        hessian,
        asymmetry,
        target,
        rows,
        offsets,
        compliance,
        limit,
        n,
        k,
        min(k, m),
        yields,
        answer,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def normalise_rows(rows, offsets, magnitudes, lengths, m):
    """Divide m whitened rows, offsets and magnitudes by the rows' lengths, in place."""
    n = rows.shape[1]
    for row in range(m):
        square = 0.0
        for i in range(n):
            square += rows[row, i] * rows[row, i]
        length = np.sqrt(square)
        if not length > 0.0:
            length = 1.0
        lengths[row] = length
        offsets[row] /= length
        magnitudes[row] /= length
        for i in range(n):
            rows[row, i] /= length


@njit(cache=True, nogil=True, error_model="numpy")
def solve_elastic_3(rows, offsets, magnitudes, m, motion, multipliers, slots):
    """Answer one infeasible whitened problem by the elastic fallback of elastic.py.

    Arrays as for `solve_whitened_3`; `slots` gets up to 3 of the active rows (more may be
    active: those with a positive multiplier). Allocates, since it is rare.
    """
    n = 3 + m
    spring = np.sqrt(RELAXATION)
    length = np.sqrt(1.0 + RELAXATION)
    wide_rows = np.zeros((m, n))
    wide_offsets = np.empty(m)
    wide_magnitudes = np.empty(m)
    for row in range(m):
        for i in range(3):
            wide_rows[row, i] = rows[row, i] / length
        wide_rows[row, 3 + row] = spring / length
        wide_offsets[row] = offsets[row] / length
        wide_magnitudes[row] = magnitudes[row] / length
    wide_motion = np.empty(n)
    wide_slots = np.empty(m, np.int64)
    work = np.empty((m + 5, n))
    status, steps = solve_whitened(
        wide_rows,
        wide_offsets,
        wide_magnitudes,
        m,
        n,
        10 * (m + n),
        wide_motion,
        multipliers,
        wide_slots,
        work,
    )
    for i in range(3):
        motion[i] = wide_motion[i]
    for a in range(slots.shape[0]):
        slots[a] = wide_slots[a] if a < m else -1
    for row in range(m):
        multipliers[row] /= length
    return status, steps
