"""The curved mixture: density, sampling, and components from the curvature of a target."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t
from torch import Tensor

from tpcd.belief.proposals import DEGREES_OF_FREEDOM, CurvedMixture, curved_mixture

COUNTS = torch.tensor([2.0, 1.0], dtype=torch.float64)
DAMPINGS = (0.5, 6.0)


def mixture_of(dimension: int, places: int = 2, counts: Tensor = COUNTS) -> CurvedMixture:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    root = normal(places, dimension, dimension)
    return curved_mixture(
        normal(places, dimension),
        normal(places, dimension),
        root @ root.mT,
        counts,
        dampings=DAMPINGS,
    )


def centres_and_scales(mixture: CurvedMixture) -> tuple[Tensor, Tensor]:
    """Centre (k, t, d) and scale matrix (k, t, d, d) of every component."""
    along = mixture.place[:, None] + mixture.offset
    centre = torch.einsum("kab,kta->ktb", mixture.axes, along)
    scale = torch.einsum("kab,kta,kac->ktbc", mixture.axes, mixture.spread**2, mixture.axes)
    return centre, scale


def test_density_is_that_of_scipy() -> None:
    mixture = mixture_of(3)
    points = 2 * torch.randn(50, 3, generator=torch.Generator().manual_seed(1)).double()
    centre, scale = (v.flatten(0, 1).numpy() for v in centres_and_scales(mixture))
    share = (mixture.counts / mixture.counts.sum()).flatten().tolist()
    expected = sum(
        part * multivariate_t(mean, matrix, df=DEGREES_OF_FREEDOM).pdf(points.numpy())
        for part, mean, matrix in zip(share, centre, scale, strict=True)
    )
    np.testing.assert_allclose(mixture.log_density(points).exp().numpy(), expected, rtol=1e-9)


@pytest.mark.parametrize("dimension", [1, 4, 7])
def test_far_points_have_the_density_of_the_formula_too(dimension: int) -> None:
    """And so have components that are never drawn from."""
    mixture = mixture_of(dimension, 30, torch.tensor([3.0, 0.0], dtype=torch.float64))
    points = torch.randn(300, dimension, generator=torch.Generator().manual_seed(1)).double()
    points[:100] *= 1e4
    d, nu = dimension, DEGREES_OF_FREEDOM
    along = torch.einsum("kab,mb->mka", mixture.axes, points) - mixture.place
    square = ((along[:, :, None] - mixture.offset) / mixture.spread).square().sum(-1)
    peak = mixture.counts.log() - mixture.spread.log().sum(-1)
    expected = torch.logsumexp(peak - (nu + d) / 2 * torch.log1p(square / nu), dim=1)
    expected += math.lgamma((nu + d) / 2) - math.lgamma(nu / 2) - d / 2 * math.log(nu * math.pi)
    torch.testing.assert_close(mixture.log_sums(points), expected, rtol=1e-9, atol=1e-9)
    assert (expected[:, 1] == -torch.inf).all()


def test_density_integrates_to_one() -> None:
    mixture = mixture_of(1)
    grid = torch.linspace(-200, 200, 400_001, dtype=torch.float64)
    density = mixture.log_density(grid[:, None]).exp()
    assert float(torch.trapezoid(density, grid)) == pytest.approx(1.0, abs=1e-6)


def test_draws_come_as_often_as_components_count_and_have_the_density_they_are_said_to_have() -> (
    None
):
    """The mean of p / q over draws of q is 1 for any normalised p: here a single component."""
    counts = torch.tensor([6000.0, 4000.0], dtype=torch.float64)
    mixture = mixture_of(2, 2, counts)
    draws = mixture.draw(torch.Generator().manual_seed(2))
    assert len(draws) == 20_000
    log_density = mixture.log_density(draws)
    other = mixture_of(2, 2, torch.tensor([0.0, 1.0], dtype=torch.float64))
    ratio = (other.log_density(draws) - log_density).exp()
    error = float(ratio.std()) / math.sqrt(len(draws))
    assert abs(float(ratio.mean()) - 1) < 4 * error


def test_some_draws_are_spread_over_the_components_by_their_counts() -> None:
    mixture = mixture_of(2, 2, torch.tensor([3.0, 0.0], dtype=torch.float64))
    far = CurvedMixture(
        mixture.axes,
        mixture.place + torch.tensor([[0.0], [1e6]]).double(),
        mixture.offset,
        mixture.spread,
        torch.tensor([[3.0, 0.0], [1.0, 0.0]]).double(),
    )
    draws = far.draw_some(400, torch.Generator().manual_seed(0))
    assert int((draws.norm(dim=-1) > 1e5).sum()) == 100
    assert len(draws) == 400


def test_joined_mixtures_add_up_their_components() -> None:
    mixture, other = mixture_of(2), mixture_of(2, 5)
    points = torch.randn(30, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    joined = CurvedMixture.joined([mixture, other])
    expected = mixture.log_sum(points).exp() + other.log_sum(points).exp()
    torch.testing.assert_close(joined.log_sum(points).exp(), expected)
    assert float(joined.counts.sum()) == float(mixture.counts.sum() + other.counts.sum())


def test_a_whole_newton_step_from_anywhere_gives_a_normal_target_itself() -> None:
    generator = torch.Generator().manual_seed(5)
    root = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    mean = torch.randn(3, generator=generator, dtype=torch.float64)
    information = root @ root.T + torch.eye(3, dtype=torch.float64)
    points = 3 * torch.randn(6, 3, generator=generator, dtype=torch.float64)
    gradient = (mean - points) @ information
    one = torch.ones(1, dtype=torch.float64)
    mixture = curved_mixture(
        points, gradient, information.expand(6, 3, 3), one, share=1.0, dampings=(0.0,)
    )
    centre, scale = centres_and_scales(mixture)
    torch.testing.assert_close(centre[:, 0], mean.expand(6, 3))
    torch.testing.assert_close(scale[:, 0], torch.linalg.inv(information).expand(6, 3, 3))


def test_damping_shortens_flat_directions_and_leaves_steep_ones() -> None:
    information = torch.diag(torch.tensor([1e4, 0.01], dtype=torch.float64))[None]
    gradient = torch.tensor([[100.0, 0.01]], dtype=torch.float64)
    mixture = curved_mixture(
        torch.zeros(1, 2).double(), gradient, information, COUNTS, share=1.0, dampings=(0.0, 4.0)
    )
    centre, scale = (v[0] for v in centres_and_scales(mixture))
    torch.testing.assert_close(centre[0], torch.tensor([0.01, 1.0]).double())
    assert scale[0].diagonal().tolist() == pytest.approx([1e-4, 100.0])
    assert scale[1].diagonal().tolist() == pytest.approx([1e-4, 1 / 4.01], rel=1e-3)
    assert abs(float(centre[1, 1])) < 0.01
