"""The solvers that the contact QP benchmark compares, each behind the same call.

A solver takes a `ContactQP` (float64) and returns the motions it found and which elements
it claims to have solved. Loops over single problems leave padded rows out; batch solvers
get them as they need them. Optional packages are imported inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np
import torch

from tpcd.qp import ContactQP, solve

FAR = 10.0
"""Offset of the unit rows that pad problems for plain qpth [m]; of 0.003 to 1000 m the one
with the fewest wrong answers at 16 rows."""
TIGHT = 1e-12
"""Tolerance of the reference solver, in whitened units [sqrt(J)]."""

Answer = tuple[np.ndarray, np.ndarray]
"""Motions (b, n) and whether each is claimed to be solved (b)."""


@dataclass(frozen=True)
class Solver:
    """One line of the benchmark's table."""

    name: str
    run: Callable[[ContactQP], Answer]
    repeats: int = 1
    """How often it is timed; the fastest counts."""
    share: float = 1.0
    """Share of the problems it gets, where all would take too long; its time is scaled up."""


def available_solvers() -> list[Solver]:
    """What can run here, fastest last."""
    solvers = []
    if find_spec("qpth"):
        solvers.append(Solver("qpth", _backend("qpth")))
        solvers.append(Solver("qpth plain", solve_by_qpth))
    if find_spec("osqp"):
        solvers.append(Solver("osqp", solve_by_osqp))
    if find_spec("daqp"):
        solvers.append(Solver("daqp", solve_by_daqp))
    if find_spec("qpsolvers"):
        import qpsolvers

        for name in sorted(set(qpsolvers.dense_solvers + qpsolvers.sparse_solvers)):
            if name not in ("osqp", "daqp"):
                solvers.append(Solver(name, _through_qpsolvers(name), share=0.02))
    solvers.append(Solver("native", _backend("native"), repeats=20))
    return solvers


def reference_forces(problem: ContactQP) -> tuple[np.ndarray, str]:
    """Exact generalised forces (b, n), NaN where infeasible, and where they come from.

    DAQP on whitened problems at a tight tolerance; where it is not installed, the native
    backend, whose residual then stands in the table's place of an independent check.
    """
    if find_spec("daqp") is None:
        answer = solve(problem, elastic=False)
        step = (answer.motion - problem.target)[..., None]
        return (problem.hessian @ step)[..., 0].numpy(), "native (DAQP is not installed)"
    import daqp

    forces = np.full(problem.target.shape, np.nan)
    n = problem.variables
    for i, (hessian, target, rows, offsets) in enumerate(_single_problems(problem)):
        factor = np.linalg.cholesky(hessian)
        whitened = np.linalg.solve(factor, rows.T).T
        lengths = np.linalg.norm(whitened, axis=1)
        limits = -(rows @ target + offsets) / lengths
        unit = np.ascontiguousarray(whitened / lengths[:, None])
        motion, _, flag, _ = daqp.solve(
            np.eye(n),
            np.zeros(n),
            unit,
            np.full(len(limits), 1e30),
            limits,
            np.zeros(len(limits), dtype=np.int32),
            primal_tol=TIGHT,
        )
        if flag == 1:
            forces[i] = factor @ motion
    return forces, f"DAQP at tolerance {TIGHT:g}"


def solve_by_qpth(problem: ContactQP) -> Answer:
    """qpth's public function, one call in float64, padded by far unit rows; claims all.

    It stops for the whole batch as soon as one problem's factorisation fails, as exact
    duplicates make it do, so its time says little where its answers are wrong.
    """
    from qpth.qp import QPFunction

    mask = problem.row_mask
    far = torch.zeros_like(problem.rows)
    far[..., 0] = 1.0
    rows = problem.rows if mask is None else problem.rows.where(mask[..., None], far)
    offsets = problem.offsets if mask is None else problem.offsets.where(mask, FAR)
    linear = -(problem.hessian @ problem.target[..., None])[..., 0]
    none = problem.target.new_zeros(0)
    function = QPFunction(verbose=-1, check_Q_spd=False)
    motion = function(problem.hessian, linear, -rows, offsets, none, none)
    return motion.numpy(), np.ones(len(motion), dtype=bool)


