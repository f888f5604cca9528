"""The contact problem, its answer and its status: what goes in and out of every backend.

A contact problem is a small strictly convex quadratic programme in a motion v (n
variables) with one-sided rows (m of them) and, optionally, a compliance of each row:

    minimise    1/2 (v - target)^T H (v - target) + 1/2 sum_i compliance_i lambda_i^2
    subject to  A v + b + compliance * lambda >= 0,   lambda >= 0,

which has the optimality conditions

    H (v - target) = A^T lambda,
    0 <= lambda  perpendicular to  A v + b + compliance * lambda >= 0.

H is the stiffness, lambda the contact forces in the row directions. Axes: any batch axes
`*batch` in front, then `m` rows, then `n` variables. Nothing here assumes n = 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Status(IntEnum):
    """How one element of the batch ended; `sentence` is what a user reads."""

    sentence: str

    def __new__(cls, code: int, sentence: str) -> Status:
        member = int.__new__(cls, code)
        member._value_ = code
        member.sentence = sentence
        return member

    SOLVED = 0, "Solved: the motion is the unique minimiser."
    RELAXED = (
        1,
        "Infeasible: no motion satisfies all rows, so the rows were given a small compliance "
        "and the motion is the compromise (see tpcd/qp/elastic.py).",
    )
    ITERATION_LIMIT = (
        2,
        "Not solved: the solver stopped at its iteration limit or short of its accuracy; "
        "read the residual before using the motion.",
    )
    INVALID_INPUT = (
        3,
        "Invalid: this element holds a NaN or an infinity, a negative compliance or a hessian "
        "that is not symmetric positive definite; its answer is NaN.",
    )
    INFEASIBLE = (
        4,
        "Infeasible: no motion satisfies all rows and the elastic fallback was switched off; "
        "the answer is NaN.",
    )


REQUIRED = ("hessian", "target", "rows", "offsets")
"""Parts that a problem must have."""


@dataclass(frozen=True)
class ContactQP:
    """A batch of contact problems; see the file's opening for the equations.

    Units for the planar impedance: hessian = stiffness [N/m, N/m, N·m/rad on its
    diagonal], target and motion [m, m, rad], offsets [m] when the rows are gap gradients,
    compliance [m/N]. All tensors share one floating dtype (float32 or float64) and device.
    """

    hessian: Float[Tensor, "*#batch n n"]
    """H, symmetric positive definite; (n, n) when one stiffness serves the whole batch."""
    target: Float[Tensor, "*batch n"]
    """The motion that would be taken without rows."""
    rows: Float[Tensor, "*batch m n"]
    """A, one row for each one-sided condition."""
    offsets: Float[Tensor, "*batch m"]
    """b, the value of each condition at v = 0 (a gap)."""
    compliance: Float[Tensor, "*batch m"] | None = None
    """How far each row yields for a unit multiplier, >= 0; None means that all are rigid."""
    row_mask: Bool[Tensor, "*batch m"] | None = None
    """False marks padding: the row is ignored whatever it holds, NaN included."""

    def to(self, device: str | torch.device) -> ContactQP:
        """The same problems on a device."""
        return replace(self, **_moved(self, device))

    @property
    def batch_shape(self) -> torch.Size:
        """The batch axes."""
        return self.target.shape[:-1]

    @property
    def variables(self) -> int:
        """Number of variables n."""
        return self.target.shape[-1]

    @property
    def row_count(self) -> int:
        """Number of rows m."""
        return self.rows.shape[-2]

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The floating inputs that a gradient can be asked of."""
        given = (self.hessian, self.target, self.rows, self.offsets, self.compliance)
        return tuple(tensor for tensor in given if tensor is not None)


