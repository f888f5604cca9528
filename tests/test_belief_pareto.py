"""The tail of importance weights: the fit against known distributions."""

from __future__ import annotations

import math

import pytest
import torch

from tpcd.belief.pareto import fit_pareto, tail_shape


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


def test_the_shape_of_the_tail_is_found_from_weights() -> None:
    assert 0.4 < tail_shape(log_weights(4000, 0.7)) < 1.0
    light = torch.randn(4000, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert tail_shape(0.2 * light) < 0.4


def test_even_few_and_impossible_weights() -> None:
    assert tail_shape(torch.zeros(50, dtype=torch.float64)) == 0.0
    few = torch.full((50,), -torch.inf, dtype=torch.float64)
    few[:3] = 0.0
    assert tail_shape(few) == math.inf
    with pytest.raises(ValueError, match="no particle"):
        tail_shape(torch.full((50,), -torch.inf, dtype=torch.float64))
