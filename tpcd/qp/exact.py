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

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.qp.problem import Status
from tpcd.qp.whitening import WhitenedQP

VIOLATION_TOLERANCE = 1e-13
"""A row counts as violated beyond this times the size of the numbers it is the sum of."""
DEPENDENCE_TOLERANCE = 1e-10
"""A unit row whose rest outside the active span is shorter than this depends on them."""
RATIO_TOLERANCE = 1e-11
"""A multiplier that shrinks more slowly than this does not block; it is rounding."""
COMPACTION = 0.5
"""Finished elements are dropped from the working arrays when at most this fraction is left."""


@dataclass(frozen=True)
class ActiveSet:
    """Where the method ended, in whitened variables (batch last)."""

    motion: Float[Tensor, "k b"]
    """w."""
    multipliers: Float[Tensor, "m b"]
    """Of the unit rows; zero on inactive rows."""
    active: Bool[Tensor, "m b"]
    status: Int[Tensor, " b"]
    iterations: Int[Tensor, " b"]


class _State(NamedTuple):
    """What the elements carry from step to step; the batch is the last axis of each."""

    rows: Tensor
    """Unit rows and, as entry k, their offsets plus tolerance (`k+1 m b`)."""
    motion: Tensor
    """w and, as entry k, 1 (`k+1 b`)."""
    basis: Tensor
    """The dual basis D by slot (`s k b`), zero in free slots."""
    active_rows: Tensor
    """The active rows N by slot (`s k b`), zero in free slots."""
    forces: Tensor
    """Multipliers by slot (`s b`)."""
    slots: Tensor
    """Active row of each slot (`s b`), m where free."""
    pending: Tensor
    """The row being added, m if none: it stays while blocking rows are dropped."""
    pending_force: Tensor
    element: Tensor


def solve_exact(problem: WhitenedQP, iteration_limit: int | None = None) -> ActiveSet:
    """Solve a batch of whitened problems; statuses SOLVED, INFEASIBLE, ITERATION_LIMIT.

    `iteration_limit` bounds the steps of an element; by default 10 (m + k), which no
    problem that is not broken by rounding comes near. Float64, on any device.
    """
    k, m, count = problem.rows.shape
    s = min(k, m)
    limit = 10 * (m + k) if iteration_limit is None else iteration_limit
    basis = problem.offsets.new_zeros(s, k, count)
    slots = torch.full((s, count), m, device=basis.device)
    status = torch.zeros(count, dtype=torch.int64, device=basis.device)
    iterations = torch.zeros_like(status)
    state = _start(problem, slots)
    finished = torch.zeros_like(state.element, dtype=torch.bool)
    status[state.element] = int(Status.ITERATION_LIMIT)
    iterations[state.element] = limit

    for step in range(limit + 1):
        if len(state.element) == 0:
            break
        worst, chosen = _most_violated(state)
        idle = state.pending == m
        chosen = torch.where(idle, chosen, state.pending)
        done = (worst >= 0) & idle & ~finished
        where = state.element[done]
        status[where] = int(Status.SOLVED)
        iterations[where] = step
        recorded = (~finished if step == limit else done).nonzero()[:, 0]
        where = state.element[recorded]
        slots.index_copy_(1, where, state.slots.index_select(1, recorded))
        basis.index_copy_(2, where, state.basis.index_select(2, recorded))
        finished |= done
        keep = (~finished).nonzero()[:, 0]
        if len(keep) == 0 or step == limit:
            break
        if len(keep) <= COMPACTION * len(finished):
            state = _State(*(part.index_select(part.ndim - 1, keep) for part in state))
            chosen, finished = chosen[keep], finished[keep]
        state, contradicted = _advance(state, chosen)
        contradicted &= ~finished
        where = state.element[contradicted]
        status[where] = int(Status.INFEASIBLE)
        iterations[where] = step + 1
        finished |= contradicted
    return _answer(problem, basis, slots, status, iterations)


def optimality_residual(problem: WhitenedQP, answer: ActiveSet) -> Float[Tensor, " b"]:
    """Largest violation of the optimality conditions in whitened variables and unit rows.

    Stationarity |w - rows^T u|, rows max(0, -slack), signs max(0, -u), complementarity
    |u slack|; all but the last in the unit of w [sqrt(J)], the last in its square.
    """
    force = answer.multipliers
    if problem.rows.shape[1] == 0:
        return torch.zeros_like(problem.target[0])
    slack = _dot(problem.rows, answer.motion) + problem.offsets
    pushed = _sum((problem.rows * force).transpose(0, 1))
    parts = (-slack, -force, (slack * force).abs(), (answer.motion - pushed).abs())
    worst = torch.stack([part.amax(0) for part in parts]).amax(0)
    return worst.clamp_min(0.0)


def _start(problem: WhitenedQP, slots: Tensor) -> _State:
    """The state at w = 0 of those elements that have a violated row there."""
    k, m, _ = problem.rows.shape
    tolerated = problem.offsets + VIOLATION_TOLERANCE * problem.magnitudes
    touched = (tolerated < 0).any(0) if m else torch.zeros_like(problem.valid)
    element = touched.nonzero()[:, 0]
    count = len(element)
    zeros = problem.offsets.new_zeros
    rows = problem.rows.new_empty(k + 1, m, count)
    torch.index_select(problem.rows, 2, element, out=rows[:k])
    rows[k] = tolerated.index_select(1, element)
    motion = zeros(k + 1, count)
    motion[k] = 1.0
    return _State(
        rows=rows,
        motion=motion,
        basis=zeros(len(slots), k, count),
        active_rows=zeros(len(slots), k, count),
        forces=zeros(len(slots), count),
        slots=slots.index_select(1, element),
        pending=torch.full_like(element, m),
        pending_force=zeros(count),
        element=element,
    )


