"""The optimiser of hidden matrices: against torch's, its singular values, and what it refuses."""

from __future__ import annotations

import copy

import pytest
import torch

from training.muon import Muon, near_orthogonal

SHAPES = pytest.mark.parametrize("shape", [(24, 24), (16, 40), (40, 16)])


def random_matrix(shape: tuple[int, int], seed: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@SHAPES
def test_singular_values_come_near_one_and_singular_vectors_stay(shape) -> None:
    given = random_matrix(shape, 0).double()
    left, values, right = torch.linalg.svd(given, full_matrices=False)
    assert values.max() / values.min() > 2
    found = left.mT @ near_orthogonal(given) @ right.mT
    scale = found.diagonal()
    assert scale.min() > 0.6 and scale.max() < 1.3
    torch.testing.assert_close(found, scale.diag(), atol=1e-10, rtol=0)


@SHAPES
def test_it_makes_the_steps_of_torchs_within_the_precision_of_bfloat16(shape) -> None:
    ours, theirs = (torch.nn.Parameter(random_matrix(shape, 1)) for _ in range(2))
    start = ours.detach().clone()
    first = Muon([ours], lr=0.02)
    second = torch.optim.Muon([theirs], lr=0.02, momentum=0.95, weight_decay=0.0)
    for k in range(6):
        ours.grad = random_matrix(shape, 10 + k)
        theirs.grad = ours.grad.clone()
        first.step()
        second.step()
    moved = (ours - start).norm()
    assert moved > 0.1
    assert (ours - theirs).norm() < 0.01 * moved


def test_it_goes_on_from_its_state_as_if_it_had_never_stopped() -> None:
    whole = torch.nn.Parameter(random_matrix((8, 8), 2))
    optimizer = Muon([whole], lr=0.1)
    for k in range(4):
        if k == 2:
            halved = torch.nn.Parameter(whole.detach().clone())
            resumed = Muon([halved], lr=0.1)
            resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
        whole.grad = random_matrix((8, 8), 20 + k)
        optimizer.step()
        if k >= 2:
            halved.grad = whole.grad.clone()
            resumed.step()
    assert torch.equal(halved, whole)


def test_without_a_gradient_nothing_moves() -> None:
    still, level = (torch.nn.Parameter(random_matrix((4, 5), 3)) for _ in range(2))
    level.grad = torch.zeros_like(level)
    Muon([still, level], lr=0.1).step()
    assert torch.equal(still, random_matrix((4, 5), 3)) and torch.equal(still, level)


def test_vectors_are_refused() -> None:
    with pytest.raises(ValueError, match=r"matrices only, got shapes \[\(3,\)\]"):
        Muon([torch.nn.Parameter(torch.zeros(3))], lr=0.1)
