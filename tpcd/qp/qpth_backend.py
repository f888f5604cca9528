"""The backend `qpth`: the interior point method of the optional package qpth, with care.

B. Amos and J. Z. Kolter, "OptNet: Differentiable Optimization as a Layer in Neural
Networks", ICML 2017. It is here to compare with and for users who have qpth elsewhere.
What measurements asked for: float64 always; rows whitened and of unit length, each problem
scaled to offsets of about 1; padding by far rows of unit length, since rows of zeros make
answers silently wrong; multipliers taken from the solver (its public function drops them);
answers checked, since it reports no failures; and the inaccurate ones solved again without
the others, since it stops for a whole batch at once (after which one in a thousand random
contact problems is still short, by up to 0.15 N). For that reason, unlike with
`native`, neighbours do affect an element below `ACCURACY`.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from importlib.util import find_spec

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.errors import SolverError
from tpcd.qp.problem import ContactQP, QPSolution, Status
from tpcd.qp.whitening import WhitenedQP, unwhiten, whiten

FAR = 3.0
"""Offset of padded rows, in units of the problem's largest offset."""
ACCURACY = 1e-6
"""Largest residual, in units of the problem's largest offset, that is reported as SOLVED."""
ROUNDS = 4
"""How often the inaccurate elements are solved again, each time without the accurate."""
DEPENDENT = 1e-3
"""A unit row is made up of others where they leave no more of it than this length."""
STEPS = 20
"""qpth's own limit of steps in one round; it stops earlier when three brought nothing."""


@dataclass(frozen=True)
class ActiveSet:
    """Where a solver ended, in whitened variables (batch last)."""

    motion: Float[Tensor, "k b"]
    """w."""
    multipliers: Float[Tensor, "m b"]
    """Of the unit rows; zero on inactive rows."""
    active: Bool[Tensor, "m b"]
    status: Int[Tensor, " b"]
    iterations: Int[Tensor, " b"]


def solve_qpth(problem: ContactQP) -> QPSolution:
    """Solve a checked batch on its device; statuses, units and dtype as solve.py promises.

    Raises SolverError where qpth is not installed.
    """
    if find_spec("qpth") is None:
        told = "qpth is not installed: pip install 'tpcd[qpth]', or use the backend native"
        raise SolverError(told)
    whitened = whiten(problem)
    return _assemble(problem, whitened, solve_whitened(whitened))


def _assemble(problem: ContactQP, whitened: WhitenedQP, answer: ActiveSet) -> QPSolution:
    """Back to the problem's variables, units, layout and dtype; statuses and residual."""
    batch, dtype = problem.batch_shape, problem.target.dtype
    n, m = problem.variables, problem.row_count
    valid = whitened.valid
    motion = unwhiten(whitened, answer.motion[:n])
    nan = float("nan")
    status = torch.where(valid, answer.status, int(Status.INVALID_INPUT))
    answered = valid & (status != int(Status.INFEASIBLE))
    active = answer.active & answered
    multipliers = answer.multipliers / whitened.lengths
    return QPSolution(
        motion=motion.where(answered, nan).T.reshape(*batch, n).to(dtype),
        multipliers=multipliers.where(answered, nan).T.reshape(*batch, m).to(dtype),
        active=active.T.reshape(*batch, m),
        residual=optimality_residual(whitened, answer)
        .where(answered, nan)
        .reshape(batch)
        .to(dtype),
        status=status.reshape(batch),
        iterations=answer.iterations.reshape(batch),
    )


def solve_whitened(problem: WhitenedQP) -> ActiveSet:
    """Solve a batch of whitened problems by qpth.

    Rows count as active where their multiplier exceeds their slack. Statuses: SOLVED;
    INFEASIBLE where rows stay violated under growing multipliers; ITERATION_LIMIT where
    the answer is short of `ACCURACY`. `iterations` holds the limit of the rounds used.
    """
    k, m, count = problem.rows.shape
    motion = problem.rows.new_zeros(k, count)
    force = torch.zeros_like(problem.offsets)
    steps = torch.zeros(count, dtype=torch.int64, device=motion.device)
    if m == 0 or count == 0:
        return ActiveSet(motion, force, force > 0, steps, steps.clone())

    empty = (problem.rows == 0).all(0)
    size = problem.magnitudes.where(~empty, 0.0).amax(0)
    size = size.where(size > 0, 1.0)
    rows = problem.rows.clone()
    rows[0] = rows[0].where(~empty, 1.0)
    offsets = (problem.offsets / size).where(~empty, FAR)
    active = torch.zeros_like(empty)
    residual = torch.full_like(size, torch.inf)
    pick = torch.arange(count, device=rows.device)
    for _ in range(ROUNDS):
        w, u, slack = _interior_point(rows[..., pick], offsets[:, pick])
        touching = (u > slack) & ~empty[:, pick]
        u = u.where(touching, 0.0)
        found = (_residual(rows[..., pick], offsets[:, pick], w, u)).nan_to_num(nan=torch.inf)
        better = found < residual[pick]
        to = pick[better]
        motion[:, to], force[:, to], active[:, to] = w[:, better], u[:, better], touching[:, better]
        residual[to] = found[better]
        steps[pick] += STEPS
        pick = (residual > ACCURACY).nonzero()[:, 0]
        if len(pick) == 0:
            break
    slack = (rows * motion[:, None]).sum(0) + offsets
    violation = (-slack).where(~empty, 0.0).amax(0)
    # A row without direction has no say in the motion; it can only be violated.
    impossible = (empty & (problem.offsets < 0)).any(0)
    impossible |= (violation > 1e2 * ACCURACY) & (force.amax(0) > 1e2)
    status = torch.where(residual <= ACCURACY, int(Status.SOLVED), int(Status.ITERATION_LIMIT))
    status = torch.where(impossible, int(Status.INFEASIBLE), status)
    return ActiveSet(motion * size, force * size, active, status, steps)


