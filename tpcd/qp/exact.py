"""The exact engine: a dual active-set method on whole batches, in plain torch.

D. Goldfarb and A. Idnani, "A numerically stable dual method for solving strictly convex
quadratic programs", Mathematical Programming 27 (1983), on whitened problems (see
whitening.py). From the unconstrained minimum w = 0, repeat: take the most violated row p,
split its gradient g_p into a part in the span of the active rows, N^T r, and the rest z;
move w along z and the multipliers along (-r, 1) until p holds (it joins the active rows)
or a multiplier reaches zero (that row leaves, and p is tried again). If z = 0 and no
multiplier shrinks, the rows contradict each other: a proof of infeasibility. The method
ends after finitely many steps, since the objective grows with each.

The active rows are kept with the dual basis D (D N^T = I), updated by rank-one terms; at
most as many rows are active as there are variables, and only independent ones, so D never
turns singular. All elements of a batch take their step together, with the batch on the
last axis; finished ones are set aside. Sums run in a fixed order and ties go to the
lowest index, so an element's bits do not depend on its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.qp.problem import Status
from tpcd.qp.whitening import WhitenedQP

VIOLATION_TOLERANCE = 1e-13
"""A row counts as violated beyond this times the size of the numbers it is the sum of."""
DEPENDENCE_TOLERANCE = 1e-10
"""A unit row whose rest outside the active span is shorter than this depends on them."""
RATIO_TOLERANCE = 1e-11
"""A multiplier that shrinks more slowly than this does not block; it is rounding."""
COMPACTION = 0.75
"""Finished elements are set aside when at most this fraction is left."""


@dataclass(frozen=True)
class ActiveSet:
    """Where the method ended, in whitened variables (batch last)."""

    motion: Float[Tensor, "k b"]
    """w."""
    multipliers: Float[Tensor, "m b"]
    """Of the unit rows; zero on inactive rows."""
    slots: Int[Tensor, "s b"]
    """Indices of the active rows, -1 in free slots."""
    status: Int[Tensor, " b"]
    iterations: Int[Tensor, " b"]


@dataclass
class _State:
    """What one element carries from step to step; the batch is the last axis of each."""

    offsets: Tensor
    """Offsets plus tolerance; +inf on active rows, so that they are not chosen again."""
    rows: Tensor
    motion: Tensor
    basis: Tensor
    """D, by slot; zero in free slots."""
    active_rows: Tensor
    """N, by slot; zero in free slots."""
    multipliers: Tensor
    """By slot."""
    slots: Tensor
    pending: Tensor
    """The row being added, -1 if none: it stays while blocking rows are dropped."""
    pending_multiplier: Tensor
    element: Tensor


def solve_exact(problem: WhitenedQP, iteration_limit: int | None = None) -> ActiveSet:
    """Solve a batch of whitened problems; statuses SOLVED, INFEASIBLE, ITERATION_LIMIT.

    `iteration_limit` bounds the steps of an element; by default 10 (m + k), which no
    problem that is not broken by rounding comes near. Float64, on any device.
    """
    k, m, count = problem.rows.shape
    limit = 10 * (m + k) if iteration_limit is None else iteration_limit
    state = _start(problem)
    motion = torch.zeros_like(problem.rows[:, 0] if m else problem.rows.new_zeros(k, count))
    slots = torch.full_like(state.slots, -1)
    multipliers = torch.zeros_like(problem.offsets)
    status = state.element.new_full((count,), int(Status.ITERATION_LIMIT))
    iterations = torch.full_like(status, limit)
    if m == 0 or count == 0:
        return ActiveSet(motion, multipliers, slots, torch.zeros_like(status), status * 0)

    finished = torch.zeros_like(state.element, dtype=torch.bool)
    for step in range(limit + 1):
        excess = _dot(state.rows, state.motion) + state.offsets
        excess += VIOLATION_TOLERANCE * _norm(state.motion)
        worst, chosen = _minimum(excess)
        done = ~finished & (worst >= 0) & (state.pending < 0)
        chosen = torch.where(state.pending >= 0, state.pending, chosen)
        status[state.element[done]] = int(Status.SOLVED)
        iterations[state.element[done]] = step
        finished |= done
        remaining = int((~finished).sum())
        if remaining == 0 or step == limit or remaining <= COMPACTION * finished.numel():
            over = finished if step < limit and remaining else torch.ones_like(finished)
            _record(problem, state, over, motion, multipliers, slots)
            if remaining == 0 or step == limit:
                break
            keep = (~finished).nonzero()[:, 0]
            for field in fields(state):
                value = getattr(state, field.name)
                setattr(state, field.name, value.index_select(value.ndim - 1, keep))
            chosen, finished = chosen[keep], finished[keep]
        infeasible = _advance(problem, state, chosen, ~finished)
        status[state.element[infeasible]] = int(Status.INFEASIBLE)
        iterations[state.element[infeasible]] = step + 1
        finished |= infeasible
    return ActiveSet(motion, multipliers, slots, status, iterations)


def optimality_residual(problem: WhitenedQP, answer: ActiveSet) -> Float[Tensor, " b"]:
    """Largest violation of the optimality conditions in whitened variables and unit rows.

    Stationarity |w - rows^T u|, rows max(0, -slack), signs max(0, -u), complementarity
    |u slack|; all but the last in the unit of w [sqrt(J)], the last in its square.
    """
    worst = torch.zeros_like(problem.target[0])
    for i, entry in enumerate(answer.motion):
        if problem.rows.shape[1]:
            entry = entry - _dot(problem.rows[i], answer.multipliers)
        worst = torch.maximum(worst, entry.abs())
    for j, multiplier in enumerate(answer.multipliers):
        slack = _dot(problem.rows[:, j], answer.motion) + problem.offsets[j]
        for violation in (-slack, -multiplier, (slack * multiplier).abs()):
            worst = torch.maximum(worst, violation)
    return worst


def _start(problem: WhitenedQP) -> _State:
    k, m, count = problem.rows.shape
    s = min(k, m)
    zeros = problem.offsets.new_zeros
    element = torch.arange(count, device=problem.rows.device)
    return _State(
        offsets=problem.offsets + VIOLATION_TOLERANCE * problem.magnitudes,
        rows=problem.rows,
        motion=zeros(k, count),
        basis=zeros(s, k, count),
        active_rows=zeros(s, k, count),
        multipliers=zeros(s, count),
        slots=element.new_full((s, count), -1),
        pending=torch.full_like(element, -1),
        pending_multiplier=zeros(count),
        element=element,
    )


def _advance(problem: WhitenedQP, state: _State, chosen: Tensor, live: Tensor) -> Tensor:
    """One step of every live element towards its chosen row; returns the infeasible ones."""
    k, s = state.motion.shape[0], state.slots.shape[0]
    row = state.rows.gather(1, chosen.expand(k, 1, -1))[:, 0]
    offset = problem.offsets[chosen, state.element]
    violation = _dot(row, state.motion) + offset

    share = _dot_basis(state.basis, row)
    rest = _subtract_combination(row, share, state.active_rows)
    # Once more: the rest is now orthogonal to the active rows up to rounding.
    correction = _dot_basis(state.basis, rest)
    share += correction
    rest = _subtract_combination(rest, correction, state.active_rows)
    square = _dot(rest, rest)
    size = 1.0 + _sum(share.abs())
    independent = square > (DEPENDENCE_TOLERANCE * size) ** 2
    if s == k:
        independent &= (state.slots < 0).any(0)

    full_step = torch.where(independent, (-violation).clamp_min(0.0) / square, torch.inf)
    ratio = torch.where(share > RATIO_TOLERANCE, state.multipliers / share, torch.inf)
    partial_step, blocking = _minimum(ratio)
    length = torch.minimum(full_step, partial_step)
    infeasible = live & length.isinf()
    moving = live & ~infeasible
    adding = moving & independent & (full_step <= partial_step)
    length = torch.where(moving, length, 0.0)
    state.motion = state.motion + torch.where(independent, length, 0.0) * rest
    state.multipliers = state.multipliers - length * share
    state.pending_multiplier = state.pending_multiplier + length

    slot = torch.where(adding, (state.slots < 0).to(torch.uint8).argmax(0), blocking)
    leaving = state.basis.gather(0, slot.expand(1, k, -1))[0]
    direction = torch.where(adding, rest / square, leaving)
    overlap = _dot_basis(state.basis, leaving) / _dot(leaving, leaving)
    coefficient = torch.where(moving, torch.where(adding, share, overlap), 0.0)
    left = state.slots.gather(0, slot[None])[0]
    changed = torch.where(adding, chosen, torch.where(moving, left, chosen))[None]
    tolerated = (
        problem.offsets[changed[0], state.element]
        + VIOLATION_TOLERANCE * problem.magnitudes[changed[0], state.element]
    )
    state.offsets.scatter_(0, changed, torch.where(adding, torch.inf, tolerated)[None])

    hot = (torch.arange(s, device=slot.device)[:, None] == slot) & moving
    state.basis = torch.where(
        hot[:, None],
        torch.where(adding, direction, 0.0),
        state.basis - coefficient[:, None] * direction,
    )
    state.active_rows = torch.where(hot[:, None], torch.where(adding, row, 0.0), state.active_rows)
    added = torch.where(adding, state.pending_multiplier, 0.0)
    state.multipliers = torch.where(hot, added, state.multipliers)
    state.slots = torch.where(hot, torch.where(adding, chosen, -1), state.slots)
    state.pending_multiplier = torch.where(adding, 0.0, state.pending_multiplier)
    state.pending = torch.where(moving & ~adding, chosen, -1)
    return infeasible


def _record(
    problem: WhitenedQP,
    state: _State,
    over: Tensor,
    motion: Tensor,
    multipliers: Tensor,
    slots: Tensor,
) -> None:
    """Write the answers of finished elements, solved afresh from their active rows."""
    pick = over.nonzero()[:, 0]
    element, chosen = state.element[pick], state.slots[:, pick]
    basis, active_rows = state.basis[..., pick], state.active_rows[..., pick]
    used = chosen >= 0
    safe = chosen.clamp_min(0)
    wanted = -torch.where(used, problem.offsets[safe, element], 0.0)
    answer = _sum(wanted[:, None] * basis)
    # One refinement step removes what the updates of the basis have accumulated.
    defect = wanted - _dot_basis(active_rows, answer)
    answer = answer + _sum(defect[:, None] * basis)
    forces = _dot_basis(basis, answer).clamp_min(0.0)
    motion[:, element] = answer
    slots[:, element] = chosen
    for i in range(chosen.shape[0]):
        held = used[i]
        multipliers[chosen[i][held], element[held]] = forces[i][held]


def _sum(values: Tensor) -> Tensor:
    """Sum over the first axis, term by term."""
    total = values[0]
    for i in range(1, values.shape[0]):
        total = total + values[i]
    return total


def _dot(left: Tensor, right: Tensor) -> Tensor:
    """Sum over the first axis of left[i] * right[i], term by term."""
    total = left[0] * right[0]
    for i in range(1, left.shape[0]):
        total += left[i] * right[i]
    return total


def _dot_basis(basis: Tensor, vector: Tensor) -> Tensor:
    """Inner product of each slot's vector (`s k b`) with one vector (`k b`)."""
    return _dot(basis.transpose(0, 1), vector)


def _subtract_combination(vector: Tensor, weights: Tensor, slot_vectors: Tensor) -> Tensor:
    for i in range(slot_vectors.shape[0]):
        vector = vector - weights[i] * slot_vectors[i]
    return vector


def _norm(vector: Tensor) -> Tensor:
    return _sum(vector.abs())


def _minimum(values: Tensor) -> tuple[Tensor, Tensor]:
    """Minimum over the first axis and the lowest index that attains it."""
    smallest = values[0]
    index = torch.zeros_like(smallest, dtype=torch.int64)
    for i in range(1, values.shape[0]):
        better = values[i] < smallest
        smallest = torch.where(better, values[i], smallest)
        index = torch.where(better, i, index)
    return smallest, index
