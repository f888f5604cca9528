"""Climbing to modes, and the share that each gets, on targets with known answers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from linear_model import Unchanged
from torch import Tensor

from tpcd.belief.cloud import CURVATURE_COST, Counted, start_cloud
from tpcd.belief.importance import draw_pool
from tpcd.belief.modes import climb, climb_with_the_best, find_modes, log_target, set_out
from tpcd.belief.settings import SamplerSettings

DIMENSION = 2
CENTRES = torch.tensor([[2.0, 0.0], [-2.0, 1.0], [0.0, -3.0]], dtype=torch.float64)
SHARES = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
WIDTH = 0.1
NONE = torch.zeros(0, DIMENSION, dtype=torch.float64)


@dataclass(frozen=True)
class ThreeModes:
    """A likelihood of three narrow normals of known shares, under a flat enough prior."""

    prior_std: float = 3.0

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        normal = torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)
        return self.prior_std * normal

    def scatter(self, count: int, generator: torch.Generator) -> Tensor:
        return self.sample(count, generator)

    def log_prior(self, x: Tensor) -> Tensor:
        square = (x**2).sum(-1) / self.prior_std**2
        return -0.5 * square - DIMENSION * math.log(self.prior_std * math.sqrt(2 * math.pi))

    def log_likelihood(self, x: Tensor, least: Tensor | None) -> Tensor:
        square = ((x[:, None] - CENTRES) ** 2).sum(-1) / WIDTH**2
        # Shares of the posterior, so the prior at the centres is taken out.
        terms = SHARES.log() - self.log_prior(CENTRES) - 0.5 * square
        return torch.logsumexp(terms, -1) - math.log(2 * math.pi * WIDTH**2)

    def curvature(self, x: Tensor) -> tuple[Tensor, Tensor]:
        nearest = ((x[:, None] - CENTRES) ** 2).sum(-1).argmin(-1)
        gradient = (CENTRES[nearest] - x) / WIDTH**2
        return gradient, torch.eye(DIMENSION).double().expand(len(x), -1, -1) / WIDTH**2

    def log_likelihood_and_contact(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.log_likelihood(x, None), x[:, :0]

    def rough(self) -> ThreeModes:
        return self

    def coordinates(self, x: Tensor, weights: Tensor, contact: Tensor) -> Unchanged:
        return Unchanged()


def test_a_climb_gains_at_every_step_and_arrives() -> None:
    target = ThreeModes()
    start = target.sample(50, torch.Generator().manual_seed(0))
    heights = [log_target(target, start)]
    for rounds in (1, 2, 4, 8):
        arrived = climb(target, set_out(target, start), rounds)
        assert (arrived.height >= heights[-1]).all()
        torch.testing.assert_close(arrived.height, log_target(target, arrived.points))
        heights.append(arrived.height)
    assert ((arrived.points[:, None] - CENTRES).norm(dim=-1).amin(-1) < 0.01).all()


def test_the_lower_half_gives_up_until_as_many_are_left_as_may_be_kept() -> None:
    target = ThreeModes()
    start = target.sample(40, torch.Generator().manual_seed(0))
    settings = SamplerSettings(modes=10, climbing_rounds=0)
    climbers = set_out(target, start)
    best = climb_with_the_best(target, climbers, settings)
    index = climbers.height.argsort(descending=True)[:10]
    torch.testing.assert_close(best.points, start[index])
    torch.testing.assert_close(best.height, climbers.height[index])
    all_kept = climb_with_the_best(target, climbers[torch.arange(10)], settings)
    torch.testing.assert_close(all_kept.points, start[:10])


def test_where_a_step_did_not_gain_nothing_is_surveyed_again() -> None:
    asked: list[Tensor] = []

    class Steep(ThreeModes):
        """Steps of thrice their length gain only from far away, or after some damping."""

        def curvature(self, x: Tensor) -> tuple[Tensor, Tensor]:
            asked.append(x)
            gradient, information = super().curvature(x)
            return gradient, information / 3

    target = Steep()
    counted = Counted(target)
    start = target.sample(30, torch.Generator().manual_seed(3))
    arrived = climb(counted, set_out(counted, start), 5)
    points = torch.cat(asked)
    assert len(points) == len(points.unique(dim=0)) < 5 * 30
    assert counted.evaluations == (1 + 5) * 30 + CURVATURE_COST * len(points)
    surveyed = arrived.surveyed(counted)
    gradient, information = target.curvature(arrived.points)
    torch.testing.assert_close(surveyed.gradient, gradient)
    torch.testing.assert_close(surveyed.information, information)


def test_a_step_need_only_be_followed_as_far_as_it_can_gain() -> None:
    target = ThreeModes()
    points = target.sample(20, torch.Generator().manual_seed(4))
    height = log_target(target, points)
    asked: list[Tensor] = []

    class Limited(ThreeModes):
        def log_likelihood(self, x: Tensor, least: Tensor | None) -> Tensor:
            assert least is not None
            asked.append(least)
            return super().log_likelihood(x, least)

    torch.testing.assert_close(log_target(Limited(), points, height - 1.0), height)
    torch.testing.assert_close(asked[0], target.log_likelihood(points, None) - 1.0)


def test_each_mode_is_found_once_and_remembered() -> None:
    target, generator = ThreeModes(), torch.Generator().manual_seed(1)
    settings = SamplerSettings(fresh_modes=60, modes=60, climbing_rounds=6)
    peaks = find_modes(target, NONE, settings, generator)
    assert len(peaks.points) == 3
    assert (torch.cdist(CENTRES, peaks.points).amin(-1) < 0.01).all()
    one = SamplerSettings(fresh_modes=1, modes=10)
    again = find_modes(target, peaks.points, one, generator)
    torch.testing.assert_close(again.points, peaks.points, atol=1e-3, rtol=0)


def test_points_of_known_height_set_out_without_being_evaluated() -> None:
    counted = Counted(ThreeModes())
    points = counted.sample(20, torch.Generator().manual_seed(4))
    height = log_target(ThreeModes(), points)
    told = set_out(counted, points, height)
    assert counted.evaluations == 0
    asked = set_out(counted, points)
    assert counted.evaluations == 20
    for name, value in vars(told).items():
        torch.testing.assert_close(value, getattr(asked, name))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_remembered_modes_never_give_up_and_every_point_is_evaluated_once(count: int) -> None:
    """Far out, beside many fresh points of which only the best two go on."""
    surveyed: list[Tensor] = []

    class Noted(ThreeModes):
        def curvature(self, x: Tensor) -> tuple[Tensor, Tensor]:
            surveyed.append(x)
            return super().curvature(x)

    counted, generator = Counted(Noted()), torch.Generator().manual_seed(5)
    settings = SamplerSettings(fresh_modes=16, modes=2, climbing_rounds=0, following_rounds=0)
    far = torch.tensor([[9.0, 9.0], [-9.0, 9.0], [9.0, -9.0]], dtype=torch.float64)[:count]
    fresh = counted.sample(4, torch.Generator().manual_seed(6))
    peaks = find_modes(counted, far, settings, generator, fresh)
    (survivors,) = surveyed
    assert torch.equal(survivors[:count], far) and len(survivors) == count + 2
    assert counted.evaluations == count + 16 + 4 + CURVATURE_COST * len(survivors)
    torch.testing.assert_close(peaks.height, log_target(ThreeModes(), peaks.points))


@pytest.mark.parametrize("flat_rounds", [0, 4])
def test_a_cloud_in_one_mode_still_gives_all_modes_their_share_and_the_evidence(
    flat_rounds: int,
) -> None:
    target, generator = ThreeModes(), torch.Generator().manual_seed(2)
    normal = torch.randn(400, 2, generator=generator, dtype=torch.float64)
    cloud = start_cloud(CENTRES[0] + WIDTH * normal)
    settings = SamplerSettings(fresh_modes=60, modes=30, draws=6000, flat_rounds=flat_rounds)
    pool = draw_pool(cloud, target, 1, settings, generator)
    nearest = ((pool.positions[:, None] - CENTRES) ** 2).sum(-1).argmin(-1)
    weights = pool.log_weights.softmax(0)
    share = torch.zeros(3, dtype=torch.float64).index_add(0, nearest, weights)
    torch.testing.assert_close(share, SHARES, atol=0.05, rtol=0)
    # The prior varies a little within a mode: by less than 1 % of its height.
    assert abs(pool.log_evidence) < 4 * pool.log_evidence_std + 0.01
