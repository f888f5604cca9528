"""Importance sampling in flat coordinates, against posteriors and densities that are known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from linear_model import DIMENSION, LinearModel, Unchanged
from torch import Tensor

from tpcd.belief.cloud import Counted, start_cloud
from tpcd.belief.flat_mixture import WIDTHS, FlatMixture, flat_mixture
from tpcd.belief.flat_start import flat_starts
from tpcd.belief.importance import adapt, assimilate
from tpcd.belief.pool import Pool
from tpcd.belief.proposals import DEGREES_OF_FREEDOM
from tpcd.belief.resampling import effective_sample_size
from tpcd.belief.settings import SamplerSettings

SETTINGS = SamplerSettings(
    particles=4000, draws=8000, flat_rounds=3, flat_worth=math.inf, flat_draws=1000
)


def start(count: int = 500) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)


def mixture(broad: tuple[int, ...] = ()) -> FlatMixture:
    generator = torch.Generator().manual_seed(4)
    bent = torch.tensor([[1.0, 0, 0], [2.0, 0.5, 0], [-1.0, 0.3, 3.0]], dtype=torch.float64)
    points = torch.randn(400, 3, generator=generator, dtype=torch.float64) @ bent.T + 1.0
    weights = torch.rand(400, generator=generator, dtype=torch.float64)
    shares = torch.arange(1.0, 1 + len(WIDTHS), dtype=torch.float64)
    return flat_mixture(points, weights / weights.sum(), points[:30], shares, broad)


def test_densities_are_those_of_students_around_each_centre() -> None:
    """Against the formula of the density of each component, with its whole covariance."""
    nu = DEGREES_OF_FREEDOM
    for broad in ((), (0,), (2, 0)):
        found = mixture(broad)
        b = 3 - len(broad)
        at = torch.tensor([[0.3, -2.0, 1.0], [5.0, 4.0, -3.0]], dtype=torch.float64)
        got = found.log_densities(at)
        for w, width in enumerate(WIDTHS):
            scale = torch.cat((torch.full((b,), width), torch.ones(3 - b))).double()
            factor = found.factor * scale
            kept = math.sqrt(max(0.0, 1 - width**2)) * found.centres
            centres = torch.cat((kept, kept.new_zeros(len(kept), 3 - b)), -1) @ found.factor.T
            away = at[:, found.order][:, None] - found.mean - centres
            unit = torch.linalg.solve_triangular(factor, away[..., None], upper=False)
            square = unit.square().sum((-2, -1))
            peak = math.lgamma((nu + 3) / 2) - math.lgamma(nu / 2) - 1.5 * math.log(nu * math.pi)
            each = peak - factor.diagonal().log().sum() - (nu + 3) / 2 * (square / nu).log1p()
            expected = torch.logsumexp(each, -1) - math.log(30) + found.shares[w].log()
            torch.testing.assert_close(got[:, w], expected)


def test_draws_come_from_the_density() -> None:
    """Weighted by another density over its own, draws have the moments of the other one."""
    found = mixture((1,))
    draws = found.draw(200_000, torch.Generator().manual_seed(0))
    log_density = torch.logsumexp(found.log_densities(draws), -1)
    other = torch.distributions.MultivariateNormal(found.mean, scale_tril=0.7 * found.factor)
    log_weights = other.log_prob(draws[:, found.order]) - log_density
    assert abs(float(log_weights.exp().mean()) - 1) < 0.01
    weights = log_weights.softmax(0)
    off = (weights @ draws[:, found.order] - found.mean) / found.factor.square().sum(-1).sqrt()
    assert float(off.abs().max()) < 0.01


@pytest.mark.parametrize("broad", [(), (0,), (2, 0)])
def test_far_points_have_the_density_of_the_formula_too(broad: tuple[int, ...]) -> None:
    found = mixture(broad)
    points = 3 * torch.randn(300, 3, generator=torch.Generator().manual_seed(1)).double()
    points[:100] *= 1e4
    d, nu, b = 3, DEGREES_OF_FREEDOM, found.centres.shape[-1]
    away = (points[:, found.order] - found.mean).mT
    unit = torch.linalg.solve_triangular(found.factor, away, upper=False).mT
    peak = math.lgamma((nu + d) / 2) - math.lgamma(nu / 2) - d / 2 * math.log(nu * math.pi)
    peak -= float(found.factor.diagonal().log().sum()) + math.log(len(found.centres))
    for w, width in enumerate(WIDTHS):
        kept = max(0.0, 1 - width**2) ** 0.5
        near = (unit[:, None, :b] - kept * found.centres) / width
        square = near.square().sum(-1) + unit[:, None, b:].square().sum(-1)
        log_sum = torch.logsumexp(-(nu + d) / 2 * torch.log1p(square / nu), -1)
        expected = log_sum - b * math.log(width) + peak + found.shares[w].log()
        torch.testing.assert_close(found.log_densities(points)[:, w], expected)


def test_points_on_a_line_make_a_mixture_too() -> None:
    line = torch.linspace(-1e5, 1e5, 3, dtype=torch.float64)[:, None] * torch.ones(1, 4)
    weights = torch.full((3,), 1 / 3, dtype=torch.float64)
    shares = torch.ones(len(WIDTHS), dtype=torch.float64)
    found = flat_mixture(line.double(), weights, line.double(), shares)
    draws = found.draw(50, torch.Generator().manual_seed(0))
    assert torch.isfinite(draws).all() and torch.isfinite(found.log_densities(draws)).all()


def known_moments(pool: Pool, model: LinearModel, count: int) -> None:
    mean, covariance, log_evidence = model.posterior(count)
    std = covariance.diagonal().sqrt()
    found = pool.cloud(4000, torch.Generator().manual_seed(7))
    assert ((found.weights @ found.positions - mean).abs() / std).max() < 0.1
    deviation = (found.weights @ (found.positions - mean) ** 2).sqrt()
    torch.testing.assert_close(deviation, std, rtol=0.06, atol=0)
    assert abs(pool.log_evidence - log_evidence) < 4 * pool.log_evidence_std


def test_the_linear_normal_posterior_and_its_evidence_come_out() -> None:
    model = LinearModel(5, seed=4)
    target, generator = model.target(5), torch.Generator().manual_seed(3)
    adapted = adapt(start_cloud(start()), target, 5, SETTINGS, generator)
    assert adapted.proposal.flat is not None and len(adapted.proposal.flat.mixtures) == 3
    pool = adapted.pool(target, 8000, generator)
    known_moments(pool, model, 5)
    # Again: more mixtures beside those that are there, at the draws of the pool.
    again = adapted.again(target, pool, SETTINGS, generator)
    assert again.proposal.flat is not None
    assert again.proposal.flat.mixtures[:3] == adapted.proposal.flat.mixtures
    assert len(again.proposal.flat.mixtures) == 6 and again.evaluations > adapted.evaluations
    second = again.pool(target, 8000, generator)
    known_moments(second, model, 5)
    assert second.effective_sample_size > 3000


@pytest.mark.parametrize("rough", [True, False])
def test_what_is_rough_shapes_the_draws_and_does_not_weigh_them(rough: bool) -> None:
    """A rough likelihood that lacks all but the first datum costs draws, and moves nothing."""
    model = LinearModel(5, seed=4)
    target = replace(model.target(5), roughly=model.target(1).likelihood)
    settings, generator = replace(SETTINGS, rough=rough), torch.Generator().manual_seed(3)
    adapted = adapt(start_cloud(start()), target, 5, settings, generator)
    pool = adapted.pool(target, 8000, generator)
    known_moments(pool, model, 5)
    assert (pool.effective_sample_size < 0.8 * plain_worth(model)) == rough


def test_what_is_rough_and_far_too_high_rules_no_draw_out() -> None:
    """As high as that in a place far from the posterior, which many trial draws then find."""
    model, far = LinearModel(5, seed=4), torch.tensor([2.0, -2.0, 2.0], dtype=torch.float64)
    target = model.target(5)

    def too_high(x: Tensor) -> Tensor:
        return torch.where((x - far).norm(dim=-1) < 1.0, 200.0, target.likelihood(x))

    generator = torch.Generator().manual_seed(3)
    adapted = adapt(start_cloud(start()), replace(target, roughly=too_high), 5, SETTINGS, generator)
    known_moments(adapted.pool(target, 8000, generator), model, 5)


def plain_worth(model: LinearModel) -> float:
    generator = torch.Generator().manual_seed(3)
    target = model.target(5)
    adapted = adapt(start_cloud(start()), target, 5, SETTINGS, generator)
    return adapted.pool(target, 8000, generator).effective_sample_size


def test_a_long_history_has_fewer_draws() -> None:
    settings = SamplerSettings(draws=1000, flat_draws=150, full_draws=10)
    found = [(each.draws, each.flat_draws) for each in map(settings.at, (1, 10, 16, 20, 500))]
    assert found == [(1000, 150), (1000, 150), (625, 100), (500, 100), (500, 100)]
    assert replace(settings.at(16), draws=1000, flat_draws=150) == settings


def test_rounds_end_once_their_draws_are_worth_enough() -> None:
    model = LinearModel(5, seed=4)
    target = model.target(5)
    counts = []
    for worth in (1e-3, 1e6):
        settings = replace(SETTINGS, flat_rounds=6, flat_worth=worth)
        adapted = adapt(start_cloud(start()), target, 5, settings, torch.Generator().manual_seed(3))
        assert adapted.proposal.flat is not None
        counts.append(len(adapted.proposal.flat.mixtures))
        known_moments(adapted.pool(target, 8000, torch.Generator().manual_seed(5)), model, 5)
    assert counts == [2, 6]


def test_as_many_starts_are_drawn_as_there_need_be() -> None:
    """Each start of the linear model is in its boxes, so one lot is enough, or all that may be.
    Their mean weight is the evidence."""
    model = LinearModel(5, seed=4)
    target, log_evidence = model.target(5), model.posterior(5)[2]
    weights = torch.full((500,), 1 / 500, dtype=torch.float64)
    coordinates = target.coordinates(start(), weights, start()[:, :0])
    for most, needed, expected in ((50_000, 1000, 2000), (50_000, 3000, 4000), (1500, 3000, 1500)):
        settings = replace(SETTINGS, flat_starts=most, flat_enough=needed)
        found = flat_starts(target, coordinates, settings, torch.Generator().manual_seed(1))
        assert found.draws.starts == expected and len(found.draws.flat) == expected
        own = found.draws.log_weights
        std = math.sqrt(1 / effective_sample_size(own.softmax(0)) - 1 / expected)
        assert std < 0.3 and abs(float(torch.logsumexp(own, 0)) - log_evidence) < 4 * std
        assert 0 < len(found.points) <= settings.flat_climbers


def test_those_climb_that_are_in_the_basin_of_a_narrow_mode() -> None:
    """Few starts are, and all of them far below its top."""
    model, top = LinearModel(2), torch.tensor([1.5, -1.5, 1.0], dtype=torch.float64)

    def peaked(x: Tensor) -> Tensor:
        return (60 - 80 * (x - top).norm(dim=-1)).clamp_min(0.0)

    target = model.target(2, peaked)
    weights = torch.full((500,), 1 / 500, dtype=torch.float64)
    coordinates = target.coordinates(start(), weights, start()[:, :0])
    settings = replace(SETTINGS, flat_starts=2000, flat_tried=2000, flat_climbers=40)
    generator = torch.Generator().manual_seed(7)
    found = flat_starts(target, coordinates, settings, generator)
    everywhere = coordinates.likeliest(target.sample(2000, generator))[0]
    of_all = (peaked(everywhere) > 0).double().mean()
    of_climbing = (peaked(found.points) > 0).double().mean()
    assert 0.001 < of_all < 0.1 and of_climbing > 4 * of_all
    assert 10 < peaked(found.points).max() < 58


class Pinned(Unchanged):
    """The readings say minus ten thousand times the square of the first score."""

    def likeliest(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        return flat, -1e4 * flat[:, 0] ** 2


def test_many_places_are_tried_however_much_the_readings_say() -> None:
    """Only a hundredth of the places is within a nat of the best; far more are to be tried."""
    target = Counted(LinearModel(2).target(2))
    settings = replace(SETTINGS, flat_tried=400, flat_climbers=400, flat_enough=1, flat_starts=2000)
    counts = []
    for coordinates in (Pinned(), Unchanged()):
        before = target.evaluations
        flat_starts(target, coordinates, settings, torch.Generator().manual_seed(3))
        # Besides, all draws are weighed, and the first of them twice.
        counts.append(target.evaluations - before - 2000 - settings.fresh_modes)
    assert counts[1] == 400 and 200 < counts[0] < 400


def test_the_same_generator_gives_the_same_draws() -> None:
    model = LinearModel(3, seed=1)
    found = [
        assimilate(
            start_cloud(start()), model.target(3), 3, SETTINGS, torch.Generator().manual_seed(6)
        )[0]
        for _ in range(2)
    ]
    assert torch.equal(found[0].positions, found[1].positions)
    assert found[0].log_evidence == found[1].log_evidence
