"""Contact problems against independent solvers: enumeration, DAQP, Clarabel, closed forms."""

from __future__ import annotations

from itertools import combinations

import clarabel
import daqp
import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.optimize import nnls

from eval.bench.contact_problems import ContactRecipe, random_contact_problems
from tpcd.qp import ContactQP, Status, solve

MIXED = ContactRecipe()
JAMMING = ContactRecipe(friction=(0.1, 1.6), gaps=(-0.002, 0.004), stiffness_decades=1.0)


def whitened(problem: ContactQP, element: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit rows and offsets of the unmasked rows, and the Cholesky factor."""
    n = problem.variables
    hessian = problem.hessian.expand(*problem.batch_shape, n, n)[element].numpy()
    kept = slice(None) if problem.row_mask is None else problem.row_mask[element].numpy()
    rows = problem.rows[element].numpy()[kept]
    offsets = rows @ problem.target[element].numpy() + problem.offsets[element].numpy()[kept]
    factor = np.linalg.cholesky(hessian)
    rows = np.linalg.solve(factor, rows.T).T
    lengths = np.linalg.norm(rows, axis=1)
    return np.ascontiguousarray(rows / lengths[:, None]), offsets / lengths, factor


def daqp_force(problem: ContactQP, element: int) -> np.ndarray | None:
    """The generalised force H (v - target) by DAQP; None where it finds infeasibility."""
    rows, offsets, factor = whitened(problem, element)
    n, m = problem.variables, len(offsets)
    answer, _, flag, _ = daqp.solve(
        np.eye(n),
        np.zeros(n),
        rows,
        np.full(m, 1e30),
        -offsets,
        np.zeros(m, dtype=np.int32),
        primal_tol=1e-12,
    )
    assert flag in (1, -1), flag
    return factor @ answer if flag == 1 else None


def clarabel_force(problem: ContactQP, element: int) -> np.ndarray | None:
    """The force with the rows that Clarabel finds active, if they satisfy the conditions of Karush,
    Kuhn and Tucker; None where they do not."""
    rows, offsets, factor = whitened(problem, element)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        setattr(settings, name, 1e-13)
    n = problem.variables
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix(np.eye(n)),
        np.zeros(n),
        sparse.csc_matrix(-rows),
        offsets,
        [clarabel.NonnegativeConeT(len(offsets))],
        settings,
    )
    found = solver.solve()
    active = np.array(found.z) > np.array(found.s)
    motion = np.linalg.pinv(rows[active], rcond=1e-10) @ -offsets[active]
    pull, missing = nnls(rows[active].T, motion) if active.any() else (0, np.linalg.norm(motion))
    # A gap e between the values of two answers allows them to be sqrt(e) apart, so that the rows
    # must tell clearly on which side they are.
    slack = rows @ motion + offsets
    clear = ((np.abs(slack) < 1e-13) | (slack > 1e-7)).all()
    return factor @ motion if clear and missing < 1e-13 * (1 + np.max(pull)) else None


def enumerated_force(problem: ContactQP, element: int) -> np.ndarray | None:
    """The force by trying every set of at most n active rows."""
    rows, offsets, factor = whitened(problem, element)
    best, least = None, np.inf
    for size in range(problem.variables + 1):
        for chosen in combinations(range(len(offsets)), size):
            active = rows[list(chosen)]
            if size and np.linalg.matrix_rank(active, tol=1e-9) < size:
                continue
            motion = np.linalg.pinv(active) @ -offsets[list(chosen)] if size else np.zeros(3)
            multipliers = np.linalg.pinv(active.T) @ motion if size else np.zeros(0)
            feasible = (rows @ motion + offsets >= -1e-10).all()
            if feasible and (multipliers >= -1e-8).all() and motion @ motion < least:
                best, least = factor @ motion, motion @ motion
    return best


def forces(problem: ContactQP) -> tuple[np.ndarray, np.ndarray]:
    """Forces by motion and by multipliers, which must agree wherever solved."""
    solution = solve(problem, elastic=False)
    step = solution.motion - problem.target
    hessian = problem.hessian.expand(*problem.batch_shape, *problem.hessian.shape[-2:])
    by_motion = (hessian @ step[..., None])[..., 0]
    by_rows = (problem.rows * solution.multipliers[..., None]).sum(-2)
    scale = 1 + solution.multipliers.abs().amax(-1, keepdim=True)
    defect = ((by_motion - by_rows) / scale)[solution.solved]
    assert defect.abs().max() < 1e-11
    return by_motion.numpy(), solution.status.numpy()


@pytest.mark.parametrize("recipe", [MIXED, JAMMING], ids=["mixed", "jamming"])
def test_forces_match_daqp_on_ten_thousand_problems(recipe):
    wrong, worst, infeasible = 0, 0.0, 0
    for rows, seed in ((4, 1), (8, 2), (12, 3), (16, 4)):
        problem = random_contact_problems(2500, rows, seed, recipe)
        force, status = forces(problem)
        for element in range(2500):
            expected = daqp_force(problem, element)
            infeasible += expected is None
            if expected is None:
                wrong += status[element] != Status.INFEASIBLE
            else:
                error = np.abs(force[element] - expected).max()
                worst = max(worst, error)
                wrong += status[element] != Status.SOLVED or not error < 1e-8
    assert wrong == 0, worst
    assert worst < 1e-8
    assert (infeasible > 0) == (recipe is JAMMING)


def test_forces_match_the_best_of_all_active_sets():
    problem = random_contact_problems(120, 8, 5, JAMMING)
    force, status = forces(problem)
    for element in range(120):
        expected = enumerated_force(problem, element)
        if expected is None:
            assert status[element] == Status.INFEASIBLE
        else:
            np.testing.assert_allclose(force[element], expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("recipe", [MIXED, JAMMING], ids=["mixed", "jamming"])
def test_forces_match_clarabel_on_ten_thousand_problems(recipe):
    """Wherever it finds rows that solve the problem, which is nearly everywhere."""
    wrong, worst, compared, solvable = 0, 0.0, 0, 0
    for rows, seed in ((4, 6), (8, 7), (12, 8), (16, 9)):
        problem = random_contact_problems(2500, rows, seed, recipe)
        force, status = forces(problem)
        feasible = status == Status.SOLVED
        solvable += int(feasible.sum())
        for element in np.flatnonzero(feasible):
            expected = clarabel_force(problem, int(element))
            if expected is None:
                continue
            compared += 1
            error = np.abs(force[element] - expected).max()
            worst = max(worst, error)
            wrong += status[element] != Status.SOLVED or not error < 1e-8
    assert wrong == 0, worst
    assert compared > 0.999 * solvable > 9000


@pytest.mark.parametrize(("n", "m"), [(1, 3), (2, 5), (6, 10), (6, 24), (7, 3)])
def test_any_number_of_variables_matches_daqp(n, m):
    generator = torch.Generator().manual_seed(n * 100 + m)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(150, *shape, generator=generator, dtype=torch.float64)

    root = draw(n, n)
    hessian = root @ root.mT + 0.1 * torch.eye(n, dtype=torch.float64)
    problem = ContactQP(hessian, draw(n), draw(m, n), draw(m) + 0.5)
    force, status = forces(problem)
    for element in range(150):
        expected = daqp_force(problem, element)
        if expected is None:
            assert status[element] == Status.INFEASIBLE
        else:
            assert status[element] == Status.SOLVED
            scale = 1 + np.abs(expected).max()
            np.testing.assert_allclose(force[element] / scale, expected / scale, atol=1e-9)


def test_a_box_pressed_on_the_floor_is_carried_by_its_two_corners():
    # Command 3 mm below a flat face of half width 0.04 m, turned by 0.01 rad: the corners
    # share K_z 3 mm, and their difference balances K_phi 0.01 rad where it does not tip.
    half, stiffness = 0.04, torch.diag(torch.tensor([100.0, 100.0, 0.5], dtype=torch.float64))
    target = torch.tensor([0.0, -0.003, 0.01], dtype=torch.float64)
    rows = torch.tensor([[0.0, 1.0, half], [0.0, 1.0, -half]], dtype=torch.float64)
    solution = solve(ContactQP(stiffness, target, rows, rows.new_zeros(2)))
    total, difference = 100.0 * 0.003, 0.5 * 0.01 / half
    expected = torch.tensor([total - difference, total + difference], dtype=torch.float64) / 2
    torch.testing.assert_close(solution.multipliers, expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(solution.motion, torch.zeros_like(target), rtol=0, atol=1e-16)


@pytest.mark.parametrize("friction", [0.2, 0.7, 1.5])
def test_a_point_dragged_along_the_floor_feels_the_cone(friction):
    # Convex friction: the force lies on the cone edge, tangential = friction * normal.
    stiffness = 100.0 * torch.eye(2, dtype=torch.float64)
    target = torch.tensor([0.05, -0.004], dtype=torch.float64)
    rows = torch.tensor([[friction, 1.0], [-friction, 1.0]], dtype=torch.float64)
    solution = solve(ContactQP(stiffness, target, rows, rows.new_zeros(2)))
    force = stiffness @ (solution.motion - target)
    normal = 100.0 * (0.004 + friction * 0.05) / (1 + friction**2)
    expected = torch.tensor([-friction * normal, normal], dtype=torch.float64)
    torch.testing.assert_close(force, expected, rtol=1e-12, atol=1e-13)


def test_a_corner_between_floor_and_wall_stays_put():
    stiffness = 100.0 * torch.eye(2, dtype=torch.float64)
    target = torch.tensor([0.01, -0.02], dtype=torch.float64)
    rows = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)
    solution = solve(ContactQP(stiffness, target, rows, rows.new_zeros(2)))
    torch.testing.assert_close(solution.motion, torch.zeros_like(target), rtol=0, atol=1e-16)
    expected = torch.tensor([2.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(solution.multipliers, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("compliance", [0.0, 1e-6, 1e-3, 0.1])
def test_a_compliant_row_is_a_spring_in_series(compliance):
    # 100 N/m of impedance in series with 1/compliance, pressed 5 mm beyond the surface.
    hessian = torch.tensor([[100.0]], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    problem = ContactQP(hessian, -0.005 * one, one[:, None], 0 * one, compliance * one)
    solution = solve(problem)
    expected = 0.005 / (1 / 100.0 + compliance)
    torch.testing.assert_close(solution.multipliers, expected * one, rtol=1e-12, atol=0)
    depth = -compliance * expected * one
    torch.testing.assert_close(solution.motion, depth, rtol=1e-9, atol=1e-18)


def test_compliant_problems_match_daqp_with_one_spring_variable_for_each_row():
    rigid = random_contact_problems(300, 8, 7, MIXED)
    m = rigid.row_count
    generator = torch.Generator().manual_seed(8)
    compliance = 10 ** (-6 + 4 * torch.rand(300, m, generator=generator, dtype=torch.float64))
    soft = ContactQP(
        rigid.hessian, rigid.target, rigid.rows, rigid.offsets, compliance, rigid.row_mask
    )
    solution = solve(soft)
    assert solution.solved.all()
    spring = torch.diag_embed(compliance.sqrt())
    wide = ContactQP(
        torch.block_diag(rigid.hessian, torch.eye(m, dtype=torch.float64)),
        torch.cat((rigid.target, torch.zeros(300, m, dtype=torch.float64)), -1),
        torch.cat((rigid.rows, spring), -1),
        rigid.offsets,
        row_mask=rigid.row_mask,
    )
    force = ((solution.motion - rigid.target) @ rigid.hessian).numpy()
    for element in range(300):
        expected = daqp_force(wide, element)
        np.testing.assert_allclose(force[element], expected[:3], rtol=0, atol=1e-8)
