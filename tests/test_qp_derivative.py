"""Derivatives of motion and multipliers against finite differences, first and second order."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from eval.bench.contact_problems import ContactRecipe, random_contact_problems
from tpcd.qp import ContactQP, Status, solve

MIXED = ContactRecipe()
JAMMING = ContactRecipe(friction=(1.1, 1.6), gaps=(-0.003, 0.001), wall_share=0.5)


def generic(count: int, m: int, seed: int, n: int = 3) -> ContactQP:
    """Feasible problems without degeneracy, several rows active in most."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=torch.float64)

    root = draw(n, n)
    hessian = root @ root.mT + torch.eye(n, dtype=torch.float64)
    rows = draw(m, n)
    rows[..., 0] = rows[..., 0].abs() + 0.3
    compliance = draw(m).abs()
    return ContactQP(hessian, 2 * draw(n), rows, draw(m) - 1, compliance)


def check(function, *inputs: torch.Tensor, twice: bool = True) -> None:
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    assert gradcheck(function, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)
    if twice:
        assert gradgradcheck(function, leaves, eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("soft", [False, True], ids=["rigid", "compliant"])
def test_gradients_are_exact_in_every_input(soft):
    problem = generic(2, 4, 0)
    assert solve(problem).active.any(-1).all()

    def answer(hessian, target, rows, offsets, compliance):
        springs = compliance if soft else None
        solution = solve(ContactQP(hessian, target, rows, offsets, springs))
        return solution.motion, solution.multipliers

    check(answer, *problem.tensors)


def test_gradients_are_exact_in_six_variables():
    problem = generic(2, 6, 1, n=6)

    def answer(hessian, target, rows, offsets):
        solution = solve(ContactQP(hessian, target, rows, offsets))
        return solution.motion, solution.multipliers

    check(answer, *problem.tensors[:4], twice=False)


def contact_answer(friction, height, stiffness, target, x, z):
    """Total force and motion of points over a floor; every parameter shared by the batch."""
    batch, count = target.shape[0], len(x)
    angle = torch.tensor(0.02, dtype=torch.float64)
    lever = torch.stack((torch.ones_like(x) * 0, torch.ones_like(x), x), -1)
    side = torch.stack((torch.ones_like(x), torch.ones_like(x) * 0, -z), -1)
    rows = torch.stack((lever + friction * side, lever - friction * side), 1)
    gaps = (z - z.min()) * torch.cos(angle) - height
    return ContactQP(
        hessian=torch.diag(stiffness),
        target=target,
        rows=rows.reshape(1, 2 * count, 3).expand(batch, -1, -1),
        offsets=gaps.repeat_interleave(2).expand(batch, -1),
    )


@pytest.mark.parametrize(
    ("x", "z"),
    [
        ([0.04, 0.04, -0.03], [-0.05, -0.05, -0.02]),
        ([-0.04, 0.0, 0.01, 0.04], [-0.05, -0.05, -0.05, -0.05]),
        ([-0.04, 0.04, 0.04, 0.0, 0.0], [-0.05, -0.05, -0.05, -0.05, 0.3]),
    ],
    ids=["duplicates", "flat face", "duplicates on a flat face"],
)
def test_gradients_in_shared_parameters_are_exact_on_redundant_contacts(x, z):
    x = torch.tensor(x, dtype=torch.float64)
    z = torch.tensor(z, dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    target = 0.002 * torch.randn(6, 3, generator=generator, dtype=torch.float64)
    target = target + torch.tensor([0.004, -0.008, 0.0], dtype=torch.float64)
    shared = [torch.tensor(value, dtype=torch.float64) for value in (0.4, 0.001)]
    stiffness = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)

    def answer(friction, height, stiffness, target):
        problem = contact_answer(friction, height, stiffness, target, x, z)
        solution = solve(problem)
        # Of redundant rows only the resultant is unique, not the share of each.
        return solution.motion, (problem.rows * solution.multipliers[..., None]).sum(-2)

    assert solve(contact_answer(*shared, stiffness, target, x, z)).active.any(-1).all()
    check(answer, *shared, stiffness, target)


def test_a_shared_parameter_gathers_the_gradients_of_all_elements():
    problem = generic(5, 4, 4)
    hessian = problem.hessian[0]

    def total(matrix: torch.Tensor) -> torch.Tensor:
        return solve(replace(problem, hessian=matrix, compliance=None)).motion.square().sum()

    shared = hessian.clone().requires_grad_()
    (gathered,) = torch.autograd.grad(total(shared), shared)
    single = hessian.expand(5, 3, 3).clone().requires_grad_()
    (each,) = torch.autograd.grad(total(single), single)
    torch.testing.assert_close(gathered, each.sum(0))


def test_padded_rows_get_zero_gradient_and_change_none():
    problem = random_contact_problems(20, 8, 5, MIXED)
    dirty = replace(
        problem,
        rows=problem.rows.where(problem.row_mask[..., None], torch.nan),
        offsets=problem.offsets.where(problem.row_mask, torch.nan),
    )
    gradients = []
    for case in (problem, dirty):
        leaves = [case.target, case.rows, case.offsets]
        leaves = [tensor.clone().requires_grad_() for tensor in leaves]
        target, rows, offsets = leaves
        solution = solve(replace(case, target=target, rows=rows, offsets=offsets))
        loss = solution.motion.square().sum() + solution.multipliers.square().sum()
        gradients.append(torch.autograd.grad(loss, leaves))
    for clean, poisoned in zip(*gradients, strict=True):
        assert torch.equal(clean, poisoned)
    assert not (gradients[0][2][~problem.row_mask] != 0).any()


def test_gradients_are_exact_beside_padded_rows():
    """To second order too; each element has another number of rows, at other places."""
    problem = generic(2, 6, 3)
    mask = torch.tensor(
        [[True, False, True, True, False, True], [False, True, True, True, True, False]]
    )
    assert solve(replace(problem, row_mask=mask)).active.any(-1).all()

    def answer(hessian, target, rows, offsets, compliance):
        solution = solve(ContactQP(hessian, target, rows, offsets, compliance, mask))
        return solution.motion, solution.multipliers

    check(answer, *problem.tensors[:5])


def test_elements_without_an_answer_get_zero_gradient():
    problem = generic(4, 5, 6)
    target = problem.target.clone()
    target[2, 1] = torch.nan
    leaves = [tensor.clone().requires_grad_() for tensor in (problem.hessian, target)]
    solution = solve(replace(problem, hessian=leaves[0], target=leaves[1], compliance=None))
    assert solution.status[2] == Status.INVALID_INPUT
    good = solution.motion[solution.solved].sum() + solution.multipliers[solution.solved].sum()
    for gradient in torch.autograd.grad(good, leaves):
        assert gradient.isfinite().all()
        assert not gradient[2].any() and gradient[0].any()


def test_gradients_of_the_elastic_fallback_are_exact():
    problem = random_contact_problems(400, 6, 7, JAMMING)
    jammed = (solve(problem).status == Status.RELAXED).nonzero()[:2, 0]
    hessian = problem.hessian / 100.0
    inputs = (problem.target[jammed], problem.rows[jammed], problem.offsets[jammed])
    mask = problem.row_mask[jammed]

    def answer(hessian, target, rows, offsets):
        solution = solve(ContactQP(hessian, target, rows, offsets, row_mask=mask))
        assert (solution.status == Status.RELAXED).all()
        return solution.motion, solution.multipliers

    leaves = [tensor.detach().clone().requires_grad_() for tensor in (hessian, *inputs)]
    assert gradcheck(answer, leaves, eps=1e-8, atol=1e-2, rtol=1e-3)


def test_asking_for_gradients_does_not_change_the_answer():
    problem = random_contact_problems(200, 12, 8, MIXED)
    plain = solve(problem)
    traced = solve(replace(problem, target=problem.target.clone().requires_grad_()))
    assert traced.motion.requires_grad and traced.multipliers.requires_grad
    assert torch.equal(plain.motion, traced.motion.detach())
    assert torch.equal(plain.multipliers, traced.multipliers.detach())
    with torch.no_grad():
        silent = solve(replace(problem, target=problem.target.clone().requires_grad_()))
    assert not silent.motion.requires_grad


def test_single_precision_gradients_are_those_of_double_precision():
    problem = generic(6, 5, 9)
    gradients = []
    for dtype in (torch.float32, torch.float64):
        leaves = [tensor.float().to(dtype).requires_grad_() for tensor in problem.tensors[:4]]
        solution = solve(ContactQP(*leaves))
        loss = solution.motion.square().sum() + solution.multipliers.sum()
        gradients.append(torch.autograd.grad(loss, leaves))
    for single, double in zip(*gradients, strict=True):
        assert single.dtype == torch.float32
        torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-4)


def test_no_rows_and_empty_batches_pass_gradients():
    eye = torch.eye(3, dtype=torch.float64)
    for batch, m in (((4,), 0), ((0,), 5), ((), 0)):
        target = torch.ones(*batch, 3, dtype=torch.float64, requires_grad=True)
        rows, offsets = eye.new_ones(*batch, m, 3), eye.new_ones(*batch, m)
        solve(ContactQP(eye, target, rows, offsets)).motion.sum().backward()
        assert torch.equal(target.grad, torch.ones_like(target))