def _most_violated(state: _State) -> tuple[Tensor, Tensor]:
    """Value and index of the most violated inactive row, the first of equals."""
    m, count = state.rows.shape[1:]
    rounding = VIOLATION_TOLERANCE * _sum(state.motion[:-1].abs())
    excess = state.motion.new_empty(m + 1, count)
    torch.add(_dot(state.rows, state.motion), rounding, out=excess[:m])
    excess[m] = torch.inf
    excess.scatter_(0, state.slots, torch.inf)
    worst, chosen = excess.min(0)
    return worst, chosen.clamp_max(m - 1)


def _advance(state: _State, chosen: Tensor) -> tuple[_State, Tensor]:
    """One step of every element towards its chosen row, and which ones are infeasible.

    Elements that are finished step on as well; their answers are already recorded.
    """
    (s, k, count), m = state.basis.shape, state.rows.shape[1]
    basis, active_rows = state.basis, state.active_rows
    extended = state.rows.gather(1, chosen.expand(k + 1, 1, count))[:, 0]
    violation = _sum(extended * state.motion)
    row = extended[:k]
    share = _dot_slots(basis, row)
    rest = row - _sum(share[:, None] * active_rows)
    # Once more: the rest is now orthogonal to the active rows up to rounding.
    correction = _dot_slots(basis, rest)
    share = share + correction
    rest = rest - _sum(correction[:, None] * active_rows)
    square = _sum(rest * rest)
    size = 1.0 + _sum(share.abs())
    independent = square > (DEPENDENCE_TOLERANCE * size) ** 2
    highest, free = state.slots.max(0)
    if s == k:
        independent &= highest == m

    full_step = torch.where(independent, (-violation).clamp_min(0.0) / square, torch.inf)
    ratio = torch.where(share > RATIO_TOLERANCE, state.forces / share, torch.inf)
    partial_step, blocking = ratio.min(0)
    length = torch.minimum(full_step, partial_step)
    adding = independent & (full_step <= partial_step)
    motion = state.motion.clone()
    motion[:k] += torch.where(independent, length, 0.0) * rest
    forces = state.forces - length * share
    pending_force = state.pending_force + length

    slot = torch.where(adding, free, blocking)[None]
    place = slot.expand(k, count)[None]
    leaving = basis.gather(0, place)[0]
    overlap = _dot_slots(basis, leaving)
    overlap = overlap / overlap.gather(0, slot)
    direction = torch.where(adding, rest / square, leaving)
    basis = basis - torch.where(adding, share, overlap)[:, None] * direction
    basis.scatter_(0, place, torch.where(adding, direction, 0.0)[None])
    state = _State(
        rows=state.rows,
        motion=motion,
        basis=basis,
        active_rows=active_rows.scatter(0, place, torch.where(adding, row, 0.0)[None]),
        forces=forces.scatter_(0, slot, torch.where(adding, pending_force, 0.0)[None]),
        slots=state.slots.scatter(0, slot, torch.where(adding, chosen, m)[None]),
        pending=torch.where(adding, m, chosen),
        pending_force=torch.where(adding, 0.0, pending_force),
        element=state.element,
    )
    return state, length.isinf()


def _answer(
    problem: WhitenedQP, basis: Tensor, slots: Tensor, status: Tensor, iterations: Tensor
) -> ActiveSet:
    """Motion and multipliers afresh from the active rows, with one refinement step."""
    k, m, count = problem.rows.shape
    padding = problem.rows.new_zeros(k, 1, count)
    rows = torch.cat((problem.rows, padding), dim=1)
    offsets = torch.cat((problem.offsets, padding[0]))
    held = rows.gather(1, slots.expand(k, *slots.shape)).transpose(0, 1)
    wanted = -offsets.gather(0, slots)
    motion = problem.rows.new_zeros(k, count)
    forces = torch.zeros_like(wanted)
    if len(slots):
        motion = _sum(wanted[:, None] * basis)
        defect = wanted - _dot_slots(held, motion)
        motion = motion + _sum(defect[:, None] * basis)
        forces = _dot_slots(basis, motion).clamp_min(0.0)
    multipliers = torch.zeros_like(offsets).scatter_(0, slots, forces)
    active = torch.zeros_like(offsets, dtype=torch.bool).scatter_(0, slots, True)
    return ActiveSet(motion, multipliers[:m], active[:m], status, iterations)


def _sum(values: Tensor) -> Tensor:
    """Sum over the first axis, term by term: the order is the same for every batch."""
    first, *others = values.unbind(0)
    if not others:
        return first
    total = first + others[0]
    for term in others[1:]:
        total += term
    return total


def _dot(left: Tensor, right: Tensor) -> Tensor:
    """Sum over the first axis of left[i] * right[i], without the products' memory at once."""
    pairs = zip(left.unbind(0), right.unbind(0), strict=True)
    first, second = next(pairs)
    total = first * second
    for first, second in pairs:
        total += first * second
    return total


def _dot_slots(slot_vectors: Tensor, vector: Tensor) -> Tensor:
    """Inner product of each slot's vector (`s k b`) with one vector (`k b`)."""
    return _sum((slot_vectors * vector).transpose(0, 1))
