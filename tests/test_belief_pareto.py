"""Pareto-smoothed weights: the fit against known distributions, and laws of the smoothing."""

from __future__ import annotations

import math

import pytest
import torch

from tpcd.belief.pareto import fit_pareto, smooth_weights


def log_weights(count: int, shape: float, seed: int = 0) -> torch.Tensor:
    """Logs of draws from a Pareto distribution, whose tail has the shape."""
    uniform = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return -shape * torch.log1p(-uniform)


@pytest.mark.parametrize("shape", [0.2, 0.5, 1.0])
def test_the_fit_recovers_a_generalised_pareto_distribution(shape: float) -> None:
    generator = torch.Generator().manual_seed(1)
    uniform = torch.rand(20_000, generator=generator, dtype=torch.float64)
    excess = 2.0 * torch.expm1(-shape * torch.log1p(-uniform)) / shape
    found, scale = fit_pareto(excess.sort().values)
    assert found == pytest.approx(shape, abs=0.05)
    assert scale == pytest.approx(2.0, rel=0.1)


def test_smoothing_keeps_sum_order_and_all_but_the_tail() -> None:
    given = log_weights(4000, 0.7)
    weights, shape = smooth_weights(given)
    plain = given.softmax(0)
    assert float(weights.sum()) == pytest.approx(1.0)
    assert 0.4 < shape < 1.0
    order = plain.argsort()
    assert (weights[order].diff() >= -1e-15).all()
    body = order[: -math.ceil(3 * math.sqrt(4000))]
    ratio = weights[body] / plain[body]
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio))
    assert float(weights.max()) <= 1.5 * float(plain.max())


def test_smoothed_means_scatter_less_where_the_tail_is_heavy() -> None:
    """400 samples of 1000 weights of shape 0.8: self-normalised means of an independent normal."""
    plain, smoothed = [], []
    for seed in range(400):
        values = torch.randn(1000, generator=torch.Generator().manual_seed(seed + 1000)).double()
        given = log_weights(1000, 0.8, seed)
        plain.append(float(given.softmax(0) @ values))
        smoothed.append(float(smooth_weights(given)[0] @ values))
    spread = [float(torch.tensor(v).square().mean().sqrt()) for v in (plain, smoothed)]
    assert spread[1] < 0.95 * spread[0]


def test_even_and_impossible_weights_pass_through() -> None:
    even, shape = smooth_weights(torch.zeros(50, dtype=torch.float64))
    torch.testing.assert_close(even, torch.full((50,), 0.02, dtype=torch.float64))
    assert shape == 0.0
    few = torch.full((50,), -torch.inf, dtype=torch.float64)
    few[:3] = 0.0
    weights, shape = smooth_weights(few)
    assert weights[:3].tolist() == pytest.approx([1 / 3] * 3)
    assert shape == math.inf
    with pytest.raises(ValueError, match="no particle"):
        smooth_weights(torch.full((50,), -torch.inf, dtype=torch.float64))
