"""Climbing to modes, weighted draws and the exchange, on targets with known answers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from tpcd.belief.cloud import SamplerSettings
from tpcd.belief.importance import draw_pool, exchange
from tpcd.belief.modes import climb, find_modes, log_target

DIMENSION = 2
CENTRES = torch.tensor([[2.0, 0.0], [-2.0, 1.0], [0.0, -3.0]], dtype=torch.float64)
SHARES = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
WIDTH = 0.1


@dataclass(frozen=True)
class ThreeModes:
    """A likelihood of three narrow normals of known shares, under a flat enough prior."""

    prior_std: float = 3.0

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        normal = torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)
        return self.prior_std * normal

    def log_prior(self, x: Tensor) -> Tensor:
        square = (x**2).sum(-1) / self.prior_std**2
        return -0.5 * square - DIMENSION * math.log(self.prior_std * math.sqrt(2 * math.pi))

    def log_likelihood(self, x: Tensor, threshold: object) -> tuple[Tensor, Tensor]:
        square = ((x[:, None] - CENTRES) ** 2).sum(-1) / WIDTH**2
        # Shares of the posterior, so the prior at the centres is taken out.
        terms = SHARES.log() - self.log_prior(CENTRES) - 0.5 * square
        total = torch.logsumexp(terms, -1) - math.log(2 * math.pi * WIDTH**2)
        return torch.zeros_like(total), total

    def curvature(self, x: Tensor, spread: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
        nearest = ((x[:, None] - CENTRES) ** 2).sum(-1).argmin(-1)
        gradient = (CENTRES[nearest] - x) / WIDTH**2
        return gradient, torch.eye(DIMENSION).double().expand(len(x), -1, -1) / WIDTH**2


def share_at(x: Tensor, weights: Tensor) -> Tensor:
    nearest = ((x[:, None] - CENTRES) ** 2).sum(-1).argmin(-1)
    return torch.zeros(3, dtype=torch.float64).index_add(0, nearest, weights / weights.sum())


def test_a_climb_gains_at_every_step_and_arrives() -> None:
    target = ThreeModes()
    start = target.sample(50, torch.Generator().manual_seed(0))
    heights = [log_target(target, start)]
    for rounds in (1, 2, 4, 8):
        points, height = climb(target, start, rounds)
        assert (height >= heights[-1]).all()
        heights.append(height)
    assert ((points[:, None] - CENTRES).norm(dim=-1).amin(-1) < 0.01).all()


def test_each_mode_is_found_once_and_remembered() -> None:
    target, generator = ThreeModes(), torch.Generator().manual_seed(1)
    settings = SamplerSettings(fresh_modes=60, modes=10)
    empty, ones = torch.zeros(0, 2).double(), torch.ones(2).double()
    modes, mixture, _ = find_modes(target, empty, ones, settings, generator)
    assert len(modes) == len(mixture.mean) == 3
    assert (torch.cdist(CENTRES, modes).amin(-1) < 0.01).all()
    one = SamplerSettings(fresh_modes=1, modes=10)
    again, _, _ = find_modes(target, modes, ones, one, generator)
    torch.testing.assert_close(again, modes, atol=1e-3, rtol=0)


def test_a_cloud_in_one_mode_still_gives_all_modes_their_share_and_the_evidence() -> None:
    target, generator = ThreeModes(), torch.Generator().manual_seed(2)
    cloud = CENTRES[0] + WIDTH * torch.randn(400, 2, generator=generator, dtype=torch.float64)
    settings = SamplerSettings(fresh_modes=60, components=30)
    pool = draw_pool(target, cloud, torch.zeros(0, 2).double(), settings, generator)
    share = share_at(pool.draws.positions, pool.log_weights.exp())
    torch.testing.assert_close(share, SHARES, atol=0.05, rtol=0)
    # The prior varies a little within a mode: by less than 1 % of its height.
    assert abs(pool.log_evidence) < 4 * pool.log_evidence_std + 0.01
    weights = target.log_prior(cloud) + target.log_likelihood(cloud, None)[1]
    weights = weights - pool.mixture.log_density(cloud)
    leaves, index = exchange(weights, pool.log_weights, 0.25, generator)
    after = torch.where(leaves[:, None], pool.draws.positions[index], cloud)
    share = share_at(after, torch.ones(400).double())
    assert leaves.double().mean() > 0.9
    torch.testing.assert_close(share, SHARES, atol=0.1, rtol=0)


def test_weights_of_a_pool_are_those_of_its_joint_mixture() -> None:
    target, generator = ThreeModes(), torch.Generator().manual_seed(3)
    cloud = target.sample(200, generator)
    pool = draw_pool(target, cloud, torch.zeros(0, 2).double(), SamplerSettings(), generator)
    draws = pool.draws
    expected = target.log_prior(draws.positions) + draws.with_datum
    expected = expected - pool.mixture.log_density(draws.positions)
    torch.testing.assert_close(pool.log_weights, expected)


@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_the_exchange_keeps_a_target_that_holds_already_whatever_the_draws(offset: float) -> None:
    """Draws of a normal centred elsewhere: the mean of 40,000 particles stays what it was."""
    generator = torch.Generator().manual_seed(4)
    particles, spread = torch.randn(40_000, generator=generator, dtype=torch.float64), 1.5
    means = []
    for _ in range(20):
        draws = offset + spread * torch.randn(40, generator=generator, dtype=torch.float64)

        def log_weight(x: Tensor) -> Tensor:
            return -0.5 * x**2 + 0.5 * ((x - offset) / spread) ** 2

        leaves, index = exchange(log_weight(particles), log_weight(draws), 0.5, generator)
        assert 0.3 < float(leaves.double().mean()) < 1.0
        means.append(float(torch.where(leaves, draws[index], particles).mean()))
    found = torch.tensor(means)
    assert abs(float(found.mean())) < 4 * float(found.std()) / math.sqrt(20)


def test_draws_without_weight_move_no_particle() -> None:
    nothing = torch.full((10,), -torch.inf, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    leaves, _ = exchange(torch.zeros(5).double(), nothing, 0.5, generator)
    assert not leaves.any()
