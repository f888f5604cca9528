"""Laws of the prior and of its unconstrained coordinates, and of what a belief reports."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import kstest

from tpcd.belief import EstimatorSettings
from tpcd.belief.belief import Belief, misfit_field
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.parameters import DEFAULT_BOUNDS
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.density import MaskDensity
from tpcd.shape.polygon import PolygonShape
from tpcd.shape.protocol import Misfit
from tpcd.simulator import StepSettings


class MaskShape(PolygonShape):
    """A fixed outline with a latent that changes nothing, valid on half of its square."""

    latent_dim = 2
    density = MaskDensity(torch.tensor([[True, False], [True, False]]))

    def valid(self, latent):
        return self.density.valid(latent)

    def log_density(self, latent):
        return self.density.log_density(latent)

    def latent_curvature(self, latent):
        return self.density.curvature(latent)

    def sample_latent(self, count, generator, checked=True):
        return self.density.sample(count, generator)


@pytest.fixture(scope="module")
def prior() -> ParameterPrior:
    return make_prior(PolygonShape(builtin_outlines()["mug"]), {"friction": (0.2, 0.4)})


def test_draws_are_uniform_in_the_box(prior: ParameterPrior) -> None:
    """Kolmogorov-Smirnov for seven entries; false alarms of all together: 7e-4."""
    vectors = prior.to_vector(prior.sample(4000, torch.Generator().manual_seed(0)))
    for name, column, low, high in zip(
        prior.names, vectors.T, prior.low.tolist(), prior.high.tolist(), strict=True
    ):
        bounds = (0.2, 0.4) if name == "friction" else DEFAULT_BOUNDS[name]
        assert (low, high) == pytest.approx(bounds)
        assert kstest(column.numpy(), "uniform", (low, high - low)).pvalue > 1e-4


def test_coordinates_and_theta_are_inverse_to_each_other(prior: ParameterPrior) -> None:
    score = prior.sample(500, torch.Generator().manual_seed(1))
    torch.testing.assert_close(prior.to_score(prior.to_vector(score)), score, atol=1e-8, rtol=0)
    far = torch.full((2, prior.dimension), 40.0, dtype=torch.float64)
    far[1] = -40.0
    vectors = prior.to_vector(far)
    assert (vectors > prior.low).all()
    assert (vectors < prior.high).all()


def test_density_of_the_coordinates_is_that_of_theta_times_the_jacobian(
    prior: ParameterPrior,
) -> None:
    score = prior.sample(20, torch.Generator().manual_seed(2)).requires_grad_()
    slope = torch.autograd.grad(prior.to_vector(score).sum(), score)[0]
    uniform = -(prior.high - prior.low).log().sum()
    expected = uniform + slope.log().sum(-1)
    torch.testing.assert_close(prior.log_density(score.detach()), expected)


def test_density_with_a_masked_latent_integrates_to_one_and_fits_its_draws() -> None:
    prior = make_prior(MaskShape(builtin_outlines()["mug"]))
    standard = torch.randn(20_000, 9, generator=torch.Generator().manual_seed(3)).double()
    normal = torch.distributions.Normal(0.0, 1.0).log_prob(standard).sum(-1)
    ratio = (prior.log_density(standard) - normal).exp()
    assert float(ratio.mean()) == pytest.approx(1.0, abs=0.04)
    draws = prior.sample(1000, torch.Generator().manual_seed(4))
    assert torch.isfinite(prior.log_density(draws)).all()
    assert prior.shape.valid(prior.to_vector(draws)[:, :2]).all()


def test_unknown_names_and_empty_bounds_are_refused() -> None:
    shape = PolygonShape(builtin_outlines()["mug"])
    with pytest.raises(ValueError, match="no parameter 'grip'"):
        make_prior(shape, {"grip": (0.0, 1.0)})
    with pytest.raises(ValueError, match="low < high"):
        make_prior(shape, {"scale": (1.0, 1.0)})


def test_summaries_of_a_belief_are_those_of_its_weighted_particles(prior: ParameterPrior) -> None:
    vectors = torch.arange(5, dtype=torch.float64)[:, None].expand(-1, 7).contiguous()
    weights = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    belief = Belief(
        prior=prior,
        vectors=vectors,
        weights=weights,
        misfit=MisfitField(sd=0.0),
        misfit_sd=torch.zeros(5, dtype=torch.float64),
        misfit_mean=torch.zeros(5, 0, dtype=torch.float64),
        misfit_covariance=torch.zeros(5, 0, 0, dtype=torch.float64),
        step=StepSettings(),
        stiffness=torch.ones(3, dtype=torch.float64),
        log_evidence=0.0,
        log_evidence_std=0.0,
    )
    assert belief.mean().tolist() == pytest.approx([3.0] * 7)
    assert belief.std().tolist() == pytest.approx([1.0] * 7)
    levels = {0.05: 1.0, 0.25: 2.0, 0.5: 3.0, 0.95: 4.0}
    for level, value in levels.items():
        assert belief.quantile(level).tolist() == [value] * 7


def test_bumps_of_the_misfit_sum_to_its_variance_and_have_the_stated_correlation() -> None:
    field = MisfitField(sd=1.0, width=0.15, reach=0.9)
    angles = torch.linspace(-0.3, 0.3, 31, dtype=torch.float64)
    value, slope = field.basis(angles)
    expected = torch.exp(-((angles[:, None] - angles) ** 2) / (4 * field.width**2))
    torch.testing.assert_close(value @ value.T, expected, atol=2e-4, rtol=0)
    step = 1e-6
    numeric = (field.basis(angles + step)[0] - field.basis(angles - step)[0]) / (2 * step)
    torch.testing.assert_close(slope, numeric, atol=1e-7, rtol=0)


@pytest.mark.parametrize("name", ["ycb21-z2", "ycb-rich"])
def test_gradient_of_the_log_prior_is_exact_and_its_precision_positive(name: str) -> None:
    prior = make_prior(load_prior(name))
    score = prior.sample(30, torch.Generator().manual_seed(3)).requires_grad_(True)
    (expected,) = torch.autograd.grad(prior.log_density(score).sum(), score)
    gradient, precision = prior.curvature(score.detach())
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-6)
    assert (torch.linalg.eigvalsh(precision)[:, 0] > 0.99).all()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, (2e-3, 1.7)),
        ({"misfit_spread": 0.0}, (2e-3, 0.0)),
        ({"misfit_sd": 5e-4}, (5e-4, 1.0)),
        ({"misfit_sd": 5e-4, "misfit_spread": 0.3}, (5e-4, 0.3)),
        ({"least_misfit_spread": 2.0}, (2e-3, 2.0)),
        ({"misfit_sd": 0.0}, (1e-4, 1.0)),
    ],
)
def test_the_misfit_is_that_of_the_shape_where_nothing_else_is_said(settings, expected) -> None:
    own = Misfit(2e-3, 1.7, 0.2, 0.06, 2.0)
    shape = PolygonShape(builtin_outlines()["mug"], misfit=own)
    field = misfit_field(shape, EstimatorSettings(**settings))
    assert (field.sd, field.spread) == expected
    assert (field.width, field.grain, field.roughness) == (0.2, 0.06, 2.0)