def solve_by_osqp(problem: ContactQP) -> Answer:
    """OSQP in a loop that keeps its workspace and updates the numbers."""
    import osqp
    from scipy import sparse

    n, m = problem.variables, problem.row_count
    motions = np.empty(problem.target.shape)
    solved = np.zeros(len(motions), dtype=bool)
    hessian = problem.hessian.expand(len(motions), n, n).numpy()
    mask = torch.ones_like(problem.offsets, dtype=torch.bool)
    mask = mask if problem.row_mask is None else problem.row_mask
    rows = problem.rows.numpy()
    limits = torch.where(mask, -problem.offsets, -np.inf).numpy()
    linear = -(problem.hessian @ problem.target[..., None])[..., 0].numpy()
    solver = osqp.OSQP()
    upper = np.full(m, np.inf)
    # Explicit ones keep the pattern dense, so that every later update fits.
    pattern = sparse.csc_matrix(np.ones((m, n)))
    triangle = sparse.csc_matrix(np.triu(np.ones((n, n))))
    columns, lines = np.repeat(np.arange(n), np.arange(1, n + 1)), triangle.indices
    triangle.data = hessian[0][lines, columns].copy()
    pattern.data = rows[0].T.reshape(-1).copy()
    solver.setup(
        triangle,
        linear[0],
        pattern,
        limits[0],
        upper,
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=20000,
    )
    shared = problem.hessian.ndim == 2
    for i in range(len(motions)):
        changes = {} if shared else {"Px": hessian[i][lines, columns]}
        solver.update(q=linear[i], l=limits[i], Ax=rows[i].T.reshape(-1), **changes)
        result = solver.solve(raise_error=False)
        motions[i] = result.x
        solved[i] = result.info.status_val == 1
    return motions, solved


def solve_by_daqp(problem: ContactQP) -> Answer:
    """DAQP in a loop, at its own tolerances."""
    import daqp

    motions = np.empty(problem.target.shape)
    solved = np.zeros(len(motions), dtype=bool)
    for i, (hessian, target, rows, offsets) in enumerate(_single_problems(problem)):
        upper, sense = np.full(len(offsets), 1e30), np.zeros(len(offsets), dtype=np.int32)
        motions[i], _, flag, _ = daqp.solve(
            hessian, -hessian @ target, rows, upper, -offsets, sense
        )
        solved[i] = flag == 1
    return motions, solved


def _backend(name: str) -> Callable[[ContactQP], Answer]:
    def run(problem: ContactQP) -> Answer:
        answer = solve(problem, name, elastic=False)
        return answer.motion.cpu().numpy(), answer.solved.cpu().numpy()

    return run


def _through_qpsolvers(name: str) -> Callable[[ContactQP], Answer]:
    def run(problem: ContactQP) -> Answer:
        import qpsolvers
        from scipy import sparse

        motions = np.full(problem.target.shape, np.nan)
        dense = name in qpsolvers.dense_solvers
        for i, (hessian, target, rows, offsets) in enumerate(_single_problems(problem)):
            linear = -hessian @ target
            if not dense:
                hessian, rows = sparse.csc_matrix(hessian), sparse.csc_matrix(rows)
            motion = qpsolvers.solve_qp(hessian, linear, -rows, offsets, solver=name)
            if motion is not None:
                motions[i] = motion
        return motions, np.isfinite(motions).all(-1)

    return run


def _single_problems(problem: ContactQP) -> Iterator[tuple[np.ndarray, ...]]:
    """Hessian, target, rows and offsets of one problem after the other, without padding."""
    count, n = problem.target.shape
    plain = replace(problem, hessian=problem.hessian.expand(count, n, n))
    hessian, target, rows, offsets = (tensor.numpy() for tensor in plain.tensors[:4])
    mask = None if problem.row_mask is None else problem.row_mask.numpy()
    for i in range(count):
        kept = slice(None) if mask is None else mask[i]
        yield (
            np.ascontiguousarray(hessian[i]),
            target[i],
            np.ascontiguousarray(rows[i][kept]),
            np.ascontiguousarray(offsets[i][kept]),
        )
