"""Laws that every exact answer obeys: isolation, symmetry, scaling."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.bench.contact_problems import ContactRecipe, random_contact_problems
from tpcd.qp import ContactQP, QPSolution, Status, solve

HARD = ContactRecipe(friction=(0.1, 1.6), gaps=(-0.002, 0.004), stiffness_decades=1.0)


def same_bits(first: QPSolution, second: QPSolution) -> bool:
    return all(
        torch.equal(
            getattr(first, field.name).nan_to_num(-1.0),
            getattr(second, field.name).nan_to_num(-1.0),
        )
        for field in fields(QPSolution)
    )


def element(solution: QPSolution, index: slice) -> QPSolution:
    return QPSolution(*(getattr(solution, field.name)[index] for field in fields(QPSolution)))


def part(problem: ContactQP, index: slice) -> ContactQP:
    hessian = problem.hessian if problem.hessian.ndim == 2 else problem.hessian[index]
    others = (getattr(problem, name) for name in ("target", "rows", "offsets", "compliance"))
    cut = [None if tensor is None else tensor[index] for tensor in others]
    return ContactQP(hessian, *cut, row_mask=problem.row_mask[index])


def test_an_element_does_not_depend_on_its_neighbours_bit_for_bit():
    problem = random_contact_problems(300, 10, 0, HARD)
    whole = solve(problem)
    assert set(whole.status.tolist()) == {Status.SOLVED, Status.RELAXED}
    for cut in (slice(0, 1), slice(7, 24), slice(100, 299)):
        assert same_bits(element(whole, cut), solve(part(problem, cut)))


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["hessian", "target", "rows", "offsets", "compliance"])
def test_a_poisoned_element_is_flagged_and_changes_no_other(name, poison):
    problem = random_contact_problems(40, 8, 1, HARD)
    problem = replace(
        problem,
        row_mask=torch.ones_like(problem.row_mask),
        compliance=torch.full_like(problem.offsets, 1e-4),
    )
    clean = solve(problem)
    tensor = getattr(problem, name).clone()
    tensor[17].view(-1)[0] = poison
    poisoned = solve(replace(problem, **{name: tensor}))
    assert poisoned.status[17] == Status.INVALID_INPUT
    assert poisoned.motion[17].isnan().all() and poisoned.multipliers[17].isnan().all()
    assert not poisoned.active[17].any()
    for cut in (slice(0, 17), slice(18, 40)):
        assert same_bits(element(clean, cut), element(poisoned, cut))


@pytest.mark.parametrize(
    "hessian",
    [
        [[1.0, 0.0], [0.0, 0.0]],
        [[1.0, 2.0], [2.0, 1.0]],
        [[-1.0, 0.0], [0.0, 1.0]],
        [[1.0, 0.5], [0.0, 1.0]],
    ],
    ids=["singular", "indefinite", "negative", "asymmetric"],
)
def test_a_hessian_that_is_not_positive_definite_is_invalid_in_its_element(hessian):
    good = torch.eye(2, dtype=torch.float64)
    hessians = torch.stack((good, torch.tensor(hessian, dtype=torch.float64), good))
    target = torch.ones(3, 2, dtype=torch.float64)
    problem = ContactQP(hessians, target, -target[:, None], target[:, :1])
    assert solve(problem).status.tolist() == [0, int(Status.INVALID_INPUT), 0]
    shared = replace(problem, hessian=hessians[1])
    assert (solve(shared).status == Status.INVALID_INPUT).all()


def test_a_negative_compliance_is_invalid():
    one = torch.ones(1, 1, dtype=torch.float64)
    problem = ContactQP(one[0, :, None], -one, one[:, None], 0 * one, -one)
    assert solve(problem).status.tolist() == [int(Status.INVALID_INPUT)]


def test_masked_rows_are_ignored_whatever_they_hold():
    problem = random_contact_problems(200, 8, 2, HARD)
    mask = problem.row_mask
    compliance = torch.full_like(problem.offsets, 1e-5)
    dirty = replace(
        problem,
        rows=problem.rows.where(mask[..., None], torch.nan),
        offsets=problem.offsets.where(mask, -torch.inf),
    )
    assert same_bits(solve(problem), solve(dirty))
    soft = replace(problem, compliance=compliance)
    dirty = replace(dirty, compliance=compliance.where(mask, -1.0))
    assert same_bits(solve(soft), solve(dirty))
    assert not (solve(dirty).multipliers[~mask] != 0).any()


def test_far_rows_and_zero_rows_change_nothing():
    problem = random_contact_problems(200, 8, 3)
    far = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64).expand(200, 1, 3)
    wide = ContactQP(
        problem.hessian,
        problem.target,
        torch.cat((problem.rows, far, 0 * far), dim=1),
        torch.nn.functional.pad(problem.offsets, (0, 2), value=100.0),
        row_mask=torch.nn.functional.pad(problem.row_mask, (0, 2), value=True),
    )
    torch.testing.assert_close(solve(wide).motion, solve(problem).motion)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), rows=st.sampled_from([4, 8, 14]))
def test_the_order_of_rows_does_not_matter(seed, rows):
    problem = random_contact_problems(30, rows, seed)
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))
    shuffled = ContactQP(
        problem.hessian,
        problem.target,
        problem.rows[:, order],
        problem.offsets[:, order],
        row_mask=problem.row_mask[:, order],
    )
    first, second = solve(problem), solve(shuffled)
    torch.testing.assert_close(first.motion, second.motion, rtol=0, atol=1e-12)
    assert torch.equal(first.status, second.status)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), decades=st.tuples(*[st.floats(-4, 4)] * 3))
def test_units_do_not_matter(seed, decades):
    length, force, row = (10.0**decade for decade in decades)
    problem = random_contact_problems(30, 8, seed)
    scaled = ContactQP(
        problem.hessian * (force / length),
        problem.target * length,
        problem.rows * row,
        problem.offsets * (row * length),
        row_mask=problem.row_mask,
    )
    first, second = solve(problem), solve(scaled)
    assert torch.equal(first.status, second.status)
    torch.testing.assert_close(second.motion / length, first.motion, rtol=1e-9, atol=1e-13)
    pushed = (scaled.rows * second.multipliers[..., None]).sum(-2) / force
    expected = (problem.rows * first.multipliers[..., None]).sum(-2)
    torch.testing.assert_close(pushed, expected, rtol=1e-9, atol=1e-11)


def test_each_row_may_have_its_own_unit():
    problem = random_contact_problems(100, 8, 4)
    generator = torch.Generator().manual_seed(0)
    units = 10 ** (6 * torch.rand(100, 8, generator=generator, dtype=torch.float64) - 3)
    scaled = ContactQP(
        problem.hessian,
        problem.target,
        problem.rows * units[..., None],
        problem.offsets * units,
        row_mask=problem.row_mask,
    )
    expected = solve(problem).motion
    torch.testing.assert_close(solve(scaled).motion, expected, rtol=0, atol=1e-13)


def test_moving_the_origin_moves_the_answer():
    problem = random_contact_problems(100, 8, 5)
    shift = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    moved = ContactQP(
        problem.hessian,
        problem.target + shift,
        problem.rows,
        problem.offsets - problem.rows @ shift,
        row_mask=problem.row_mask,
    )
    expected = solve(problem).motion + shift
    torch.testing.assert_close(solve(moved).motion, expected, rtol=0, atol=1e-12)


def test_single_precision_is_solved_in_double_and_answered_in_single():
    problem = random_contact_problems(300, 8, 6)
    single = ContactQP(
        problem.hessian.float(),
        problem.target.float(),
        problem.rows.float(),
        problem.offsets.float(),
        row_mask=problem.row_mask,
    )
    double = ContactQP(
        single.hessian.double(),
        single.target.double(),
        single.rows.double(),
        single.offsets.double(),
        row_mask=problem.row_mask,
    )
    answer, expected = solve(single), solve(double)
    assert answer.motion.dtype == answer.multipliers.dtype == torch.float32
    assert torch.equal(answer.motion, expected.motion.float())
    assert torch.equal(answer.multipliers, expected.multipliers.float())
    assert torch.equal(answer.active, expected.active)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,), (2, 0)])
@pytest.mark.parametrize("m", [0, 1, 4])
def test_every_batch_shape_is_answered_in_kind(batch, m):
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    problem = ContactQP(2 * torch.eye(3, dtype=torch.float64), draw(3), draw(m, 3), draw(m).abs())
    solution = solve(problem)
    assert solution.motion.shape == (*batch, 3)
    assert solution.multipliers.shape == solution.active.shape == (*batch, m)
    assert solution.status.shape == solution.residual.shape == solution.iterations.shape == batch
    assert solution.solved.all()
    if m == 0:
        assert torch.equal(solution.motion, problem.target)
    spread = replace(problem, hessian=problem.hessian.expand(*batch, 3, 3).clone())
    torch.testing.assert_close(solve(spread).motion, solution.motion, rtol=0, atol=1e-15)


def test_the_answer_satisfies_the_optimality_conditions():
    problem = random_contact_problems(500, 16, 7)
    solution = solve(problem)
    slack = (problem.rows @ solution.motion[..., None])[..., 0] + problem.offsets
    slack = slack.where(problem.row_mask, 1.0)
    assert slack.min() > -1e-12
    assert solution.multipliers.min() >= 0
    assert (slack * solution.multipliers).abs().max() < 1e-12
    assert slack[solution.active].abs().max() < 1e-12
    assert not (solution.multipliers[~solution.active] != 0).any()
    assert solution.active.sum(-1).max() <= 3
    assert solution.residual.max() < 1e-12
    force = (solution.motion - problem.target) @ problem.hessian
    pushed = (problem.rows * solution.multipliers[..., None]).sum(-2)
    torch.testing.assert_close(force, pushed, rtol=0, atol=1e-10)


def test_a_free_target_is_returned_untouched():
    problem = random_contact_problems(50, 8, 8)
    free = replace(problem, offsets=problem.offsets + 10.0)
    solution = solve(free)
    assert torch.equal(solution.motion, problem.target)
    assert not solution.active.any() and not solution.iterations.any()


def test_exact_duplicates_share_nothing_and_change_nothing():
    problem = random_contact_problems(200, 8, 9)
    twice = ContactQP(
        problem.hessian,
        problem.target,
        problem.rows.repeat(1, 3, 1),
        problem.offsets.repeat(1, 3),
        row_mask=problem.row_mask.repeat(1, 3),
    )
    first, second = solve(problem), solve(twice)
    assert second.solved.all()
    torch.testing.assert_close(first.motion, second.motion, rtol=0, atol=1e-13)


def test_too_few_iterations_are_reported():
    problem = random_contact_problems(200, 8, 10)
    needed = solve(problem).iterations
    cut = solve(problem, iteration_limit=1)
    limited = cut.status == Status.ITERATION_LIMIT
    assert torch.equal(limited, needed > 1)
    assert limited.any() and (cut.residual[limited] > 1e-9).all()


def test_inputs_are_not_changed():
    problem = random_contact_problems(100, 8, 11, HARD)
    before = [tensor.clone() for tensor in problem.tensors]
    solve(problem)
    assert all(torch.equal(*pair) for pair in zip(before, problem.tensors, strict=True))
