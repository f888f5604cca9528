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
    reweight,
)
from tpcd.information.gain import cubature_points
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
    """Outcomes that answer besides to numbers that no particle knows, for every B (c, k, j)."""
    covariance = outcomes.factor @ outcomes.factor.mT + (fields @ fields.mT)[:, None]
    spread = fields[:, None].expand(-1, outcomes.mean.shape[1], -1, -1)
    return replace(outcomes, factor=torch.linalg.cholesky(covariance), field=spread)


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
    covariance = outcomes.factor @ outcomes.factor.mT + field @ field.mT
    return replace(outcomes, factor=torch.linalg.cholesky(covariance), field=field)


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
    """1/2 log det(I + (A A^T + B B^T) / s^2), whichever of both the particles know."""
    theta = torch.randn(2500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    known, open_ = sensitivities(), sensitivities(8).flip(0)
    found = expected_information_gain(with_fields(linear_outcomes(theta, known, 0.5), open_))
    both = torch.cat((known, open_), dim=-1)
    one = torch.eye(3, dtype=torch.float64)
    expected = 0.5 * torch.logdet(one + both @ both.mT / 0.5**2)
    torch.testing.assert_close(found, expected, atol=0.03, rtol=0.03)
    alone = with_fields(linear_outcomes(0.0 * theta[:3], known, 0.5), both)
    torch.testing.assert_close(expected_information_gain(alone), expected)


def test_the_variance_expected_in_a_linear_normal_model_is_the_closed_form() -> None:
    """theta ~ N(0, I) has the covariance (I + A^T A / s^2)^-1 after the outcome."""
    theta = torch.randn(2500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    matrices, one = sensitivities(), torch.eye(2, dtype=torch.float64)
    task, scale = torch.tensor([[1.0, 0.5]], dtype=torch.float64), torch.ones(1).double()
    outcomes = linear_outcomes(theta, matrices, 0.5)
    variance = expected_variance(outcomes, theta @ task.T, scale)
    for found, matrix in zip(variance, matrices, strict=True):
        after = torch.linalg.inv(one + matrix.T @ matrix / 0.5**2)
        assert float(found) == pytest.approx(float(task @ after @ task.T), rel=0.06)


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
    scale = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    order = torch.randperm(m, generator=torch.Generator().manual_seed(seed))
    turned = _of_particles(outcomes, order)
    twice = torch.cat((torch.arange(m), torch.arange(m)))
    split = _of_particles(outcomes, twice)
    split = replace(split, weights=split.weights / 2)
    gain = expected_information_gain(outcomes)
    assert (gain >= field_gain(outcomes)).all()
    assert (field_gain(outcomes) > 0).all()
    assert (gain <= math.log(m) + field_gain(outcomes) + 1e-9).all()
    torch.testing.assert_close(expected_information_gain(turned), gain)
    torch.testing.assert_close(expected_information_gain(split), gain)
    variance = expected_variance(outcomes, values, scale, field)
    for same, index in ((turned, order), (split, twice)):
        found = expected_variance(same, values[index], scale, field[index])
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
    found = expected_variance(same, values, torch.ones(2, dtype=torch.float64))
    assert float(found) == pytest.approx(float(now))


def test_expected_variance_in_a_linear_normal_model_is_the_closed_form() -> None:
    theta = torch.randn(2500, 2, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    matrices = sensitivities(1)
    task = torch.tensor([[1.0, 0.0], [0.5, -2.0]], dtype=torch.float64)
    scale = torch.tensor([1.0, 2.0], dtype=torch.float64)
    found = expected_variance(linear_outcomes(theta, matrices, 0.5), theta @ task.T, scale)
    for c, matrix in enumerate(matrices):
        precision = torch.eye(2, dtype=torch.float64) + matrix.T @ matrix / 0.5**2
        covariance = task @ torch.linalg.solve(precision, task.T)
        expected = (covariance.diagonal() / scale**2).mean()
        assert float(found[c]) == pytest.approx(float(expected), rel=0.06)


def test_what_two_outcomes_tell_of_a_field_adds_up_to_what_both_together_do() -> None:
    fields = sensitivities(3)
    outcomes = linear_outcomes(torch.zeros(2, 2).double(), torch.zeros_like(fields), 0.5)
    outcomes = with_fields(outcomes, fields)
    for c, matrix in enumerate(fields):
        second = field_gain(outcomes.after(outcomes, c))
        for other, gain in zip(fields, second, strict=True):
            both = torch.cat((matrix, other))
            one = torch.eye(6, dtype=torch.float64)
            expected = 0.5 * torch.logdet(one + both @ both.mT / 0.5**2)
            assert float(field_gain(outcomes)[c] + gain) == pytest.approx(float(expected))


def test_variance_that_fields_leave_is_the_closed_form() -> None:
    """What particles leave open has the covariance (I + B^T B / s^2)^-1 after the outcome."""
    fields = sensitivities(2)
    outcomes = linear_outcomes(torch.zeros(3, 2).double(), torch.zeros_like(fields), 0.5)
    task = torch.tensor([[1.0, 0.0], [0.5, -2.0]], dtype=torch.float64)
    scale = torch.tensor([1.0, 2.0], dtype=torch.float64)
    values, answers = torch.zeros(3, 2).double(), task.expand(3, 2, 2)
    found = expected_variance(with_fields(outcomes, fields), values, scale, answers)
    for c, matrix in enumerate(fields):
        precision = torch.eye(2, dtype=torch.float64) + matrix.T @ matrix / 0.5**2
        covariance = task @ torch.linalg.solve(precision, task.T)
        assert float(found[c]) == pytest.approx(float((covariance.diagonal() / scale**2).mean()))


def test_without_noise_the_gain_stays_finite() -> None:
    """A field that is all of the covariance, in one direction as in all."""
    for rank in (1, 3):
        field = torch.eye(3, dtype=torch.float64)[:, :rank].expand(1, 2, 3, rank)
        covariance = field @ field.mT + 1e-18 * torch.eye(3, dtype=torch.float64)
        outcomes = replace(random_outcomes(2, 1, 0), factor=torch.linalg.cholesky(covariance))
        gain = field_gain(replace(outcomes, field=field))
        assert torch.isfinite(gain).all() and float(gain) > 5.0


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
