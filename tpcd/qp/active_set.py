"""The dual active-set method for one element, compiled, for compiled callers.

D. Goldfarb and A. Idnani, "A numerically stable dual method for solving strictly convex
quadratic programs", Mathematical Programming 27 (1983), on whitened problems. From the
unconstrained minimum w = 0, repeat: take the most violated row p, split its gradient g_p into a
part in the span of the active rows, N^T r, and the rest z; move w along z and the multipliers
along (-r, 1) until p holds (it joins the active rows) or a multiplier reaches zero (that row
leaves, and p is tried again). If z = 0 and no multiplier shrinks, the rows contradict each other: a
proof of infeasibility. The method ends after finitely many steps, since the objective grows with
each. The active rows are kept with the dual basis D (D N^T = I), updated by rank-one terms; at most
as many rows are active as there are variables, and only independent ones, so D never turns
singular. Ties go to the lowest index. Nothing is allocated inside. Any `numba.njit` function can
call

    status, steps = solve_whitened_3(
        rows, offsets, magnitudes, m, motion, multipliers, slots, work
    )

They work in whitened coordinates with target 0: minimise 1/2 |w|^2 subject to
rows[i]·w + offsets[i] >= 0 for i < m, with the arrays (all float64, C-contiguous)

    rows        (>= m, 3)  in: UNIT rows L^-1 a / length
    offsets     (>= m)     in: whitened offsets, divided by the same length; finite
    magnitudes  (>= m)     in: size of the numbers each offset is the sum of (>= |offset|);
                           1e-13 times it is the violation that is left as rounding
    motion      (3)        out: w
    multipliers (>= m)     out: of the unit rows, zero on inactive rows
    slots       (3) int64  out: indices of the active rows, then -1
    work        (8, 3)     scratch

`status` is an int code of `Status`: SOLVED, INFEASIBLE or ITERATION_LIMIT.

`no_type_check` keeps the tests' import hook, which wraps functions, away from what numba
compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from tpcd.loops import njit
from tpcd.qp.problem import Status

VIOLATION_TOLERANCE = 1e-13
"""A row counts as violated beyond this times the size of the numbers it is the sum of."""
DEPENDENCE_TOLERANCE = 1e-10
"""A unit row whose rest outside the active span is shorter than this depends on them."""
RATIO_TOLERANCE = 1e-11
"""A multiplier that shrinks more slowly than this does not block; it is rounding."""
_SOLVED = int(Status.SOLVED)
_INFEASIBLE = int(Status.INFEASIBLE)
_ITERATION_LIMIT = int(Status.ITERATION_LIMIT)
_SQUARE_TOLERANCE = DEPENDENCE_TOLERANCE**2
_SAFE_SQUARE = 0.25
"""A rest longer than half its unit row has lost no digits and needs no second pass."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def solve_whitened_3(rows, offsets, magnitudes, m, motion, multipliers, slots, work):
    """Solve one whitened problem of 3 variables; arrays as in the file's opening."""
    return solve_rows(
        rows, offsets, magnitudes, m, 3, 3, 10 * (m + 3), motion, multipliers, slots, work
    )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def solve_whitened(rows, offsets, magnitudes, m, n, limit, motion, multipliers, slots, work):
    """Solve one whitened problem of n variables with room for min(n, m) slots.

    As `solve_whitened_3`, with rows (>= m, n), motion (n), slots (min(n, m)) and
    work (len(slots) + 5, n); at most `limit` steps.
    """
    return solve_rows(
        rows, offsets, magnitudes, m, n, len(slots), limit, motion, multipliers, slots, work
    )


@njit(inline="always", error_model="numpy")
@no_type_check
def solve_rows(rows, offsets, magnitudes, m, n, s, limit, motion, multipliers, slots, work):
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
