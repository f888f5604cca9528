"""The likeliest place in a box, against a solver of bounded least squares."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import lsq_linear

from tpcd.belief.box import nearest_inside


def problems(count: int = 60) -> tuple[torch.Tensor, torch.Tensor]:
    """Means in and out of the unit box, and precisions of condition up to some millions."""
    generator = torch.Generator().manual_seed(3)
    mean = 0.5 + torch.randn(count, 5, generator=generator, dtype=torch.float64)
    factor = torch.randn(count, 5, 5, generator=generator, dtype=torch.float64)
    scales = 10 ** (3 * torch.rand(count, 5, generator=generator, dtype=torch.float64))
    return mean, (factor @ torch.diag_embed(scales) @ factor.mT)


def test_places_and_losses_are_those_of_bounded_least_squares() -> None:
    mean, precision = problems()
    place, below = nearest_inside(mean, precision, 0.1)
    on_side = 0
    for k in range(len(mean)):
        root = np.linalg.cholesky(precision[k].numpy()).T
        found = lsq_linear(root, root @ mean[k].numpy(), (0.1, 0.9), method="bvls", tol=1e-14)
        np.testing.assert_allclose(place[k], found.x, atol=1e-7)
        np.testing.assert_allclose(below[k], found.cost, rtol=1e-6, atol=1e-9)
        on_side += int((np.abs(found.x - 0.5) > 0.4 - 1e-9).sum())
    assert 60 < on_side < 240


def test_a_mean_in_the_box_is_taken_as_it_is() -> None:
    mean, precision = problems()
    place, below = nearest_inside(0.2 + 0.1 * mean.clamp(0, 1), precision, 0.1)
    torch.testing.assert_close(place, 0.2 + 0.1 * mean.clamp(0, 1))
    assert float(below.abs().max()) < 1e-9


def test_what_has_no_answer_is_flagged_and_leaves_the_others_alone() -> None:
    mean, precision = problems(4)
    alone = nearest_inside(mean[[0, 3]], precision[[0, 3]], 0.1)
    mean[1], precision[2] = torch.nan, -precision[2]
    place, below = nearest_inside(mean, precision, 0.1)
    assert below[1:3].tolist() == [math.inf, math.inf] and bool((place[1:3] == 0.5).all())
    torch.testing.assert_close(place[[0, 3]], alone[0])
    torch.testing.assert_close(below[[0, 3]], alone[1])
