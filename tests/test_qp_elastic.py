"""The fallback for contact problems that no motion satisfies."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize

from eval.bench.contact_problems import ContactRecipe, random_contact_problems
from tpcd.qp import ContactQP, Status, solve
from tpcd.qp.elastic import RELAXATION, relax
from tpcd.qp.problem import select

JAMMING = ContactRecipe(friction=(1.1, 1.6), gaps=(-0.003, 0.001), wall_share=0.5)


def opposed(gap: float) -> ContactQP:
    """One variable between two walls that overlap by -gap; K = 100 N/m, target 0."""
    rows = torch.tensor([[1.0], [-1.0]], dtype=torch.float64)
    offsets = torch.tensor([0.0, gap], dtype=torch.float64)
    hessian = torch.full((1, 1), 100.0, dtype=torch.float64)
    return ContactQP(hessian, torch.zeros(1, dtype=torch.float64), rows, offsets)


def test_two_walls_that_overlap_share_the_penetration():
    solution = solve(opposed(-0.002))
    assert solution.status == Status.RELAXED
    compliance = RELAXATION / 100.0
    # Springs of 1/c on both sides of the point and K = 100 N/m towards 0.
    expected = -0.002 / (2 + 100.0 * compliance)
    torch.testing.assert_close(solution.motion.item(), expected, rtol=1e-10, atol=0)
    forces = -torch.stack((solution.motion[0], -0.002 - solution.motion[0])) / compliance
    torch.testing.assert_close(solution.multipliers, forces, rtol=1e-10, atol=0)


def test_without_the_fallback_infeasible_elements_are_marked_and_not_answered():
    solution = solve(opposed(-0.002), elastic=False)
    assert solution.status == Status.INFEASIBLE
    assert solution.motion.isnan().all() and solution.residual.isnan()


def test_walls_that_just_touch_are_feasible():
    solution = solve(opposed(0.0))
    assert solution.status == Status.SOLVED
    assert solution.motion.item() == 0.0


def test_jammed_contacts_get_finite_answers_that_satisfy_the_relaxed_conditions():
    problem = random_contact_problems(2000, 12, 0, JAMMING)
    solution = solve(problem)
    jammed = solution.status == Status.RELAXED
    assert 100 < jammed.sum() < 2000
    assert (solution.solved | jammed).all()
    part = relax(select(problem, jammed))
    motion, multipliers = solution.motion[jammed], solution.multipliers[jammed]
    assert motion.isfinite().all() and multipliers.isfinite().all()
    slack = (part.rows @ motion[..., None])[..., 0] + part.offsets + part.compliance * multipliers
    slack = slack.where(part.row_mask, 1.0)
    assert slack.min() > -1e-9
    assert multipliers.min() >= 0
    scale = multipliers.amax(-1, keepdim=True)
    assert (slack * multipliers / scale).abs().max() < 1e-9
    force = (motion - part.target) @ problem.hessian
    pushed = (part.rows * multipliers[..., None]).sum(-2)
    assert ((force - pushed) / scale).abs().max() < 1e-11


def test_the_compromise_minimises_motion_and_squared_violation_together():
    problem = random_contact_problems(300, 8, 1, JAMMING)
    solution = solve(problem)
    assert 5 < int((solution.status == Status.RELAXED).sum()) < 95
    root = problem.hessian.diagonal().sqrt()
    whitened = problem.rows / root
    lengths = whitened.norm(dim=-1)
    for element in (solution.status == Status.RELAXED).nonzero()[:10, 0].tolist():
        mask = problem.row_mask[element]
        rows = (whitened[element] / lengths[element, :, None])[mask].numpy()
        gaps = (problem.offsets[element] / lengths[element])[mask].numpy()
        target = (problem.target[element] * root).numpy()

        def cost(w, rows=rows, gaps=gaps, target=target):
            violation = np.minimum(rows @ w + gaps, 0)
            return ((w - target) ** 2).sum() + (violation**2).sum() / RELAXATION

        ours = (solution.motion[element] * root).numpy()
        least = minimize(cost, ours, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 0})
        assert cost(ours) <= least.fun * (1 + 1e-9)
        assert cost(ours) < min(cost(target), cost(0 * target))


def test_the_answer_is_continuous_in_the_penetration():
    depths = torch.linspace(-0.004, -1e-5, 400, dtype=torch.float64)
    single = opposed(-0.001)
    batch = ContactQP(
        single.hessian,
        single.target.expand(400, 1),
        single.rows.expand(400, 2, 1),
        torch.stack((torch.zeros_like(depths), depths), -1),
    )
    solution = solve(batch)
    assert (solution.status == Status.RELAXED).all()
    assert solution.motion.diff(dim=0).abs().max() < 1.1 * 0.5 * depths.diff().max()


def test_units_do_not_matter_to_the_compromise():
    problem = random_contact_problems(200, 8, 2, JAMMING)
    scaled = ContactQP(
        problem.hessian * 1e4,
        problem.target * 1e-3,
        problem.rows * 50.0,
        problem.offsets * 50.0 * 1e-3,
        row_mask=problem.row_mask,
    )
    first, second = solve(problem), solve(scaled)
    assert torch.equal(first.status, second.status) and (first.status == Status.RELAXED).any()
    torch.testing.assert_close(second.motion * 1e3, first.motion, rtol=1e-7, atol=1e-10)


def test_an_impossible_row_without_direction_leaves_the_motion_alone():
    target = torch.tensor([0.1, 0.2], dtype=torch.float64)
    rows = torch.zeros(1, 2, dtype=torch.float64)
    problem = ContactQP(torch.eye(2, dtype=torch.float64), target, rows, -rows[:, 0] - 1.0)
    solution = solve(problem)
    assert solution.status == Status.RELAXED
    torch.testing.assert_close(solution.motion, target, rtol=0, atol=1e-14)


def test_the_compiled_solver_agrees_with_the_door():
    from tpcd.qp.active_set import solve_whitened_3

    problem = random_contact_problems(100, 8, 3, JAMMING)
    solution = solve(problem)
    assert 5 < int((solution.status == Status.RELAXED).sum()) < 95
    root = problem.hessian.diagonal().sqrt().numpy()
    for element in range(100):
        mask = problem.row_mask[element].numpy()
        rows = problem.rows[element].numpy()[mask] / root
        target = problem.target[element].numpy()
        raw = problem.rows[element].numpy()[mask]
        offsets = raw @ target + problem.offsets[element].numpy()[mask]
        sizes = np.abs(raw) @ np.abs(target) + np.abs(problem.offsets[element].numpy()[mask])
        m = len(offsets)
        lengths, multipliers = np.linalg.norm(rows, axis=1), np.empty(m)
        motion, slots, work = np.empty(3), np.empty(3, np.int64), np.empty((8, 3))
        rows, offsets, sizes = rows / lengths[:, None], offsets / lengths, sizes / lengths
        status, _ = solve_whitened_3(rows, offsets, sizes, m, motion, multipliers, slots, work)
        if status == Status.INFEASIBLE:
            assert solution.status[element] == Status.RELAXED
            continue
        assert status == solution.status[element] == Status.SOLVED
        expected = (solution.motion[element].numpy() - target) * root
        np.testing.assert_allclose(motion, expected, rtol=0, atol=1e-9)
        carried = solution.multipliers[element].numpy()[mask]
        np.testing.assert_allclose(
            multipliers / lengths, carried, rtol=1e-6, atol=1e-6 * (1 + carried.max())
        )
