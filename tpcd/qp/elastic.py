"""The answer to an infeasible contact problem: rows that yield a little.

Rows can contradict each other, as when floor and wall jam an object that penetrates both
with friction >= 1. No motion is then admissible; the fallback minimises the same
objective plus a quadratic penalty on slacks s of the rows,

    1/2 (v - target)^T H (v - target) + 1/2 sum_i s_i^2 / c_i   s. t.  A v + b + s >= 0,

whose dual is the given problem with compliance c_i (added to the row's own, if it has
one). The weight is c_i = RELAXATION * a_i^T H^-1 a_i: each row becomes a spring 1/RELAXATION
times stiffer than the impedance along that row, whatever the units. The relaxed problem is
strictly convex and always feasible, so its answer is finite, unique and continuous in the
data; as RELAXATION goes to zero the motion tends to the one of least squared violation.
The multipliers are large (violation / c_i) and mean only 'badly jammed'.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.qp.problem import ContactQP

RELAXATION = 1e-4
"""Compliance of a row of an infeasible problem, as a fraction of the impedance's own."""


def elastic_compliance(
    hessian: Float[Tensor, "*#batch n n"], rows: Float[Tensor, "*batch m n"]
) -> Float[Tensor, "*batch m"]:
    """The compliance c = RELAXATION * a^T H^-1 a of each row; of zero rows, RELAXATION."""
    factor = torch.linalg.cholesky(0.5 * (hessian + hessian.mT))
    whitened = torch.linalg.solve_triangular(factor, rows.mT, upper=False)
    square = whitened.square().sum(-2)
    return RELAXATION * torch.where(square > 0, square, 1.0)


def relax(problem: ContactQP) -> ContactQP:
    """The elastic problem of a (valid) contact problem; see the file's opening."""
    rows = problem.rows
    if problem.row_mask is not None:
        rows = rows.where(problem.row_mask[..., None], 0.0)
    compliance = elastic_compliance(problem.hessian, rows)
    if problem.compliance is not None:
        own = problem.compliance
        if problem.row_mask is not None:
            own = own.where(problem.row_mask, 0.0)
        compliance = compliance + own
    return replace(problem, compliance=compliance)
