"""Expected information gain: closed forms, brute force, and laws that hold for any belief."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tpcd.information import (
    GridSettings,
    Outcomes,
    expected_information_gain,
    expected_variance,
    field_gain,
    grid_commands,
    grid_gain,
    pair_log_likelihood,
    present_variance,
    reweight,
)
from tpcd.information.gain import cubature_points, outcome_points
from tpcd.information.outcomes import reading_variance
from tpcd.prediction import Prediction


def linear_outcomes(
    theta: Tensor, sensitivity: Tensor, noise: float, weights: Tensor | None = None
) -> Outcomes:
    """y = A theta + e with e ~ N(0, noise^2 I), for every A (c, k, d)."""
    c, k, _ = sensitivity.shape
    m = len(theta)
    if weights is None:
        weights = torch.full((m,), 1.0 / m, dtype=torch.float64)
    factor = noise * torch.eye(k, dtype=torch.float64)
    return Outcomes(
        torch.einsum("cij,mj->cmi", sensitivity, theta),
        factor.expand(c, m, k, k),
        weights.expand(c, m),
    )


def with_fields(outcomes: Outcomes, fields: Tensor) -> Outcomes:
    """Outcomes that answer besides to numbers that a particle does not know, by B (c, m, k, j), or
    (c, k, j) for all particles."""
    if fields.ndim == 3:
        fields = fields[:, None].expand(-1, outcomes.mean.shape[1], -1, -1)
    covariance = outcomes.factor @ outcomes.factor.mT + fields @ fields.mT
    return replace(outcomes, factor=torch.linalg.cholesky(covariance), field=fields)


def random_outcomes(m: int, c: int, seed: int) -> Outcomes:
    generator = torch.Generator().manual_seed(seed)
    mean = torch.randn(c, m, 3, generator=generator, dtype=torch.float64)
    root = torch.randn(c, m, 3, 3, generator=generator, dtype=torch.float64)
    covariance = 0.1 * root @ root.mT + 0.05 * torch.eye(3, dtype=torch.float64)
    weights = torch.rand(m, generator=generator, dtype=torch.float64)
    return Outcomes(mean, torch.linalg.cholesky(covariance), (weights / weights.sum()).expand(c, m))


def random_fields(m: int, c: int, seed: int) -> Outcomes:
    """Random outcomes, in which each particle leaves something of its own open."""
    outcomes = random_outcomes(m, c, seed)
    generator = torch.Generator().manual_seed(seed + 1)
    field = 0.3 * torch.randn(c, m, 3, 4, generator=generator, dtype=torch.float64)
    return with_fields(outcomes, field)


def sensitivities(seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([0.05, 0.2, 0.5, 1.0], dtype=torch.float64)[:, None, None]
    return scale * torch.randn(4, 3, 2, generator=generator, dtype=torch.float64)


def test_the_gain_in_a_linear_normal_model_is_the_closed_form() -> None:
    """1/2 log det(I + A A^T / s^2) for theta ~ N(0, I)."""
    theta = torch.randn(2500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    matrices = sensitivities()
    found = expected_information_gain(linear_outcomes(theta, matrices, 0.5))
    expected = 0.5 * torch.logdet(
        torch.eye(3, dtype=torch.float64) + matrices @ matrices.mT / 0.5**2
    )
    torch.testing.assert_close(found, expected, atol=0.03, rtol=0.03)


def test_the_gain_of_theta_and_field_in_a_linear_normal_model_is_the_closed_form() -> None:
    """1/2 log det(I + (A A^T + B B^T) / s^2), whether particles hold theta or leave all open."""
    theta = torch.randn(2500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    known, open_ = sensitivities(), sensitivities(8).flip(0)
    found = expected_information_gain(with_fields(linear_outcomes(theta, known, 0.5), open_))
    both = torch.cat((known, open_), dim=-1)
    one = torch.eye(3, dtype=torch.float64)
    expected = 0.5 * torch.logdet(one + both @ both.mT / 0.5**2)
    torch.testing.assert_close(found, expected, atol=0.03, rtol=0.03)
    alone = with_fields(linear_outcomes(0.0 * theta[:3], known, 0.5), both)
    torch.testing.assert_close(expected_information_gain(alone), expected)


def test_the_gain_agrees_with_nested_monte_carlo() -> None:
    """Outcomes drawn at random from a mixture, each weighed against all components."""
    outcomes = random_outcomes(12, 3, 2)
    found = expected_information_gain(outcomes)
    generator = torch.Generator().manual_seed(3)
    weights = outcomes.weights[0]
    for c in range(3):
        truth = torch.multinomial(weights, 200_000, replacement=True, generator=generator)
        noise = torch.randn(len(truth), 3, generator=generator, dtype=torch.float64)
        drawn = outcomes.mean[c, truth] + torch.einsum(
            "nij,nj->ni", outcomes.factor[c, truth], noise
        )
        components = torch.distributions.MultivariateNormal(
            outcomes.mean[c], scale_tril=outcomes.factor[c]
        )
        log_likelihood = components.log_prob(drawn[:, None])
        posterior = (log_likelihood + weights.log()).softmax(-1)
        divergence = torch.special.xlogy(posterior, posterior / weights).sum(-1)
        # The cubature of the noise is exact to the third degree only.
        assert float(found[c]) == pytest.approx(float(divergence.mean()), rel=0.06)


def test_pairs_hold_the_normal_log_density() -> None:
    outcomes = random_outcomes(5, 2, 4)
    found, share = pair_log_likelihood(outcomes)
    points = cubature_points(3)
    for c in range(2):
        for i in range(5):
            drawn = outcomes.mean[c, i] + points @ outcomes.factor[c, i].T
            for j in range(5):
                normal = torch.distributions.MultivariateNormal(
                    outcomes.mean[c, j], scale_tril=outcomes.factor[c, j]
                )
                expected = normal.log_prob(drawn) + 1.5 * math.log(2 * math.pi)
                torch.testing.assert_close(found[c, 6 * i : 6 * i + 6, j], expected)
    torch.testing.assert_close(share.sum(-1), torch.ones(2, dtype=torch.float64))


def _of_particles(outcomes: Outcomes, index: Tensor) -> Outcomes:
    return Outcomes(**{name: part[:, index] for name, part in vars(outcomes).items()})


@settings(deadline=None, max_examples=25)
@given(m=st.integers(2, 30), seed=st.integers(0, 10_000))
def test_permuting_or_splitting_particles_changes_nothing(m: int, seed: int) -> None:
    outcomes = random_fields(m, 2, seed)
    values = torch.randn(m, 3, generator=torch.Generator().manual_seed(seed)).double()
    field = torch.randn(m, 3, 4, generator=torch.Generator().manual_seed(seed)).double()
    order = torch.randperm(m, generator=torch.Generator().manual_seed(seed))
    turned = _of_particles(outcomes, order)
    twice = torch.cat((torch.arange(m), torch.arange(m)))
    split = _of_particles(outcomes, twice)
    split = replace(split, weights=split.weights / 2)
    gain = expected_information_gain(outcomes)
    assert (field_gain(outcomes) > 0).all()
    assert (gain <= math.log(m) + field_gain(outcomes) + 1e-9).all()
    torch.testing.assert_close(expected_information_gain(turned), gain)
    torch.testing.assert_close(expected_information_gain(split), gain)
    variance = expected_variance(outcomes, values, field)
    for same, index in ((turned, order), (split, twice)):
        found = expected_variance(same, values[index], field[index])
        torch.testing.assert_close(found, variance)


def test_a_command_that_cannot_inform_gains_nothing() -> None:
    outcomes = random_outcomes(20, 1, 5)
    same = Outcomes(
        outcomes.mean[:, :1].expand_as(outcomes.mean),
        outcomes.factor[:, :1].expand_as(outcomes.factor),
        outcomes.weights,
    )
    assert float(expected_information_gain(same)) < 1e-12
    values = torch.randn(20, 2, generator=torch.Generator().manual_seed(0)).double()
    weights = outcomes.weights[0]
    now = (weights[:, None] * (values - weights @ values).square()).sum(0).mean()
    found = expected_variance(same, values)
    assert float(found) == pytest.approx(float(now))


@pytest.mark.parametrize("known", ["theta", "both", "field"])
def test_expected_variance_in_a_linear_normal_model_is_the_closed_form(known: str) -> None:
    """v = T x and y = H x + e, x ~ N(0, I), of which particles hold a part and leave a part open:
    what is left has the covariance T (I + H^T H / s^2)^-1 T^T."""
    generator = torch.Generator().manual_seed(6)
    theta = torch.randn(1000, 2, generator=generator, dtype=torch.float64)
    held, open_ = sensitivities(1), sensitivities(2).flip(0)
    task = torch.tensor([[1.0, 0.0, -0.5, 1.0], [0.5, -2.0, 1.5, 0.5]], dtype=torch.float64)
    if known == "theta":
        open_, task = 0.0 * open_, task * torch.tensor([1.0, 1.0, 0.0, 0.0])
    if known == "field":
        held, task = 0.0 * held, task * torch.tensor([0.0, 0.0, 1.0, 1.0])
    outcomes = with_fields(linear_outcomes(theta, held, 0.5), open_)
    values, field = theta @ task[:, :2].T, task[:, 2:].expand(1000, 2, 2)
    now = present_variance(outcomes.weights, values, field)
    torch.testing.assert_close(now, task.square().sum(1).mean().expand(4), rtol=0.06, atol=0.0)
    found = expected_variance(outcomes, values, field)
    for c in range(4):
        both = torch.cat((held[c], open_[c]), dim=-1)
        precision = torch.eye(4, dtype=torch.float64) + both.T @ both / 0.5**2
        covariance = task @ torch.linalg.solve(precision, task.T)
        assert float(found[c]) == pytest.approx(float(covariance.diagonal().mean()), rel=0.06)


def test_two_outcomes_tell_what_both_together_do() -> None:
    """The gain of the first, and that of the second in the mean over what the first may be, add
    up to the closed form of both; the first one again teaches less than another."""
    theta = torch.randn(300, 2, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    held, open_ = sensitivities(1), sensitivities(2).flip(0)
    outcomes = with_fields(linear_outcomes(theta, held, 0.5), open_)
    both = torch.cat((held, open_), dim=-1)
    first = expected_information_gain(outcomes)
    for c in (1, 3):
        log_likelihood, _ = pair_log_likelihood(outcomes)
        posterior, _ = reweight(log_likelihood, outcomes.weights)
        told, _ = outcome_points(outcomes)
        told = told + (outcomes.weights[..., None] * outcomes.mean).sum(1, keepdim=True)
        rows = range(0, told.shape[1], told.shape[1] // 60 + 1)
        second = torch.stack(
            [
                expected_information_gain(
                    replace(outcomes, weights=posterior[c, row].expand(4, -1)).after(
                        outcomes, c, told[c, row]
                    )
                )
                for row in rows
            ]
        ).mean(0)
        for other in range(4):
            stacked = torch.cat((both[c], both[other]))
            one = torch.eye(6, dtype=torch.float64)
            expected = 0.5 * float(torch.logdet(one + stacked @ stacked.mT / 0.5**2))
            assert float(first[c] + second[other]) == pytest.approx(expected, rel=0.06)


def test_without_fields_nothing_is_learnt_of_them() -> None:
    outcomes = random_outcomes(7, 2, 3)
    values = torch.randn(7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    field = torch.ones(7, 3, 4, dtype=torch.float64)
    found = expected_variance(outcomes, values, field) - expected_variance(outcomes, values)
    torch.testing.assert_close(found, torch.full((2,), 4.0, dtype=torch.float64))
    assert outcomes.after(outcomes, 0, outcomes.mean[0, 0]) is outcomes
    none = with_fields(outcomes, torch.zeros(2, 3, 0, dtype=torch.float64))
    torch.testing.assert_close(expected_variance(none, values), expected_variance(outcomes, values))
    torch.testing.assert_close(expected_information_gain(none), expected_information_gain(outcomes))


def test_gains_have_gradients() -> None:
    outcomes = random_fields(6, 2, 4)
    mean = outcomes.mean.clone().requires_grad_()
    moved = replace(outcomes, mean=mean)

    def gain(mean: Tensor) -> Tensor:
        return expected_information_gain(replace(moved, mean=mean))

    assert torch.autograd.gradcheck(gain, mean)


def test_without_noise_the_gain_stays_finite() -> None:
    """A field that is all of the covariance, in one direction as in all."""
    for rank in (1, 3):
        field = torch.eye(3, dtype=torch.float64)[:, :rank].expand(1, 2, 3, rank)
        covariance = field @ field.mT + 1e-18 * torch.eye(3, dtype=torch.float64)
        outcomes = replace(random_outcomes(2, 1, 0), factor=torch.linalg.cholesky(covariance))
        outcomes = replace(outcomes, field=field)
        gain = field_gain(outcomes)
        assert torch.isfinite(gain).all() and float(gain) > 5.0
        after = outcomes.after(outcomes, 0, outcomes.mean[0, 0])
        for value in (after.mean, after.factor, after.field, field_gain(after)):
            assert torch.isfinite(value).all()


def test_weightless_particles_and_far_outcomes_stay_finite() -> None:
    outcomes = random_outcomes(6, 1, 7)
    weights = torch.tensor([0.5, 0.5, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    far = replace(outcomes, mean=1e4 * outcomes.mean, weights=weights.expand(1, 6))
    gain = expected_information_gain(far)
    assert float(gain) == pytest.approx(math.log(2.0))
    posterior, log_norm = reweight(pair_log_likelihood(far)[0], far.weights)
    assert torch.isfinite(posterior).all() and torch.isfinite(log_norm).all()


def test_pose_and_wrench_together_read_better_than_either() -> None:
    std = torch.tensor([3e-3, 1e-3, 5e-4, 0.4, 0.0, 0.02], dtype=torch.float64)
    stiffness = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
    found = reading_variance(std, stiffness)
    expected = [1 / (1 / 9e-6 + 1 / 1.6e-5), 0.0, 1 / (1 / 2.5e-7 + 1 / 1.6e-7)]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def prediction_of(mean: Tensor, weights: Tensor) -> Prediction:
    """A prediction (m particles, n commands) without spread."""
    m, n, _ = mean.shape
    return Prediction(
        command=torch.zeros(n, 3, dtype=torch.float64),
        stiffness=torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64),
        weights=weights[:, None].expand(m, n),
        component_mean=mean,
        component_covariance=torch.zeros(m, n, 3, 3, dtype=torch.float64),
        component_mode=torch.zeros(m, n, 2, dtype=torch.long),
        answered=torch.ones(n, dtype=torch.bool),
        sensor_variance=torch.zeros(6, dtype=torch.float64),
    )


def test_the_grid_is_the_papers() -> None:
    basic = torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64)
    commands = grid_commands(basic)
    assert len(commands.unique(dim=0)) == 27
    torch.testing.assert_close(commands.mean(0), basic)
    reach = torch.tensor([0.03, 0.03, 0.025], dtype=torch.float64)
    torch.testing.assert_close(commands.max(0).values - basic, reach)
    assert (commands == basic).all(-1).any()


def test_the_grids_gain_is_the_divergence_of_the_papers_weights() -> None:
    """Written out particle by particle, with the weights w_i e^(-e R^-1 e / 2)."""
    generator = torch.Generator().manual_seed(8)
    mean = 0.02 * torch.randn(40, 3, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(40, generator=generator, dtype=torch.float64)
    weights = weights / weights.sum()
    prediction = prediction_of(mean, weights)
    found = grid_gain(prediction)
    scale = torch.tensor(GridSettings().covariance, dtype=torch.float64)
    for c in range(3):
        rows = torch.cat((prediction.stiffness * mean[:, c], mean[:, c]), dim=-1)
        expected = 0.0
        for i in range(40):
            likelihood = torch.exp(-0.5 * ((rows - rows[i]) ** 2 / scale).sum(-1))
            after = weights * likelihood / (weights @ likelihood)
            expected += float(weights[i] * (after * (after / weights).log()).sum())
        assert float(found[c]) == pytest.approx(expected, rel=1e-4)
    same = prediction_of(mean[:1].expand_as(mean), weights)
    assert float(grid_gain(same).max()) < 1e-6
