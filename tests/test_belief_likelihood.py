"""The history likelihood against brute force: merging, misfit, outliers, per-element truth."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from tpcd.belief.belief import EstimatorSettings, estimate
from tpcd.belief.history import PARITY_LIMIT, history_of, parity_chi_square
from tpcd.belief.likelihood import (
    OUTLIER_SQUARE,
    _marginalise,
    _outlier_covariance,
    _whiten,
    history_likelihood,
)
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.belief.smc import SamplerSettings
from tpcd.data.episode import Episode
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene, make_truth

FIELD = MisfitField(sd=1e-3)


@pytest.fixture(scope="module")
def shape() -> PolygonShape:
    return PolygonShape(builtin_outlines()["mug"])


@pytest.fixture(scope="module")
def episode(shape: PolygonShape) -> Episode:
    generator = torch.Generator().manual_seed(1)
    scene = draw_scene("mug", shape.outline.vertices, generator)
    motion = make_motion("rich", scene, 6, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 6, generator).measured


@pytest.fixture(scope="module")
def particles(shape: PolygonShape) -> Tensor:
    prior = make_prior(shape)
    return prior.to_vector(prior.sample(12, torch.Generator().manual_seed(2)))


def random_covariance(*batch: int, generator: torch.Generator) -> Tensor:
    root = torch.randn(*batch, 3, 3, generator=generator, dtype=torch.float64)
    return root @ root.mT + 0.1 * torch.eye(3, dtype=torch.float64)


def test_marginal_misfit_equals_one_dense_normal_distribution() -> None:
    generator = torch.Generator().manual_seed(0)
    m, n, c, sd = 3, 4, 5, 0.7
    covariance = random_covariance(m, n, generator=generator)
    residual = torch.randn(m, n, 3, generator=generator, dtype=torch.float64)
    rows = torch.randn(m, n, 3, c, generator=generator, dtype=torch.float64)
    whitened, log_determinant = _whiten(covariance, torch.cat((residual[..., None], rows), -1))
    error = whitened[..., 0]
    each = -0.5 * error.square().sum(-1) - 0.5 * log_determinant - 1.5 * math.log(2 * math.pi)
    total, mean, precision = _marginalise(MisfitField(sd=sd), each, error, whitened[..., 1:])
    for i in range(m):
        stacked = rows[i].reshape(-1, c)
        noise = torch.block_diag(*covariance[i])
        dense = noise + sd**2 * stacked @ stacked.T
        flat = residual[i].flatten()
        expected = MultivariateNormal(torch.zeros_like(flat), dense).log_prob(flat)
        torch.testing.assert_close(total[i], expected, atol=1e-9, rtol=1e-9)
        # The posterior of the coefficients by conditioning the joint normal distribution.
        gain = sd**2 * stacked.T @ torch.linalg.inv(dense)
        torch.testing.assert_close(mean[i], gain @ flat, atol=1e-9, rtol=1e-9)
        conditional = sd**2 * torch.eye(c, dtype=torch.float64) - sd**2 * gain @ stacked
        torch.testing.assert_close(
            torch.linalg.inv(precision[i]), conditional, atol=1e-9, rtol=1e-9
        )


def test_merging_pose_and_wrench_keeps_what_a_normal_of_six_dimensions_says(
    episode: Episode,
) -> None:
    """Log densities of pose and wrench at two settled poses differ as those of the merged."""
    history = history_of(episode, least_std=0.0)
    generator = torch.Generator().manual_seed(0)
    poses = episode.poses[1:] + 1e-3 * torch.randn(2, 6, 3, generator=generator).double()
    std, stiffness = episode.sensor_std, episode.stiffness

    def six(settled: Tensor) -> Tensor:
        wrench = stiffness * (settled - episode.commands[1:])
        error = torch.cat((episode.poses[1:] - settled, episode.wrenches[1:] - wrench), -1)
        return -0.5 * (error / std).square().sum(-1)

    def three(settled: Tensor) -> Tensor:
        return -0.5 * ((history.settled - settled) ** 2 / history.settled_variance).sum(-1)

    good = parity_chi_square(episode)[1:] <= PARITY_LIMIT
    assert good.any()
    torch.testing.assert_close(
        (six(poses[0]) - six(poses[1]))[good], (three(poses[0]) - three(poses[1]))[good]
    )


def test_outliers_lie_at_the_border_whatever_the_field_carries() -> None:
    generator = torch.Generator().manual_seed(1)
    covariance = 1e-2 * random_covariance(2, 5, generator=generator)
    rows = torch.randn(2, 5, 3, 4, generator=generator, dtype=torch.float64)
    residual = 1e3 * torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    field = MisfitField(sd=2.0)
    grown = covariance + _outlier_covariance(field, covariance, residual, rows)
    marginal = grown + field.sd**2 * rows @ rows.mT
    square = (residual * torch.linalg.solve(marginal, residual)).sum(-1)
    torch.testing.assert_close(square, torch.full_like(square, OUTLIER_SQUARE))
    near = 1e-3 * residual / residual.norm(dim=-1, keepdim=True)
    assert (_outlier_covariance(field, covariance, near, rows) == 0).all()


def test_log_likelihood_of_an_outlier_falls_with_the_logarithm_of_its_distance() -> None:
    covariance = torch.eye(3, dtype=torch.float64).expand(1, 2, 3, 3)
    rows = torch.zeros(1, 2, 3, 0, dtype=torch.float64)
    residual = torch.zeros(1, 2, 3, dtype=torch.float64)
    residual[0, 0, 0], residual[0, 1, 0] = 1e2, 1e4
    field = MisfitField(sd=0.0)
    grown = covariance + _outlier_covariance(field, covariance, residual, rows)
    _, log_determinant = _whiten(grown, residual[..., None])
    difference = float(0.5 * (log_determinant[0, 1] - log_determinant[0, 0]))
    assert difference == pytest.approx(3 * math.log(1e2), rel=1e-6)


@pytest.mark.parametrize("sd", [0.0, 1e-3])
def test_before_is_the_likelihood_of_the_shorter_history(
    shape: PolygonShape, episode: Episode, particles: Tensor, sd: float
) -> None:
    history, field = history_of(episode), MisfitField(sd=sd)
    parameters = Parameters.from_vector(particles)
    whole = history_likelihood(shape, parameters, history, field, StepSettings())
    shorter = history_likelihood(shape, parameters, history.first(5), field, StepSettings())
    torch.testing.assert_close(whole.before, shorter.total)
    if sd == 0.0:
        assert whole.field_mean.shape == (12, 0)


def test_a_nan_particle_is_impossible_and_changes_no_other(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    history = history_of(episode)
    clean = history_likelihood(
        shape, Parameters.from_vector(particles), history, FIELD, StepSettings()
    )
    broken = particles.clone()
    broken[4, 0] = torch.nan
    found = history_likelihood(
        shape, Parameters.from_vector(broken), history, FIELD, StepSettings()
    )
    others = torch.arange(12) != 4
    assert found.total[4] == -torch.inf
    torch.testing.assert_close(found.total[others], clean.total[others], atol=0, rtol=0)
    torch.testing.assert_close(found.field_mean[others], clean.field_mean[others])
    assert torch.isfinite(found.field_precision).all()


def test_one_chunk_or_many_and_any_order_of_particles_agree(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    history = history_of(episode)

    def total(vectors: Tensor) -> Tensor:
        parameters = Parameters.from_vector(vectors)
        return history_likelihood(shape, parameters, history, FIELD, StepSettings()).total

    whole = total(particles)
    torch.testing.assert_close(torch.cat([total(part) for part in particles.split(5)]), whole)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(total(particles[order]), whole[order])


@pytest.mark.parametrize("spike", ["pose", "force"])
def test_one_bad_reading_moves_the_belief_by_little_more_than_a_posterior_sd(
    shape: PolygonShape, episode: Episode, spike: str
) -> None:
    """20 mm in a pose or 10 N in a force at row 4, against the same episode without."""
    rows = len(episode)
    if spike == "pose":
        change = torch.zeros(rows, 3, dtype=torch.float64)
        change[4, 1] = 0.020
        bad = replace(episode, poses=episode.poses + change)
    else:
        change = torch.zeros(rows, 3, dtype=torch.float64)
        change[4, 0] = 10.0
        bad = replace(episode, wrenches=episode.wrenches + change)
    settings = EstimatorSettings(sampler=SamplerSettings(particles=400), misfit_sd=5e-4)

    def last(data: Episode) -> tuple[Tensor, Tensor]:
        *_, step = estimate(data, shape, torch.Generator().manual_seed(0), settings)
        return step.belief.mean(), step.belief.std()

    clean_mean, clean_std = last(episode)
    mean, std = last(bad)
    # Losing the row costs what it taught, here about friction; it must not make the belief
    # surely wrong.
    shift = (mean - clean_mean).abs() / torch.maximum(std, clean_std)
    assert shift.max() < 1.5
    assert shift.median() < 0.5
