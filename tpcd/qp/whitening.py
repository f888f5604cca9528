"""Contact problems in whitened variables, where every solver's arithmetic is the same.

With H = L L^T and w = L^T (v - target) the objective is 1/2 |w|^2, a row a becomes
g = L^-1 a and its offset c = a·target + b. Rows are then divided by their length, so that
violations of different rows compare and one tolerance serves all units. A compliance e
is one more variable s of its own for its row: g·w + sqrt(e) s + c >= 0 with 1/2 s^2 added
to the objective; at the optimum s = sqrt(e) lambda. So solvers only ever see rigid rows.

Layout: batch on the LAST axis (`n m b`, `m b`, `b`), float64. All sums run in a fixed
order in elementwise operations, so that an element's bits do not depend on its
neighbours or on the size of the batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.qp.problem import ContactQP

PIVOT_TOLERANCE = 1e-14
"""A pivot below this fraction of its diagonal entry makes the hessian not positive definite."""
ASYMMETRY_TOLERANCE = 1e-4
"""Mirrored entries may differ by this times the root of their diagonal entries; the mean is
used. Loose enough for finite differences in single entries, tight enough for mistakes."""


@dataclass(frozen=True)
class WhitenedQP:
    """Problems of least norm: minimise 1/2 |w|^2 subject to rows·w + offsets >= 0.

    `k` variables: the n of the problem and, with compliance, one more for each row.
    """

    rows: Float[Tensor, "k m b"]
    """Rows of unit length; zero for padding and for rows that were zero."""
    offsets: Float[Tensor, "m b"]
    magnitudes: Float[Tensor, "m b"]
    """Size of the numbers that the offset is the sum of; times eps it is its rounding error."""
    lengths: Float[Tensor, "m b"]
    """What the rows were divided by; multipliers of the problem are `u / lengths`."""
    factor: tuple[tuple[Float[Tensor, "#b"], ...], ...]
    """Lower triangle of L, row by row."""
    target: Float[Tensor, "n b"]
    valid: Bool[Tensor, " b"]
    """False where the element was not a problem; it then holds a harmless one."""

    @property
    def variables(self) -> int:
        """Number of variables n of the problem, without those of the compliance."""
        return len(self.factor)


def whiten(problem: ContactQP) -> WhitenedQP:
    """Whiten a checked problem; its batch axes are flattened into the last axis."""
    n, m = problem.variables, problem.row_count
    with torch.no_grad():
        target = _batch_last(problem.target, 1)
        rows = _batch_last(problem.rows, 2).transpose(0, 1)
        offsets = _batch_last(problem.offsets, 1)
        compliance = None if problem.compliance is None else _batch_last(problem.compliance, 1)
        if problem.row_mask is not None:
            mask = problem.row_mask.reshape(-1, m).T
            rows = rows.where(mask, 0.0)
            offsets = offsets.where(mask, 1.0)
            compliance = None if compliance is None else compliance.where(mask, 0.0)
        hessian = shared_hessian(problem).permute(1, 2, 0).to(torch.float64)
        factor, valid = _cholesky(hessian)
        valid = valid.expand(target.shape[-1]).clone()
        valid &= target.isfinite().all(0)
        if compliance is not None:
            valid &= ((compliance >= 0) & compliance.isfinite()).all(0)

        whitened: list[Tensor] = []
        for i in range(n):
            entry = rows[i]
            for j in range(i):
                if factor[i][j].numel() != 1 or bool(factor[i][j] != 0):
                    entry = entry - factor[i][j] * whitened[j]
            whitened.append(entry / factor[i][i])
        shift, magnitude = offsets.clone(), offsets.abs()
        for i in range(n):
            product = rows[i] * target[i]
            shift += product
            magnitude += product.abs_()
        if compliance is not None:
            spring = compliance.clamp_min(0.0).sqrt()
            own = torch.eye(m, dtype=spring.dtype, device=spring.device)
            whitened.extend(own[i][:, None] * spring for i in range(m))
        stacked = torch.stack(whitened)
        square = torch.zeros_like(shift)
        for entry in whitened:
            square += entry * entry
        if m:  # the largest of all numbers is finite if all are
            valid &= (square + magnitude).amax(0).isfinite()
        length = square.sqrt_()
        length = length.where(length > 0, 1.0)
        if not bool(valid.all()):
            stacked = stacked.where(valid, 0.0)
            shift, magnitude = shift.where(valid, 1.0), magnitude.where(valid, 1.0)
            length, target = length.where(valid, 1.0), target.where(valid, 0.0)
            factor = tuple(
                tuple(entry.where(valid, float(i == j)) for j, entry in enumerate(line))
                for i, line in enumerate(factor)
            )
        return WhitenedQP(
            rows=stacked.div_(length),
            offsets=shift.div_(length),
            magnitudes=magnitude.div_(length),
            lengths=length,
            factor=factor,
            target=target,
            valid=valid,
        )


def unwhiten(problem: WhitenedQP, whitened: Float[Tensor, "n b"]) -> Float[Tensor, "n b"]:
    """The motion v = target + L^-T w."""
    n = problem.variables
    motion: list[Tensor] = [whitened[i] for i in range(n)]
    for i in reversed(range(n)):
        entry = motion[i]
        for j in range(i + 1, n):
            entry = entry - problem.factor[j][i] * motion[j]
        motion[i] = entry / problem.factor[i][i]
    return torch.stack(motion) + problem.target


def _batch_last(tensor: Tensor, event_axes: int) -> Tensor:
    event = tensor.shape[tensor.ndim - event_axes :]
    count = tensor.shape[: tensor.ndim - event_axes].numel()
    flat = tensor.detach().reshape(count, *event)
    order = (*range(1, event_axes + 1), 0)
    return flat.permute(order).to(torch.float64).contiguous()


def shared_hessian(problem: ContactQP) -> Float[Tensor, "h n n"]:
    """The hessians with one flat batch axis; h = 1 where one serves the whole batch."""
    n, hessian = problem.variables, problem.hessian.detach()
    leading = hessian.shape[:-2]
    if leading.numel() == 1:
        return hessian.reshape(1, n, n)
    if leading.numel() and all(stride == 0 for stride in hessian.stride()[:-2]):
        return hessian[(0,) * len(leading)][None]
    count = problem.batch_shape.numel()
    return hessian.expand(*problem.batch_shape, n, n).reshape(count, n, n)


def _cholesky(hessian: Tensor) -> tuple[tuple[tuple[Tensor, ...], ...], Tensor]:
    """Lower factor of the symmetric part and whether it is one; 1 in place of a bad pivot."""
    n = hessian.shape[0]
    valid = hessian.isfinite().all(0).all(0)
    factor: list[tuple[Tensor, ...]] = []
    for i in range(n):
        line: list[Tensor] = []
        for j in range(i + 1):
            entry = 0.5 * (hessian[i, j] + hessian[j, i])
            if j < i:
                size = (hessian[i, i] * hessian[j, j]).abs().sqrt()
                valid = valid & (
                    (hessian[i, j] - hessian[j, i]).abs() <= ASYMMETRY_TOLERANCE * size
                )
            for k in range(j):
                entry = entry - line[k] * (factor[j][k] if j < i else line[k])
            if j < i:
                line.append(entry / factor[j][j])
            else:
                positive = entry > PIVOT_TOLERANCE * hessian[i, i].abs()
                valid = valid & positive
                line.append(entry.where(positive, 1.0).sqrt())
        factor.append(tuple(line))
    return tuple(factor), valid
