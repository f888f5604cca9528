"""Laws of the sampler, on a linear-normal model with known posterior and evidence."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from linear_model import DIMENSION, LinearModel, LinearTarget
from torch import Tensor

from tpcd.belief.cloud import Cloud, start_cloud
from tpcd.belief.importance import assimilate, draw_pool
from tpcd.belief.pool import Proposal, weigh
from tpcd.belief.proposals import DAMPINGS, curved_mixture
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.weights import cut_off, spread_choice, truncate

SETTINGS = SamplerSettings(particles=2000, draws=6000)
FEW = SamplerSettings(particles=500, places=20, fresh_modes=20, modes=5)


def start(count: int = 500, seed: int = 0) -> Cloud:
    generator = torch.Generator().manual_seed(seed)
    return start_cloud(torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64))


def run(
    model: LinearModel, stops: list[int], seed: int, settings: SamplerSettings
) -> tuple[Cloud, list[tuple[float, float]]]:
    """Bring in the data up to each stop; the cloud and (log evidence, error) after each."""
    generator = torch.Generator().manual_seed(seed)
    cloud, evidence = start(settings.particles, seed), []
    for datum, stop in enumerate(stops, start=1):
        cloud, info = assimilate(cloud, model.target(stop), datum, settings, generator)
        assert info.effective_sample_size > 1
        evidence.append((cloud.log_evidence, cloud.log_evidence_std))
    return cloud, evidence


@pytest.mark.parametrize("flat_rounds", [0, 4])
def test_several_data_one_after_another_give_the_known_posterior(flat_rounds: int) -> None:
    model = LinearModel(6)
    cloud, _ = run(model, [1, 2, 3, 4, 5, 6], 1, replace(SETTINGS, flat_rounds=flat_rounds))
    mean, covariance, _ = model.posterior(6)
    std = covariance.diagonal().sqrt()
    found_mean = cloud.weights @ cloud.positions
    assert ((found_mean - mean).abs() / std).max() < 0.1
    factor = torch.linalg.cholesky(covariance)
    whitened = torch.linalg.solve_triangular(factor, (cloud.positions - found_mean).T, upper=False)
    found = (cloud.weights * whitened) @ whitened.T
    assert (found - torch.eye(DIMENSION, dtype=torch.float64)).abs().max() < 0.15


@pytest.mark.parametrize("flat_rounds", [0, 4])
def test_evidence_of_every_stop_lies_within_its_stated_error(flat_rounds: int) -> None:
    """Ten runs of four data, 40 z-scores: of honest errors at most 3 lie beyond 2.6 sd
    (probability of more: 1e-4), and their root mean square is below 1.5."""
    model = LinearModel(4, seed=3)
    scores = []
    for seed in range(10):
        _, evidence = run(model, [1, 2, 3, 4], seed, replace(FEW, flat_rounds=flat_rounds))
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
    assert whole.log_evidence == pytest.approx(turned.log_evidence, abs=0.05)
    for other in (turned, single):
        shift = whole.weights @ whole.positions - other.weights @ other.positions
        assert (shift / std).abs().max() < 0.15
        error = math.hypot(whole.log_evidence_std, other.log_evidence_std)
        assert abs(whole.log_evidence - other.log_evidence) < 4 * error


def test_permuting_the_particles_changes_the_answer_by_chance_only() -> None:
    model = LinearModel(3, seed=6)
    cloud = start(2000)
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(1))
    means, evidence = [], []
    for positions in (cloud.positions, cloud.positions[order]):
        after, _ = assimilate(
            start_cloud(positions),
            model.target(3),
            1,
            SETTINGS,
            torch.Generator().manual_seed(1),
        )
        means.append(after.weights @ after.positions)
        evidence.append(after.log_evidence)
    std = model.posterior(3)[1].diagonal().sqrt()
    assert ((means[0] - means[1]) / std).abs().max() < 0.1
    assert abs(evidence[0] - evidence[1]) < 0.1


def test_one_chunk_or_many_give_the_same_cloud() -> None:
    model = LinearModel(2, seed=2)
    whole = model.target(2).likelihood
    clouds = []
    for likelihood in (whole, lambda x: torch.cat([whole(part) for part in x.split(97)])):
        generator = torch.Generator().manual_seed(4)
        clouds.append(assimilate(start(), model.target(2, likelihood), 1, FEW, generator)[0])
    torch.testing.assert_close(clouds[0].positions, clouds[1].positions, atol=1e-9, rtol=0)
    torch.testing.assert_close(clouds[0].weights, clouds[1].weights, atol=0, rtol=0)


def test_a_region_of_zero_likelihood_halves_the_evidence_and_holds_no_particle() -> None:
    model = LinearModel(0)

    def half(x: Tensor) -> Tensor:
        return torch.where(x[:, 0] > 0, 0.0, -torch.inf).double()

    generator = torch.Generator().manual_seed(0)
    cloud, _ = assimilate(start(), model.target(0, half), 1, SETTINGS, generator)
    assert (cloud.positions[:, 0] > 0).all()
    assert cloud.log_evidence == pytest.approx(math.log(0.5), abs=0.04)
    mean = float(cloud.weights @ cloud.positions[:, 0])
    assert mean == pytest.approx(math.sqrt(2 / math.pi), abs=0.04)


def test_nan_likelihoods_count_as_zero_and_never_spread() -> None:
    model = LinearModel(2)
    whole = model.target(2).likelihood

    def broken(x: Tensor) -> Tensor:
        return torch.where(x[:, 1] > 1.0, torch.nan, whole(x))

    generator = torch.Generator().manual_seed(0)
    cloud, _ = assimilate(start(), model.target(2, broken), 1, FEW, generator)
    assert (cloud.positions[:, 1] <= 1.0).all()
    assert torch.isfinite(cloud.log_likelihood).all()
    assert torch.isfinite(cloud.weights).all()
    assert math.isfinite(cloud.log_evidence)


def test_a_datum_that_nobody_explains_is_refused_in_words() -> None:
    model = LinearModel(1)
    nothing = model.target(1, lambda x: torch.full((len(x),), -torch.inf).double())
    with pytest.raises(ValueError, match="no particle explains"):
        assimilate(start(100), nothing, 1, FEW, torch.Generator().manual_seed(0))


def test_an_uninformative_datum_gives_the_prior_back() -> None:
    model = LinearModel(0)
    generator = torch.Generator().manual_seed(0)
    cloud, info = assimilate(start(200), model.target(0), 1, SETTINGS, generator)
    assert info.effective_sample_size > 0.5 * info.draws
    assert info.distinct > 1000
    assert abs(cloud.log_evidence) < 4 * cloud.log_evidence_std + 1e-6
    assert cloud.log_evidence_std < 0.05
    spread = cloud.weights @ cloud.positions**2
    torch.testing.assert_close(spread, torch.ones(DIMENSION).double(), atol=0.15, rtol=0)


@pytest.mark.parametrize(("known", "best"), [(1.0, 0), (0.1, len(DAMPINGS) - 1)])
def test_dampings_share_out_the_draws_by_what_they_were_worth(known: float, best: int) -> None:
    """A normal posterior needs no damping; of ten times its variance it needs the strongest."""

    class Flat(LinearTarget):
        def curvature(self, x: Tensor) -> tuple[Tensor, Tensor]:
            gradient, information = super().curvature(x)
            return gradient, known * information

    given = LinearModel(3).target(3)
    target = Flat(given.model, given.count, given.likelihood)
    settings = SamplerSettings(rounds=1, draws=500, flat_rounds=0)  # shares are not theirs
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        shares = draw_pool(start(), target, 1, settings, generator).shares
        assert float(shares.sum()) == pytest.approx(1.0)
        assert (shares > 0).all()
        assert int(shares.argmax()) == best


def test_few_heavy_draws_are_made_equal_but_a_single_one_is_kept() -> None:
    weights = torch.full((10_000,), 0.5 / 9997, dtype=torch.float64)
    weights[:3] = torch.tensor([0.3, 0.15, 0.05], dtype=torch.float64)
    found = truncate(weights)
    assert float(found.sum()) == pytest.approx(1.0)
    # The mean weight is 1e-4, a hundred times as much the most that counts.
    expected = torch.full((3,), 0.01 / 0.53, dtype=torch.float64)
    torch.testing.assert_close(found[:3], expected)
    alone = torch.full((10_000,), 1e-12, dtype=torch.float64)
    alone[7] = 1.0
    assert float(truncate(alone)[7]) > 0.999


def test_a_trial_draw_beyond_all_others_does_not_rule_all_draws_out() -> None:
    model = LinearModel(2)
    target = model.target(2)

    def strict(x: Tensor, least: Tensor | None) -> Tensor:
        value = target.likelihood(x)
        return value if least is None else torch.where(value < least, -torch.inf, value)

    class Strict(type(target)):
        def log_likelihood(self, positions: Tensor, least: Tensor | None) -> Tensor:
            return strict(positions, least)

    generator = torch.Generator().manual_seed(0)
    mixture = curved_mixture(
        torch.zeros(1, DIMENSION, dtype=torch.float64),
        *target.curvature(torch.zeros(1, DIMENSION, dtype=torch.float64)),
        torch.ones(len(DAMPINGS), dtype=torch.float64),
    )
    judge = Strict(**vars(target))
    *_, log_weights = weigh(judge, Proposal(mixture, 1), 200, 1e6, generator)
    assert torch.isfinite(log_weights).sum() > 100


def test_weights_that_are_cut_off_sum_to_one_and_none_dominates() -> None:
    weights = torch.full((100,), 0.001, dtype=torch.float64)
    weights[3], weights[5] = 0.902, 0.0
    found = cut_off(weights, 10.0)
    assert float(found.sum()) == pytest.approx(1.0)
    assert float(found.max()) == pytest.approx(0.1, rel=1e-6)
    assert found[5] == 0
    even = torch.full((100,), 0.01, dtype=torch.float64)
    torch.testing.assert_close(cut_off(even, 10.0), even)
    with pytest.raises(ValueError, match="expected less than the 99 weights above zero"):
        cut_off(weights, 100.0)


@pytest.mark.parametrize("count", [150, 20_000])
def test_places_are_chosen_by_weight_however_few_draws_there_are(count: int) -> None:
    """Ten draws hold most of the weight: each may be chosen ten times as often as if all were
    alike, or 300 places have to be chosen."""
    log_weights = torch.full((count,), -9.0, dtype=torch.float64)
    log_weights[:10] = 0.0
    chosen = spread_choice(log_weights, 4000, torch.Generator().manual_seed(0))
    share = 10 * max(10 / count, 1 / 300)
    assert float((chosen < 10).double().mean()) == pytest.approx(share, rel=0.25)


def test_evidence_is_not_biased_by_the_places_chosen() -> None:
    """A prior without data: the mean of 20 estimates of log 1 within its error, and small."""
    model = LinearModel(0)
    found = []
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        found.append(draw_pool(start(), model.target(0), 1, FEW, generator).log_evidence)
    values = torch.tensor(found)
    assert abs(float(values.mean())) < 4 * float(values.std()) / math.sqrt(20)
    assert float(values.std()) < 0.05


@pytest.mark.parametrize(
    "wrong",
    [
        {"particles": 3},
        {"places": 0},
        {"draws_per_place": 0},
        {"rounds": 0},
        {"draws": 10},
        {"prior_draws": 0},
        {"modes": 0},
        {"fresh_modes": 0},
        {"climbing_rounds": -1},
        {"flat_rounds": -1},
        {"flat_starts": 0},
        {"flat_tried": 0},
        {"flat_climbers": 0},
        {"flat_draws": 10},
    ],
)
def test_settings_without_meaning_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SamplerSettings(**wrong)
