"""Log evidence of models that a diagnosis weighs against each other."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from linear_model import LinearModel
from torch import Tensor

from tpcd.belief.cloud import Cloud, Target, start_cloud
from tpcd.belief.pool import Pool
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import SamplerSettings
from tpcd.discrepancy import evidence
from tpcd.discrepancy.evidence import PASSES, draw_again
from tpcd.discrepancy.fit import FIT_SAMPLER, Fit
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings

MODEL = LinearModel(6)


def again(sampler: SamplerSettings = FIT_SAMPLER) -> Pool:
    """Draws that begin at draws from the prior."""
    generator, target = torch.Generator().manual_seed(3), MODEL.target(6)
    begin = start_cloud(target.sample(sampler.particles, generator))
    return draw_again(begin, target, sampler, generator)


def test_the_evidence_of_a_linear_model_is_the_known_one() -> None:
    pool = again()
    mean, covariance, log_evidence = MODEL.posterior(6)
    assert abs(pool.log_evidence - log_evidence) < 0.1
    away = pool.log_weights.softmax(0) @ pool.positions - mean
    assert (away.abs() < 0.3 * covariance.diagonal().sqrt()).all()


class MadeUp:
    """Draws whose evidence and effective number are told, and what was asked for them."""

    def __init__(self, told: list[tuple[float, int]]) -> None:
        self.told = told
        self.asked: list[SamplerSettings] = []
        self.begun: list[Tensor] = []

    def pool(
        self, cloud: Cloud, target: Target, datum: int, settings: SamplerSettings, *_: object
    ) -> Pool:
        log_evidence, worth = self.told[len(self.asked)]
        self.begun.append(cloud.positions)
        self.asked.append(settings)
        positions = torch.full((100, 3), float(len(self.asked)), dtype=torch.float64)
        weights = torch.full((100,), -torch.inf, dtype=torch.float64)
        weights[:worth] = log_evidence + torch.tensor(100.0 / worth).double().log()
        return Pool(positions, weights, weights, positions[:1], torch.ones(1).double(), 0)


@pytest.mark.parametrize(
    ("told", "kept"),
    [
        ([(0, 90), (5, 90), (5.5, 90), (99, 90)], (1, 2)),  # until it explains no more
        ([(0, 90), (-5, 90), (99, 90)], (1,)),  # or less than rough ones
        ([(0, 90), (9, 90), (5, 90), (5.5, 90), (99, 90)], (1,)),  # which missed what came before
        ([(0, 90), (2, 90), (6, 90), (6.5, 90), (99, 90)], (2, 3)),  # or what comes after
        # however few are left by a heavy one before
        ([(0, 90), (1, 1), (0.2, 60), (99, 90)], (1, 2)),
        # while few count
        ([(0, 90), (0, 3), (0.2, 3), (0.1, 3), (0, 3), (99, 90)], (1, 2, 3, 4)),
        ([(10 * k, 50) for k in range(20)], (PASSES,)),  # and not for ever
    ],
)
def test_draws_are_made_again_and_count_together_where_they_find_the_same(
    told: list[tuple[float, int]], kept: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Draws `kept` are those that count in the end."""
    draws = MadeUp(told)
    monkeypatch.setattr(evidence, "draw_pool", draws.pool)
    pool = again()
    found = torch.tensor([told[k][0] for k in kept], dtype=torch.float64)
    assert pool.log_evidence == pytest.approx(float(found.logsumexp(0)) - math.log(len(kept)))
    if len(kept) > 1:
        # What passes differ by is no less in doubt than each of them alone.
        means = found.exp()
        least = float(means.std() / means.mean()) / math.sqrt(len(kept))
        assert pool.log_evidence_std >= least * (1 - 1e-9)
    assert set(pool.positions[:, 0].tolist()) == {k + 1.0 for k in kept}
    first, *others = draws.asked
    assert first.flat_rounds == 0 and first.rough and others == [FIT_SAMPLER] * len(others)
    # Each begins where those that count then are.
    for k, begun in enumerate(draws.begun[1:], start=1):
        assert set(begun[:, 0].tolist()) <= {float(one) for one in range(1, k + 1)}


def test_without_flat_rounds_draws_are_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    draws, sampler = MadeUp([(3, 2)]), replace(FIT_SAMPLER, flat_rounds=0)
    monkeypatch.setattr(evidence, "draw_pool", draws.pool)
    assert again(sampler).log_evidence == pytest.approx(3)
    assert draws.asked == [sampler]


def model(*by_seed: float, worth: float = 25.0) -> Fit:
    """A fit with such evidence, on one particle a seed that is as many."""
    shape = PolygonShape(builtin_outlines()["mug"])
    clouds = tuple(
        replace(
            start_cloud(torch.full((1, 8), float(k), dtype=torch.float64)),
            log_evidence=value,
            log_evidence_std=worth**-0.5,
        )
        for k, value in enumerate(by_seed)
    )
    return Fit((), StepSettings(), make_prior(shape), by_seed, clouds)


def test_seeds_that_missed_what_another_found_do_not_count() -> None:
    assert model(5.0, 5.0).log_evidence == pytest.approx(5.0)
    expected = 5.0 + math.log((1 + math.exp(-2.0)) / 2)
    assert model(5.0, 3.0, 1.9, -40.0).log_evidence == pytest.approx(expected)
    assert model(5.0, 3.0, 1.9, -40.0).cloud.log_evidence == pytest.approx(expected)
    assert math.isnan(model(math.nan, math.nan).log_evidence)


def test_seeds_of_equal_evidence_add_their_draws() -> None:
    assert model(5.0, 5.0).cloud.log_evidence_std ** -2 == pytest.approx(50.0)
    assert model(5.0, -40.0).cloud.log_evidence_std ** -2 == pytest.approx(25.0)
