"""The public door of the contact problems: check once, choose an engine, fill the answer.

Engines find active sets; everything that all of them share is here: statuses, the elastic
fallback, the residual, units, and the gradients of differentiate.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tpcd.errors import SolverError
from tpcd.loops import available
from tpcd.qp.differentiate import attach_gradients
from tpcd.qp.elastic import relax
from tpcd.qp.exact import ActiveSet, optimality_residual, solve_exact
from tpcd.qp.problem import ContactQP, QPSolution, Status, check_problem, select
from tpcd.qp.whitening import WhitenedQP, unwhiten, whiten

ENGINES: tuple[str, ...] = ("auto", "exact", "native", "qpth")


def solve(
    problem: ContactQP,
    engine: str = "auto",
    *,
    elastic: bool = True,
    iteration_limit: int | None = None,
) -> QPSolution:
    """Solve every contact problem of the batch.

    `engine`: `exact` (plain torch, any device), `native` (the same compiled by numba, CPU),
    `qpth` (interior point of the qpth package, about 0.1 N accurate), or `auto`: `native`
    on the CPU where numba is installed and no gradient is asked, else `exact`. All compute
    in float64 and answer in the problem's dtype. Motion and multipliers are differentiable
    (twice) with respect to every floating input, whatever the engine.

    Infeasible elements are answered by the elastic fallback (status RELAXED), or by NaN
    with status INFEASIBLE where `elastic` is False. Elements with NaN or without a
    positive definite hessian are answered by NaN (status INVALID_INPUT). No element
    affects another. `iteration_limit` bounds the steps of one element.

    Raises ValueError or TypeError where shapes, dtypes or devices do not fit, and
    SolverError where the engine is not installed.
    """
    if not isinstance(problem, ContactQP):
        raise TypeError(f"problem is a {type(problem).__name__}, expected a ContactQP")
    check_problem(problem)
    if engine not in ENGINES:
        raise ValueError(f"engine is {engine!r}, expected one of {', '.join(ENGINES)}")
    wants_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in problem.tensors)
    if engine == "auto":
        on_cpu = problem.target.device.type == "cpu"
        native = on_cpu and not wants_gradient and native_available()
        engine = "native" if native else "exact"
    with torch.no_grad():
        solution = _solve_flat(problem, engine, iteration_limit)
        if elastic:
            solution = _answer_infeasible(problem, solution, engine, iteration_limit)
    if not wants_gradient:
        return solution
    active = solution.active
    if engine == "qpth":
        from tpcd.qp.qpth_engine import independent_rows

        active = independent_rows(problem, solution)
    return attach_gradients(problem, solution, active)


def native_available() -> bool:
    """Whether the engine `native` can be used: numba is installed."""
    return available()


def _solve_flat(problem: ContactQP, engine: str, iteration_limit: int | None) -> QPSolution:
    if engine == "native":
        if not native_available():
            raise SolverError("engine native needs numba: pip install 'tpcd[fast]', or use exact")
        from tpcd.qp.native import solve_native

        return solve_native(problem, iteration_limit)
    whitened = whiten(problem)
    if engine == "qpth":
        from tpcd.qp.qpth_engine import solve_qpth

        answer = solve_qpth(whitened)
    else:
        answer = solve_exact(whitened, iteration_limit)
    return _assemble(problem, whitened, answer)


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


def _answer_infeasible(
    problem: ContactQP, solution: QPSolution, engine: str, iteration_limit: int | None
) -> QPSolution:
    """Replace the answers of infeasible elements by those of their elastic problems."""
    infeasible = (solution.status == int(Status.INFEASIBLE)).reshape(-1)
    if not bool(infeasible.any()):
        return solution
    relaxed = _solve_flat(relax(select(problem, infeasible)), engine, iteration_limit)
    solved = relaxed.status == int(Status.SOLVED)
    status = torch.where(solved, int(Status.RELAXED), relaxed.status)

    def merged(name: str, update: Tensor) -> Tensor:
        whole = getattr(solution, name)
        event = update.shape[1:]
        flat = whole.reshape(-1, *event).clone()
        flat[infeasible] = update
        return flat.reshape(whole.shape)

    return QPSolution(
        motion=merged("motion", relaxed.motion),
        multipliers=merged("multipliers", relaxed.multipliers),
        active=merged("active", relaxed.active),
        residual=merged("residual", relaxed.residual),
        status=merged("status", status),
        iterations=merged("iterations", relaxed.iterations),
    )
