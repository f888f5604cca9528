"""Exact derivatives of motion and multipliers, of first and second order.

Near a problem whose active rows do not change, motion and multipliers solve a linear
system: with the active rows A, in whitened variables (H = L L^T, G = A L^-T),

    w = G^T lambda,    G w + compliance * lambda = -(A target + b),    v = target + L^-T w.

The solver finds the active rows without autograd; this file solves that system again with
autograd on. Where the active rows change (a row is touched without force) the answer has
a kink and the derivative is the one of the solver's active set. Of duplicate rows only one
is active; the derivative of the sum of their forces, and of the motion, is right as long
as the duplicates move together.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from tpcd.qp.elastic import elastic_compliance
from tpcd.qp.problem import ContactQP, QPSolution, Status


def attach_gradients(
    problem: ContactQP, solution: QPSolution, active: Bool[Tensor, "*batch m"]
) -> QPSolution:
    """The same solution, its motion and multipliers connected to the problem's inputs.

    `active` are its active rows, linearly independent where no compliance makes them so.

    The values stay those of the solver, bit for bit. Elements without an answer
    (INVALID_INPUT, INFEASIBLE) get zero gradients, and so do inactive and padded rows.
    """
    relaxed = solution.status == int(Status.RELAXED)
    answered = (solution.status == int(Status.SOLVED)) | relaxed
    answered = answered | (solution.status == int(Status.ITERATION_LIMIT))
    motion, multipliers = _equality_solution(problem, active, answered, relaxed)
    return replace(
        solution,
        motion=_with_gradient(solution.motion, motion),
        multipliers=_with_gradient(solution.multipliers, multipliers),
    )


def _equality_solution(
    problem: ContactQP, active: Tensor, answered: Tensor, relaxed: Tensor
) -> tuple[Tensor, Tensor]:
    """Motion and multipliers of the active rows as equalities, in float64."""
    n, m, batch = problem.variables, problem.row_count, problem.batch_shape
    eye = torch.eye(n, dtype=torch.float64, device=active.device)
    hessian = problem.hessian.to(torch.float64).expand(*batch, n, n)
    hessian = torch.where(answered[..., None, None], 0.5 * (hessian + hessian.mT), eye)
    target = problem.target.to(torch.float64).where(answered[..., None], 0.0)

    # The active rows, packed into as many slots as the busiest element needs.
    slots = int(active.sum(-1).max()) if active.numel() else 0
    index = (~active).to(torch.uint8).argsort(dim=-1, stable=True)[..., :slots]
    used = active.gather(-1, index)
    rows = problem.rows.gather(-2, index[..., None].expand(*batch, slots, n)).to(torch.float64)
    rows = rows.where(used[..., None], 0.0)
    offsets = problem.offsets.gather(-1, index).to(torch.float64).where(used, 0.0)
    compliance = torch.zeros_like(offsets)
    if problem.compliance is not None:
        compliance = problem.compliance.gather(-1, index).to(torch.float64).where(used, 0.0)
    if bool(relaxed.any()):
        extra = elastic_compliance(hessian, rows)
        compliance = compliance + extra.where(relaxed[..., None] & used, 0.0)

    factor = torch.linalg.cholesky(hessian)
    whitened = torch.linalg.solve_triangular(factor, rows.mT, upper=False).mT
    # Unit rows keep the system well scaled whatever the units; free slots read lambda = 0.
    length = (whitened.detach().square().sum(-1) + compliance.detach()).sqrt()
    length = length.where(used & (length > 0), 1.0)
    whitened = whitened / length[..., None]
    gap = ((rows * target[..., None, :]).sum(-1) + offsets) / length
    dual = torch.diag_embed((compliance / length.square()).where(used, 1.0))
    identity = eye.expand(*batch, n, n)
    upper = torch.cat((identity, -whitened.mT), dim=-1)
    lower = torch.cat((whitened, dual), dim=-1)
    system = torch.cat((upper, lower), dim=-2)
    right = torch.cat((torch.zeros_like(target), -gap), dim=-1)
    answer = torch.linalg.solve(system, right[..., None])[..., 0]
    step = torch.linalg.solve_triangular(factor.mT, answer[..., :n, None], upper=True)[..., 0]
    packed = answer[..., n:] / length
    multipliers = torch.zeros(*batch, m, dtype=packed.dtype, device=packed.device)
    return target + step, multipliers.scatter_add(-1, index, packed.where(used, 0.0))


def _with_gradient(value: Tensor, connected: Tensor) -> Tensor:
    """`value` exactly, with the derivatives of `connected`."""
    connected = connected.to(value.dtype)
    return value + (connected - connected.detach())