def independent_rows(problem: ContactQP, solution: QPSolution) -> Bool[Tensor, "*batch m"]:
    """Active rows of an answer without those that others make up; large forces come first.

    Duplicates share a force here, so that more rows are active than the motion has directions.
    Rows with a compliance and elements with the elastic fallback keep all: springs make them
    independent.
    """
    whitened = whiten(problem)
    shape = problem.batch_shape.numel(), problem.row_count
    active = solution.active.reshape(shape).T
    force = solution.multipliers.reshape(shape).T * whitened.lengths
    left = whitened.rows.where(active, 0.0)
    chosen = torch.zeros_like(active)
    for _ in range(min(left.shape[:2])):
        length = left.square().sum(0).sqrt()
        size, best = force.where(length > DEPENDENT, 0.0).max(0)
        best = best[None]
        chosen |= torch.zeros_like(chosen).scatter(0, best, (size > 0)[None])
        unit = left.take_along_dim(best[None], 1) / length.gather(0, best).clamp_min(DEPENDENT)
        left = left - unit * (unit * left).sum(0)
    chosen = chosen.T.reshape(solution.active.shape)
    springs = (solution.status == int(Status.RELAXED))[..., None]
    if problem.compliance is not None:
        springs = springs | (problem.compliance > 0)
    return torch.where(springs, solution.active, chosen)


def optimality_residual(problem: WhitenedQP, answer: ActiveSet) -> Float[Tensor, " b"]:
    """Largest violation of the optimality conditions in whitened variables and unit rows.

    Stationarity |w - rows^T u|, rows max(0, -slack), signs max(0, -u), complementarity
    |u slack|; all but the last in the unit of w [sqrt(J)], the last in its square.
    """
    force = answer.multipliers
    if problem.rows.shape[1] == 0:
        return torch.zeros_like(problem.target[0])
    slack = (problem.rows * answer.motion[:, None]).sum(0) + problem.offsets
    pushed = (problem.rows * force).sum(1)
    parts = (-slack, -force, (slack * force).abs(), (answer.motion - pushed).abs())
    worst = torch.stack([part.amax(0) for part in parts]).amax(0)
    return worst.clamp_min(0.0)


def _residual(rows: Tensor, offsets: Tensor, motion: Tensor, force: Tensor) -> Tensor:
    """Largest violation of the optimality conditions of scaled problems."""
    slack = (rows * motion[:, None]).sum(0) + offsets
    pushed = (rows * force).sum(1)
    parts = (-slack, -force, (slack * force).abs(), (motion - pushed).abs())
    return torch.stack([part.amax(0) for part in parts]).amax(0)


def _interior_point(rows: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """qpth's solver on: minimise 1/2 |w|^2 subject to -rows·w <= offsets; batch last."""
    from qpth.solvers.pdipm import batch as interior_point

    count = rows.shape[-1]
    # A batch of one loses an axis inside qpth, so it travels with a copy of itself.
    pick = torch.arange(max(count, 2), device=rows.device).clamp_max(count - 1)
    bounds = -rows.permute(2, 1, 0)[pick].contiguous()
    limits = offsets.T[pick].contiguous()
    k = bounds.shape[-1]
    identity = torch.eye(k, dtype=rows.dtype, device=rows.device).repeat(len(pick), 1, 1)
    linear = rows.new_zeros(len(pick), k)
    none = rows.new_zeros(0)
    with contextlib.redirect_stdout(io.StringIO()):
        factors = interior_point.pre_factor_kkt(identity, bounds, none)
        motion, _, force, slack = interior_point.forward(
            identity, linear, bounds, limits, none, none, *factors, verbose=-1, maxIter=STEPS
        )
    return motion[:count].T, force[:count].T, slack[:count].T
