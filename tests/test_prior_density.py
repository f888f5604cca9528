"""Laws of the latent densities: normalised, drawn where valid, -inf elsewhere."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch

from tpcd.shape.density import MaskDensity, MixtureDensity


@pytest.fixture
def mask() -> MaskDensity:
    cells = torch.rand(16, 16, generator=torch.Generator().manual_seed(0)) < 0.6
    return MaskDensity(cells)


@pytest.fixture
def mixture() -> MixtureDensity:
    generator = torch.Generator().manual_seed(1)
    means = 0.5 * torch.randn(4, 3, generator=generator, dtype=torch.float64)
    factors = 0.2 * torch.eye(3, dtype=torch.float64).expand(4, 3, 3).contiguous()
    weights = torch.full((4,), 0.25, dtype=torch.float64)
    whole = MixtureDensity(weights, means, factors, -2.0, 1.0)
    draws = whole.raw_sample(200_000, generator)
    kept = float(whole.valid(draws).double().mean())
    return MixtureDensity(weights, means, factors, -2.0, kept)


def test_mask_density_integrates_to_one(mask: MaskDensity) -> None:
    side = (torch.arange(160, dtype=torch.float64) + 0.5) / 80 - 1
    density = mask.log_density(torch.cartesian_prod(side, side)).exp()
    assert float(density.mean() * 4) == pytest.approx(1.0, abs=1e-12)


def test_mask_draws_are_valid_and_fill_every_valid_cell(mask: MaskDensity) -> None:
    draws = mask.sample(20_000, torch.Generator().manual_seed(2))
    assert draws.dtype == torch.float64
    assert mask.valid(draws).all()
    index = ((draws + 1) * 8).long()
    counts = torch.zeros(16, 16).index_put((index[:, 0], index[:, 1]), torch.ones(20_000), True)
    assert torch.equal(counts > 0, mask.cells)
    expected = 20_000 / int(mask.cells.sum())
    # 5 sigma of a binomial count, for each of at most 256 cells.
    assert (counts[mask.cells] - expected).abs().max() < 5 * math.sqrt(expected)


def test_outside_the_box_and_nan_are_not_valid(mask: MaskDensity, mixture: MixtureDensity) -> None:
    for density, z in ((mask, 2), (mixture, 3)):
        outside = torch.full((2, z), 1.5, dtype=torch.float64)
        outside[1] = torch.nan
        assert not density.valid(outside).any()
        assert (density.log_density(outside) == -torch.inf).all()


def test_mixture_density_integrates_to_one(mixture: MixtureDensity) -> None:
    uniform = 2 * torch.rand(400_000, 3, generator=torch.Generator().manual_seed(3)).double() - 1
    values = mixture.log_density(uniform).exp() * 8
    error = float(values.std() / math.sqrt(len(values)))
    assert float(values.mean()) == pytest.approx(1.0, abs=5 * error + 0.01)


def test_mixture_draws_are_valid_and_have_the_density(mixture: MixtureDensity) -> None:
    draws = mixture.sample(50_000, torch.Generator().manual_seed(4))
    assert len(draws) == 50_000
    assert mixture.valid(draws).all()
    # E[1 / density] over the draws is the volume of the valid region.
    volume = (-mixture.log_density(draws)).exp().mean()
    uniform = 2 * torch.rand(400_000, 3, generator=torch.Generator().manual_seed(5)).double() - 1
    assert float(volume) == pytest.approx(
        float(mixture.valid(uniform).double().mean() * 8), rel=0.1
    )


def test_mixture_log_density_agrees_with_torch_distributions(mixture: MixtureDensity) -> None:
    components = torch.distributions.MultivariateNormal(mixture.means, scale_tril=mixture.factors)
    reference = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(mixture.weights), components
    )
    points = torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(6)).double()
    torch.testing.assert_close(mixture.raw_log_density(points), reference.log_prob(points))


def test_mixture_curvature_has_the_gradient_and_bounds_the_hessian(mixture: MixtureDensity) -> None:
    points = mixture.sample(20, torch.Generator().manual_seed(8)).requires_grad_(True)
    (expected,) = torch.autograd.grad(mixture.raw_log_density(points).sum(), points)
    gradient, precision = mixture.curvature(points.detach())
    torch.testing.assert_close(gradient, expected)
    hessian = torch.stack(
        [torch.autograd.functional.hessian(mixture.raw_log_density, p.detach()) for p in points]
    )
    assert (torch.linalg.eigvalsh(precision + hessian) > -1e-9).all()
    assert (torch.linalg.eigvalsh(precision) > 0).all()


def test_a_mask_is_flat(mask: MaskDensity) -> None:
    gradient, precision = mask.curvature(mask.sample(5, torch.Generator().manual_seed(8)))
    assert gradient.shape == (5, 2) and not gradient.any()
    assert precision.shape == (5, 2, 2) and not precision.any()


@pytest.mark.parametrize("name", ["mask", "mixture"])
def test_densities_survive_being_stored(name: str, request: pytest.FixtureRequest) -> None:
    density = request.getfixturevalue(name)
    again = type(density).from_tensors(density.tensors())
    draws = density.sample(500, torch.Generator().manual_seed(7))
    torch.testing.assert_close(again.log_density(draws), density.log_density(draws))


@pytest.fixture
def overlapping() -> MixtureDensity:
    """Near its floor three components lie at one place, of which none reaches it alone."""
    means = torch.tensor([[0.0, 0.0], [0.05, 0.0], [0.0, 0.05], [-0.7, 0.7]]).double()
    factors = 0.25 * torch.eye(2, dtype=torch.float64).expand(4, 2, 2).contiguous()
    return MixtureDensity(torch.full((4,), 0.25, dtype=torch.float64), means, factors, -1.0, 0.9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_latent_is_valid_where_the_whole_sum_is_above_the_floor(
    overlapping: MixtureDensity, dtype: torch.dtype
) -> None:
    """Also where no component is by itself."""
    side = torch.linspace(-1.2, 1.2, 201, dtype=torch.float64).to(dtype)
    latent = torch.cartesian_prod(side, side).reshape(201, 201, 2)
    expected = (latent.abs() <= 1).all(-1) & (overlapping.raw_log_density(latent) >= -1.0)
    assert torch.equal(overlapping.valid(latent), expected)
    assert torch.equal(overlapping.log_density(latent) > -torch.inf, expected)
    parts, _, _ = overlapping._parts(latent)
    alone = parts.amax(-1).reshape(201, 201) >= -1.0
    assert int((expected & alone).sum()) > 100 and int((expected & ~alone).sum()) > 100
    # Each latent for itself, and none at all.
    few = latent[::20, ::20].reshape(-1, 2)
    each = torch.stack([overlapping.valid(one) for one in few])
    assert torch.equal(overlapping.valid(few), each)
    assert overlapping.valid(latent[:0]).shape == (0, 201)


def test_absurd_latents_leave_their_neighbours_as_they_are(overlapping: MixtureDensity) -> None:
    latent = torch.zeros(5, 2, dtype=torch.float64)
    latent[1], latent[2, 0], latent[3] = torch.nan, torch.inf, 1e200
    assert overlapping.valid(latent).tolist() == [True, False, False, False, True]
    assert overlapping.valid(latent[1:4]).tolist() == [False] * 3


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda d: pickle.loads(pickle.dumps(d))])
def test_a_mixture_that_has_been_used_can_be_copied(mixture: MixtureDensity, copied) -> None:
    draws = mixture.sample(50, torch.Generator().manual_seed(9))
    assert torch.equal(copied(mixture).log_density(draws), mixture.log_density(draws))


def test_a_mixture_that_was_used_in_inference_mode_has_derivatives_after(
    mixture: MixtureDensity,
) -> None:
    latent = mixture.means.clone()
    with torch.inference_mode():
        assert mixture.valid(latent).all()
    (gradient,) = torch.autograd.grad(mixture.log_density(latent.requires_grad_()).sum(), latent)
    torch.testing.assert_close(gradient, mixture.curvature(latent.detach())[0])
