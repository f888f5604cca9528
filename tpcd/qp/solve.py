"""The public door of the contact problems: check once, choose a backend, fill the answer.

Backends find active sets; everything that all of them share is here: statuses, the elastic
fallback, the residual, units, and the gradients of derivative.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tpcd.qp.derivative import attach_gradients
from tpcd.qp.elastic import relax
from tpcd.qp.problem import ContactQP, QPSolution, Status, check_problem, select

BACKENDS: tuple[str, ...] = ("native", "qpth")


def solve(
    problem: ContactQP,
    backend: str = "native",
    *,
    elastic: bool = True,
    iteration_limit: int | None = None,
) -> QPSolution:
    """Solve every contact problem of the batch.

    `backend`: `native` (the dual active-set method in compiled loops, on the CPU, whatever the
    device of the problem) or `qpth` (interior point of the qpth package, about 0.1 N accurate, on
    the problem's device). Both compute in float64 and answer in the problem's dtype. Motion and
    multipliers are differentiable (twice) with respect to every floating input.

    Infeasible elements are answered by the elastic fallback (status RELAXED), or by NaN
    with status INFEASIBLE where `elastic` is False. Elements with NaN or without a
    positive definite hessian are answered by NaN (status INVALID_INPUT). No element
    affects another. `iteration_limit` bounds the steps of one element.

    Raises ValueError or TypeError where shapes, dtypes or devices do not fit, and
    SolverError where the backend is not installed.
    """
    if not isinstance(problem, ContactQP):
        raise TypeError(f"problem is a {type(problem).__name__}, expected a ContactQP")
    check_problem(problem)
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}, expected one of {', '.join(BACKENDS)}")
    wants_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in problem.tensors)
    device = problem.target.device
    with torch.no_grad():
        given = problem.to("cpu") if backend == "native" and device.type != "cpu" else problem
        solution = _solve_flat(given, backend, iteration_limit)
        if elastic:
            solution = _answer_infeasible(given, solution, backend, iteration_limit)
        solution = solution.to(device)
    if not wants_gradient:
        return solution
    active = solution.active
    if backend == "qpth":
        from tpcd.qp.qpth_backend import independent_rows

        active = independent_rows(problem, solution)
    return attach_gradients(problem, solution, active)


def _solve_flat(problem: ContactQP, backend: str, iteration_limit: int | None) -> QPSolution:
    if backend == "native":
        from tpcd.qp.batch import solve_native

        return solve_native(problem, iteration_limit)
    if backend == "qpth":
        from tpcd.qp.qpth_backend import solve_qpth

        return solve_qpth(problem)
    raise AssertionError(f"{backend} is in BACKENDS, and nothing solves it")


def _answer_infeasible(
    problem: ContactQP, solution: QPSolution, backend: str, iteration_limit: int | None
) -> QPSolution:
    """Replace the answers of infeasible elements by those of their elastic problems."""
    infeasible = (solution.status == int(Status.INFEASIBLE)).reshape(-1)
    if not bool(infeasible.any()):
        return solution
    relaxed = _solve_flat(relax(select(problem, infeasible)), backend, iteration_limit)
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
