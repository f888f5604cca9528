"""The Student mixture: density, sampling and fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t

from tpcd.belief.proposals import DEGREES_OF_FREEDOM, StudentMixture, fit_student_mixture


def two_components(dimension: int) -> StudentMixture:
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(2, dimension, dimension, generator=generator, dtype=torch.float64).tril()
    factor.diagonal(dim1=-2, dim2=-1).abs_().add_(0.4)
    mean = torch.randn(2, dimension, generator=generator, dtype=torch.float64)
    return StudentMixture(torch.tensor([0.3, 0.7], dtype=torch.float64).log(), mean, factor)


def test_density_is_that_of_scipy() -> None:
    mixture = two_components(3)
    points = 2 * torch.randn(50, 3, generator=torch.Generator().manual_seed(1)).double()
    scales = (mixture.factor @ mixture.factor.mT).numpy()
    expected = sum(
        float(share) * multivariate_t(mean, scale, df=DEGREES_OF_FREEDOM).pdf(points.numpy())
        for share, mean, scale in zip(
            mixture.log_share.exp(), mixture.mean.numpy(), scales, strict=True
        )
    )
    np.testing.assert_allclose(mixture.log_density(points).exp().numpy(), expected, rtol=1e-10)


def test_density_integrates_to_one() -> None:
    mixture = two_components(1)
    grid = torch.linspace(-200, 200, 400_001, dtype=torch.float64)
    density = mixture.log_density(grid[:, None]).exp()
    assert float(torch.trapezoid(density, grid)) == pytest.approx(1.0, abs=1e-6)


def test_draws_have_the_density_they_are_said_to_have() -> None:
    """The mean of p / q over draws of q is 1 for any normalised p: here a shifted mixture."""
    mixture = two_components(2)
    other = StudentMixture(mixture.log_share, mixture.mean + 0.3, mixture.factor)
    draws = mixture.sample(40_000, torch.Generator().manual_seed(2))
    ratio = (other.log_density(draws) - mixture.log_density(draws)).exp()
    error = float(ratio.std()) / 200
    assert abs(float(ratio.mean()) - 1) < 4 * error


def test_the_fit_finds_two_separate_groups_and_heeds_weights() -> None:
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(2000, 2, generator=generator, dtype=torch.float64)
    points[1000:] += 10.0
    weights = torch.ones(2000, dtype=torch.float64)
    weights[1000:] = 3.0
    # Started at random particles, a fit can miss a group; most starts find both.
    found = []
    for seed in range(6):
        start = torch.Generator().manual_seed(seed)
        mixture = fit_student_mixture(points, weights / weights.sum(), 2, start, rounds=30)
        order = mixture.mean[:, 0].argsort()
        centre = torch.tensor([[0.0, 0.0], [10.0, 10.0]], dtype=torch.float64)
        close = (mixture.mean[order] - centre).abs().max() < 0.3
        share = mixture.log_share.exp()[order][1]
        found.append(bool(close) and abs(float(share) - 0.75) < 0.05)
    assert sum(found) >= 2


@pytest.mark.parametrize("copies", [1, 2])
def test_a_fit_to_one_or_two_different_points_stays_finite(copies: int) -> None:
    points = torch.arange(copies, dtype=torch.float64).repeat(50)[:, None].expand(-1, 3)
    weights = torch.full((len(points),), 1 / len(points), dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    mixture = fit_student_mixture(points.contiguous(), weights, 3, generator)
    assert torch.isfinite(mixture.log_density(mixture.sample(20, generator))).all()
