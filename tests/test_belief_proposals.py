"""The Student mixture: density, sampling, and components from the curvature of a target."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t

from tpcd.belief.proposals import DEGREES_OF_FREEDOM, StudentMixture, newton_mixture


def two_components(dimension: int) -> StudentMixture:
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(2, dimension, dimension, generator=generator, dtype=torch.float64).tril()
    factor.diagonal(dim1=-2, dim2=-1).abs_().add_(0.4)
    mean = torch.randn(2, dimension, generator=generator, dtype=torch.float64)
    return StudentMixture(mean, factor)


def test_density_is_that_of_scipy() -> None:
    mixture = two_components(3)
    points = 2 * torch.randn(50, 3, generator=torch.Generator().manual_seed(1)).double()
    scales = (mixture.factor @ mixture.factor.mT).numpy()
    expected = sum(
        0.5 * multivariate_t(mean, scale, df=DEGREES_OF_FREEDOM).pdf(points.numpy())
        for mean, scale in zip(mixture.mean.numpy(), scales, strict=True)
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
    other = StudentMixture(mixture.mean + 0.3, mixture.factor)
    draws = mixture.sample(40_000, torch.Generator().manual_seed(2))
    ratio = (other.log_density(draws) - mixture.log_density(draws)).exp()
    error = float(ratio.std()) / 200
    assert abs(float(ratio.mean()) - 1) < 4 * error


def test_joined_mixtures_weigh_all_components_alike() -> None:
    mixture = two_components(2)
    other = StudentMixture(mixture.mean[:1] + 2.0, mixture.factor[:1])
    points = torch.randn(30, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    joined = StudentMixture.joined([mixture, other])
    expected = (2 * mixture.log_density(points).exp() + other.log_density(points).exp()) / 3
    torch.testing.assert_close(joined.log_density(points).exp(), expected)


def normal_target(dimension: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and information of a normal target."""
    generator = torch.Generator().manual_seed(5)
    root = torch.randn(dimension, dimension, generator=generator, dtype=torch.float64)
    mean = torch.randn(dimension, generator=generator, dtype=torch.float64)
    return mean, root @ root.T + torch.eye(dimension, dtype=torch.float64)


def test_a_whole_newton_step_from_anywhere_gives_a_normal_target_itself() -> None:
    mean, information = normal_target(3)
    points = 3 * torch.randn(6, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    gradient = (mean - points) @ information
    mixture = newton_mixture(points, gradient, information.expand(6, 3, 3), share=1.0)
    torch.testing.assert_close(mixture.mean, mean.expand(6, 3))
    covariance = mixture.factor @ mixture.factor.mT
    torch.testing.assert_close(covariance, torch.linalg.inv(information).expand(6, 3, 3))


def test_components_at_draws_of_a_normal_target_have_its_mean_and_covariance() -> None:
    """For any share of the step: the mixture of 20,000 components keeps both moments."""
    mean, information = normal_target(2)
    covariance = torch.linalg.inv(information)
    normal = torch.randn(20_000, 2, generator=torch.Generator().manual_seed(1)).double()
    points = mean + normal @ torch.linalg.cholesky(covariance).T
    gradient = (mean - points) @ information
    mixture = newton_mixture(points, gradient, information.expand(20_000, 2, 2), share=0.4)
    torch.testing.assert_close(mixture.mean.mean(0), mean, atol=0.02, rtol=0)
    within = (mixture.factor @ mixture.factor.mT)[0]
    torch.testing.assert_close(within + torch.cov(mixture.mean.T), covariance, atol=0.02, rtol=0)
