"""The optional backend qpth: same call, same statuses, less accuracy, none of it silent."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from eval.bench.contact_problems import ContactRecipe, random_contact_problems
from tpcd.qp import ContactQP, Status, solve
from tpcd.qp.problem import select

pytest.importorskip("qpth", reason="the extra qpth is not installed")


def test_solved_elements_are_close_to_the_exact_answer():
    problem = random_contact_problems(1500, 8, 0)
    answer, exact = solve(problem, "qpth"), solve(problem)
    assert answer.solved.double().mean() > 0.99
    force = (answer.motion - exact.motion) @ problem.hessian
    assert force[answer.solved].abs().max() < 0.02
    assert force[answer.solved].abs().median() < 1e-6


def test_multipliers_carry_the_force():
    problem = random_contact_problems(300, 8, 1)
    answer = solve(problem, "qpth")
    force = (answer.motion - problem.target) @ problem.hessian
    pushed = (problem.rows * answer.multipliers[..., None]).sum(-2)
    assert (force - pushed)[answer.solved].abs().max() < 0.02
    assert answer.multipliers.min() >= 0
    assert not (answer.multipliers[~answer.active] != 0).any()


def test_duplicates_and_padding_are_not_silently_wrong():
    problem = random_contact_problems(400, 8, 2)
    twice = ContactQP(
        problem.hessian,
        problem.target,
        problem.rows.repeat(1, 2, 1),
        problem.offsets.repeat(1, 2),
        row_mask=problem.row_mask.repeat(1, 2),
    )
    answer, exact = solve(twice, "qpth"), solve(problem)
    force = (answer.motion - exact.motion) @ problem.hessian
    assert force[answer.solved].abs().max() < 0.02


def test_jammed_problems_are_never_reported_as_solved():
    jamming = ContactRecipe(friction=(1.1, 1.6), gaps=(-0.003, 0.001), wall_share=0.5)
    problem = random_contact_problems(400, 8, 3, jamming)
    jammed = solve(problem).status == Status.RELAXED
    answer = solve(problem, "qpth")
    assert jammed.any() and not (answer.solved & jammed).any()


def test_invalid_elements_are_flagged():
    problem = random_contact_problems(20, 8, 4)
    target = problem.target.clone()
    target[3] = torch.nan
    status = solve(replace(problem, target=target), "qpth").status
    assert status[3] == Status.INVALID_INPUT
    assert (status[:3] == Status.SOLVED).all()


@pytest.mark.parametrize(("batch", "m"), [((), 4), ((1,), 4), ((2, 3), 2), ((0,), 4), ((3,), 0)])
def test_every_batch_shape_is_answered_in_kind(batch, m):
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(*batch, m, 3, generator=generator, dtype=torch.float64)
    target = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    problem = ContactQP(torch.eye(3, dtype=torch.float64), target, rows, rows[..., 0].abs())
    answer = solve(problem, "qpth")
    assert answer.motion.shape == (*batch, 3) and answer.multipliers.shape == (*batch, m)
    expected = solve(problem).motion
    torch.testing.assert_close(answer.motion, expected, rtol=0, atol=1e-4)
    leaf = target.clone().requires_grad_()
    assert (
        torch.autograd.grad(solve(replace(problem, target=leaf), "qpth").motion.sum(), leaf)[0]
        .isfinite()
        .all()
    )


def gradients(problem: ContactQP, backend: str) -> tuple[torch.Tensor, ...]:
    """Of a weighted motion and resultant, in what all rows share: the share of each of redundant
    rows is not unique, neither in force nor in gradient."""
    eye = torch.eye(3, dtype=torch.float64)
    leaves = [t.clone().requires_grad_() for t in (problem.hessian, problem.target, eye, eye[0, 1])]
    hessian, target, turn, lift = leaves
    moved = replace(
        problem,
        hessian=hessian,
        target=target,
        rows=problem.rows @ turn,
        offsets=problem.offsets + lift,
    )
    solution = solve(moved, backend)
    pushed = (moved.rows * solution.multipliers[..., None]).sum(-2)
    weights = torch.tensor([1.0, -2.0, 0.3], dtype=torch.float64)
    total = (solution.motion * weights).sum() + 1e-4 * (pushed * weights).square().sum()
    return torch.autograd.grad(total, leaves)


@pytest.mark.parametrize("copies", [1, 2])
def test_gradients_are_those_of_the_exact_answer(copies: int) -> None:
    problem = random_contact_problems(300, 8, 5)
    exact, other = solve(problem), solve(problem, "qpth")
    # Where qpth is accurate, and no row is touched without force.
    same = ((exact.multipliers > 1e-6) == exact.active).all(-1)
    force = ((other.motion - exact.motion) @ problem.hessian).abs().amax(-1)
    problem = select(problem, exact.solved & other.solved & same & (force < 1e-7))
    assert problem.batch_shape[0] > 200 and exact.active.sum(-1).max() > 1
    assert problem.row_mask is not None
    more = replace(
        problem,
        rows=problem.rows.repeat(1, copies, 1),
        offsets=problem.offsets.repeat(1, copies),
        row_mask=problem.row_mask.repeat(1, copies),
    )
    for mine, theirs in zip(gradients(more, "qpth"), gradients(problem, "native"), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-6)


def test_gradients_of_stiff_springs_keep_every_row() -> None:
    jamming = ContactRecipe(friction=(1.1, 1.6), gaps=(-0.003, 0.001), wall_share=0.5)
    problem = random_contact_problems(200, 8, 3, jamming)
    soft = replace(problem, compliance=torch.full_like(problem.offsets, 1e-8))
    exact, other = solve(soft), solve(soft, "qpth")
    force = ((other.motion - exact.motion) @ problem.hessian).abs().amax(-1)
    same = (exact.active == other.active).all(-1) & exact.solved & other.solved
    soft = select(soft, same & (force < 1e-6))
    assert soft.batch_shape[0] > 50
    found = []
    for backend in ("native", "qpth"):
        leaf = soft.target.clone().requires_grad_()
        motion = solve(replace(soft, target=leaf), backend).motion
        found.append(torch.autograd.grad(motion.sum(), leaf)[0])
    torch.testing.assert_close(found[1], found[0], rtol=1e-4, atol=1e-6)