@dataclass(frozen=True)
class QPSolution:
    """The answer for each element of the batch, in the dtype of the problem.

    `multipliers` are zero on inactive rows, non-negative, and satisfy
    H (motion - target) = rows^T multipliers. Where rows are redundant (duplicates, flat
    faces) they are one basic choice, at most n rigid rows at once; the motion is unique.
    """

    motion: Float[Tensor, "*batch n"]
    multipliers: Float[Tensor, "*batch m"]
    active: Bool[Tensor, "*batch m"]
    """The rows that hold with equality and carry the force."""
    residual: Float[Tensor, "*batch"]
    """Largest violation of the optimality conditions, in units in which the hessian is the
    identity and the rows have unit length: stationarity, rows, signs, complementarity."""
    status: Int[Tensor, "*batch"]
    """Codes of `Status`."""
    iterations: Int[Tensor, "*batch"]
    """Steps of the solver: rows added plus rows dropped, or interior-point steps."""

    def to(self, device: str | torch.device) -> QPSolution:
        """The same answers on a device."""
        return replace(self, **_moved(self, device))

    @property
    def solved(self) -> Bool[Tensor, "*batch"]:
        """Where the motion is the minimiser of the problem as it was given."""
        return self.status == int(Status.SOLVED)


def check_problem(problem: ContactQP) -> None:
    """Refuse a problem whose shapes, dtypes or devices do not fit together.

    What depends on the numbers (NaN, an indefinite hessian) is no error but a status of
    the element. Raises TypeError for dtypes, ValueError for shapes and devices.
    """
    for name, value in vars(problem).items():
        if not isinstance(value, Tensor) and (value is not None or name in REQUIRED):
            raise TypeError(f"{name} is a {type(value).__name__}, expected a tensor")
    if problem.target.ndim < 1 or problem.rows.ndim < 2 or problem.hessian.ndim < 2:
        raise ValueError(
            f"target has shape {tuple(problem.target.shape)}, rows {tuple(problem.rows.shape)} and"
            f" hessian {tuple(problem.hessian.shape)}, expected (n), (m, n) and (n, n) at least"
        )
    target, batch = problem.target, problem.batch_shape
    n, m = problem.variables, problem.row_count
    if target.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"target is {target.dtype}, expected float32 or float64")
    if n == 0:
        raise ValueError("target has no variables, expected at least one on its last axis")
    expected = {
        "rows": (*batch, m, n),
        "offsets": (*batch, m),
        "compliance": (*batch, m),
        "row_mask": (*batch, m),
    }
    for name, shape in expected.items():
        tensor = getattr(problem, name)
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
    leading = problem.hessian.shape[:-2]
    if tuple(problem.hessian.shape[-2:]) != (n, n) or not _broadcasts_to(leading, batch):
        raise ValueError(
            f"hessian has shape {tuple(problem.hessian.shape)}, expected {(*batch, n, n)} or {n, n}"
        )
    for tensor in problem.tensors:
        if tensor.dtype != target.dtype:
            raise TypeError(f"all inputs must share one dtype, got {tensor.dtype}, {target.dtype}")
    for tensor in (*problem.tensors, problem.row_mask):
        if tensor is not None and tensor.device != target.device:
            raise ValueError(
                f"all inputs must be on one device, got {tensor.device} and {target.device}"
            )
    if problem.row_mask is not None and problem.row_mask.dtype != torch.bool:
        raise TypeError(f"row_mask is {problem.row_mask.dtype}, expected bool (True = a real row)")


def select(problem: ContactQP, chosen: Bool[Tensor, " b"]) -> ContactQP:
    """The chosen elements of a batch, as a problem with one flat batch axis."""
    n, m, batch = problem.variables, problem.row_count, problem.batch_shape

    def flat(tensor: Tensor | None, *event: int) -> Tensor | None:
        return None if tensor is None else tensor.reshape(-1, *event)[chosen]

    hessian = problem.hessian
    if hessian.ndim > 2:
        hessian = hessian.expand(*batch, n, n).reshape(-1, n, n)[chosen]
    return ContactQP(
        hessian=hessian,
        target=problem.target.reshape(-1, n)[chosen],
        rows=problem.rows.reshape(-1, m, n)[chosen],
        offsets=problem.offsets.reshape(-1, m)[chosen],
        compliance=flat(problem.compliance, m),
        row_mask=flat(problem.row_mask, m),
    )


def _broadcasts_to(shape: torch.Size, batch: torch.Size) -> bool:
    if len(shape) > len(batch):
        return False
    pairs = zip(reversed(shape), reversed(batch), strict=False)
    return all(given in (1, wanted) for given, wanted in pairs)


def _moved(record: ContactQP | QPSolution, device: str | torch.device) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in vars(record).items() if value is not None}
