"""Laws of the tempered sampler, on a linear-normal model with known posterior and evidence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from tpcd.belief.cloud import Cloud, SamplerSettings, start_cloud
from tpcd.belief.smc import assimilate

DIMENSION = 3
NOISE = 0.3
Likelihood = Callable[[Tensor, object], tuple[Tensor, Tensor]]


class LinearModel:
    """y_k = a_k . x + noise with x ~ N(0, I): everything about it is known."""

    def __init__(self, count: int, seed: int = 0) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.rows = torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)
        truth = torch.randn(DIMENSION, generator=generator, dtype=torch.float64)
        noise = torch.randn(count, generator=generator, dtype=torch.float64)
        self.data = self.rows @ truth + NOISE * noise

    def log_prior(self, x: Tensor) -> Tensor:
        return -0.5 * (x**2).sum(-1) - 0.5 * DIMENSION * math.log(2 * math.pi)

    def terms(self, x: Tensor) -> Tensor:
        error = (self.data - x @ self.rows.T) / NOISE
        return -0.5 * error**2 - math.log(NOISE) - 0.5 * math.log(2 * math.pi)

    def log_likelihood(self, before: int, count: int) -> Likelihood:
        def evaluate(x: Tensor, threshold: object) -> tuple[Tensor, Tensor]:
            terms = self.terms(x)
            return terms[:, :before].sum(-1), terms[:, :count].sum(-1)

        return evaluate

    def target(self, before: int, count: int, likelihood: Likelihood | None = None) -> LinearTarget:
        return LinearTarget(self, before, count, likelihood or self.log_likelihood(before, count))

    def posterior(self, count: int) -> tuple[Tensor, Tensor, float]:
        rows, data = self.rows[:count], self.data[:count]
        precision = torch.eye(DIMENSION, dtype=torch.float64) + rows.T @ rows / NOISE**2
        covariance = torch.linalg.inv(precision)
        marginal = rows @ rows.T + NOISE**2 * torch.eye(count, dtype=torch.float64)
        evidence = torch.distributions.MultivariateNormal(torch.zeros_like(data), marginal)
        return covariance @ rows.T @ data / NOISE**2, covariance, float(evidence.log_prob(data))


@dataclass(frozen=True)
class LinearTarget:
    """Data up to `count`, those from `before` on new, or another likelihood in their place."""

    model: LinearModel
    before: int
    count: int
    log_likelihood: Likelihood

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        return torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)

    def log_prior(self, x: Tensor) -> Tensor:
        return self.model.log_prior(x)

    def curvature(self, x: Tensor, spread: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
        rows, data = self.model.rows[: self.count], self.model.data[: self.count]
        share = torch.ones_like(data)
        share[self.before :] = temperature
        gradient = (share * (data - x @ rows.T)) @ rows / NOISE**2 - x
        information = torch.eye(DIMENSION).double() + (rows.T * share) @ rows / NOISE**2
        return gradient, information.expand(len(x), -1, -1)


def run(
    model: LinearModel, stops: list[int], seed: int, settings: SamplerSettings
) -> tuple[Cloud, list[tuple[float, float]]]:
    """Bring in the data up to each stop; the cloud and (log evidence, error) after each."""
    generator = torch.Generator().manual_seed(seed)
    start = torch.randn(settings.particles, DIMENSION, generator=generator, dtype=torch.float64)
    cloud, evidence, before = start_cloud(start, model.log_prior), [], 0
    for stop in stops:
        cloud, info = assimilate(cloud, model.target(before, stop), settings, generator)
        assert info.effective_sample_size > 1
        evidence.append((cloud.log_evidence, cloud.log_evidence_std))
        before = stop
    return cloud, evidence


SETTINGS = SamplerSettings(particles=2000)


def test_several_data_one_after_another_give_the_known_posterior() -> None:
    model = LinearModel(6)
    cloud, _ = run(model, [1, 2, 3, 4, 5, 6], 1, SETTINGS)
    mean, covariance, _ = model.posterior(6)
    std = covariance.diagonal().sqrt()
    assert ((cloud.positions.mean(0) - mean).abs() / std).max() < 0.15
    factor = torch.linalg.cholesky(covariance)
    whitened = torch.linalg.solve_triangular(
        factor, (cloud.positions - cloud.positions.mean(0)).T, upper=False
    )
    found = whitened @ whitened.T / len(cloud.positions)
    assert (found - torch.eye(DIMENSION, dtype=torch.float64)).abs().max() < 0.2


def test_evidence_of_every_stop_lies_within_its_stated_error() -> None:
    """Ten runs of four data, 40 z-scores: of honest errors at most 3 lie beyond 2.6 sd
    (probability of more: 1e-4), and their root mean square is below 1.5."""
    model = LinearModel(4, seed=3)
    scores = []
    for seed in range(10):
        _, evidence = run(model, [1, 2, 3, 4], seed, SamplerSettings(particles=500))
        for count, (value, error) in enumerate(evidence, start=1):
            assert error > 0
            scores.append((value - model.posterior(count)[2]) / error)
    found = torch.tensor(scores)
    assert (found.abs() > 2.6).sum() <= 3
    assert found.square().mean().sqrt() < 1.5


def test_one_batch_and_one_by_one_agree_and_order_within_a_batch_does_not_matter() -> None:
    model = LinearModel(4, seed=5)
    backwards = LinearModel(4, seed=5)
    backwards.rows, backwards.data = model.rows.flip(0), model.data.flip(0)
    whole, _ = run(model, [4], 7, SETTINGS)
    turned, _ = run(backwards, [4], 7, SETTINGS)
    single, _ = run(model, [1, 2, 3, 4], 8, SETTINGS)
    std = model.posterior(4)[1].diagonal().sqrt()
    torch.testing.assert_close(whole.positions, turned.positions, atol=1e-9, rtol=0)
    assert whole.log_evidence == pytest.approx(turned.log_evidence, abs=1e-8)
    assert ((whole.positions.mean(0) - single.positions.mean(0)) / std).abs().max() < 0.2
    error = math.hypot(whole.log_evidence_std, single.log_evidence_std)
    assert abs(whole.log_evidence - single.log_evidence) < 4 * error


def test_permuting_the_particles_changes_the_answer_by_chance_only() -> None:
    model = LinearModel(3, seed=6)
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(2000, DIMENSION, generator=generator, dtype=torch.float64)
    order = torch.randperm(2000, generator=generator)
    means, evidence = [], []
    for positions in (start, start[order]):
        cloud, _ = assimilate(
            start_cloud(positions, model.log_prior),
            model.target(0, 3),
            SETTINGS,
            torch.Generator().manual_seed(1),
        )
        means.append(cloud.positions.mean(0))
        evidence.append(cloud.log_evidence)
    std = model.posterior(3)[1].diagonal().sqrt()
    assert ((means[0] - means[1]) / std).abs().max() < 0.2
    assert abs(evidence[0] - evidence[1]) < 0.3


def test_a_cloud_that_is_thinned_still_has_the_posterior_and_the_evidence() -> None:
    """Six times as many particles at the first datum, 1 / k of them at datum k."""
    settings = SamplerSettings(particles=2000, early_factor=6.0)
    assert [settings.particles_at(k) for k in (1, 2, 3, 6, 9)] == [12000, 6000, 4000, 2000, 2000]
    model = LinearModel(4, seed=3)
    generator = torch.Generator().manual_seed(0)
    count = settings.particles_at(1)
    start = torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)
    cloud = start_cloud(start, model.log_prior)
    for k in range(4):
        cloud, _ = assimilate(
            cloud,
            model.target(k, k + 1),
            settings,
            generator,
            settings.particles_at(k + 1),
        )
        assert len(cloud.positions) == len(cloud.log_likelihood) == settings.particles_at(k + 1)
    mean, covariance, evidence = model.posterior(4)
    error = (cloud.positions.mean(0) - mean) / covariance.diagonal().sqrt()
    assert error.abs().max() < 0.1
    assert cloud.log_evidence == pytest.approx(evidence, abs=0.15)


def test_one_chunk_or_many_give_the_same_cloud() -> None:
    model = LinearModel(2, seed=2)
    whole = model.log_likelihood(0, 2)

    def chunked(x: Tensor, threshold: object) -> tuple[Tensor, Tensor]:
        parts = [whole(part, None) for part in x.split(97)]
        return torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])

    clouds = []
    for likelihood in (whole, chunked):
        generator = torch.Generator().manual_seed(4)
        start = torch.randn(500, DIMENSION, generator=generator, dtype=torch.float64)
        settings = SamplerSettings(particles=500)
        clouds.append(
            assimilate(
                start_cloud(start, model.log_prior),
                model.target(0, 2, likelihood),
                settings,
                generator,
            )[0]
        )
    torch.testing.assert_close(clouds[0].positions, clouds[1].positions, atol=1e-9, rtol=0)


def test_a_region_of_zero_likelihood_halves_the_evidence_and_holds_no_particle() -> None:
    model = LinearModel(1)

    def half(x: Tensor, threshold: object) -> tuple[Tensor, Tensor]:
        zero = torch.zeros(len(x), dtype=torch.float64)
        return zero, torch.where(x[:, 0] > 0, zero, -torch.inf)

    generator = torch.Generator().manual_seed(0)
    start = torch.randn(4000, DIMENSION, generator=generator, dtype=torch.float64)
    settings = SamplerSettings(particles=4000)
    cloud, _ = assimilate(
        start_cloud(start, model.log_prior), model.target(0, 1, half), settings, generator
    )
    assert (cloud.positions[:, 0] > 0).all()
    assert cloud.log_evidence == pytest.approx(math.log(0.5), abs=0.06)
    assert float(cloud.positions[:, 0].mean()) == pytest.approx(math.sqrt(2 / math.pi), abs=0.06)


def test_nan_likelihoods_count_as_zero_and_never_spread() -> None:
    model = LinearModel(2)
    whole = model.log_likelihood(0, 2)

    def broken(x: Tensor, threshold: object) -> tuple[Tensor, Tensor]:
        before, total = whole(x, None)
        return before, torch.where(x[:, 1] > 1.0, torch.nan, total)

    generator = torch.Generator().manual_seed(0)
    start = torch.randn(500, DIMENSION, generator=generator, dtype=torch.float64)
    cloud, _ = assimilate(
        start_cloud(start, model.log_prior),
        model.target(0, 2, broken),
        SamplerSettings(particles=500),
        generator,
    )
    assert (cloud.positions[:, 1] <= 1.0).all()
    assert torch.isfinite(cloud.log_likelihood).all()


def test_a_datum_that_nobody_explains_is_refused_in_words() -> None:
    model = LinearModel(1)

    def nothing(x: Tensor, threshold: object) -> tuple[Tensor, Tensor]:
        return torch.zeros(len(x)).double(), torch.full((len(x),), -torch.inf).double()

    start = torch.zeros(100, DIMENSION, dtype=torch.float64)
    with pytest.raises(ValueError, match="no particle explains"):
        assimilate(
            start_cloud(start, model.log_prior),
            model.target(0, 1, nothing),
            SamplerSettings(particles=100),
            torch.Generator().manual_seed(0),
        )


def test_an_uninformative_datum_changes_nothing_but_places() -> None:
    def flat(x: Tensor, threshold: object) -> tuple[Tensor, Tensor]:
        zero = torch.zeros(len(x), dtype=torch.float64)
        return zero, zero

    model = LinearModel(0)
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(200, DIMENSION, generator=generator, dtype=torch.float64)
    settings = SamplerSettings(particles=200)
    cloud, info = assimilate(
        start_cloud(start, model.log_prior), model.target(0, 0, flat), settings, generator
    )
    assert info.temperatures == 1
    assert info.distinct_ancestors > 150
    assert cloud.log_evidence_std < 0.05
    assert abs(cloud.log_evidence) < 4 * cloud.log_evidence_std


@pytest.mark.parametrize(("share", "independent"), [(0.0, False), (1.0, True)])
def test_the_share_of_independent_moves_is_what_is_set(share: float, independent: bool) -> None:
    model = LinearModel(1)
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(200, DIMENSION, generator=generator, dtype=torch.float64)
    settings = SamplerSettings(particles=200, independent_share=share)
    _, info = assimilate(
        start_cloud(start, model.log_prior),
        model.target(0, 1),
        settings,
        generator,
    )
    assert (info.acceptance_independent > 0) == independent
    assert (info.acceptance_local > 0) == (not independent)


@pytest.mark.parametrize(
    "wrong",
    [
        {"particles": 3},
        {"kept_share": 1.0},
        {"components": 0},
        {"final_moves": -1},
        {"independent_share": 1.5},
        {"pool_share": 0.0},
        {"importance_rounds": 0},
        {"fresh_modes": 0},
    ],
)
def test_settings_without_meaning_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SamplerSettings(**wrong)
