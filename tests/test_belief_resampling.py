"""Laws of weights and resampling: float64 sums, zero weights, draws on an edge."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tpcd.belief import resampling
from tpcd.belief.resampling import (
    effective_sample_size,
    normalise_log_weights,
    systematic_resample,
    weighted_place,
    weighted_quantile,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@settings(max_examples=40)
@given(
    st.lists(st.floats(-700, 700) | st.just(-math.inf), min_size=1, max_size=30).filter(
        lambda values: max(values) > -math.inf
    ),
    st.integers(1, 200),
    st.integers(0, 1000),
)
def test_systematic_counts_are_floor_or_ceil_of_their_share(
    log_weights: list[float], count: int, seed: int
) -> None:
    weights = normalise_log_weights(torch.tensor(log_weights, dtype=torch.float64))
    assert float(weights.sum()) == pytest.approx(1.0, abs=1e-12)
    index = systematic_resample(weights, count, generator(seed))
    found = torch.bincount(index, minlength=len(weights))
    share = count * weights
    assert (found >= torch.floor(share - 1e-9)).all()
    assert (found <= torch.ceil(share + 1e-9)).all()
    assert (found[weights == 0] == 0).all()


def test_weights_are_free_of_a_common_factor_even_far_below_underflow() -> None:
    log_weights = torch.tensor([0.0, -1.0, -2.0], dtype=torch.float64)
    torch.testing.assert_close(
        normalise_log_weights(log_weights), normalise_log_weights(log_weights - 1e5)
    )


def test_minus_infinity_has_weight_zero_and_one_dominant_takes_all() -> None:
    weights = normalise_log_weights(torch.tensor([-torch.inf, 0.0, -800.0]))
    assert weights.tolist() == [0.0, 1.0, 0.0]
    assert effective_sample_size(weights) == 1.0
    assert systematic_resample(weights, 5, generator()).tolist() == [1] * 5


@pytest.mark.parametrize("values", [[-math.inf, -math.inf], [math.nan, 0.0], [math.inf, 0.0]])
def test_weights_without_meaning_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="largest log weight"):
        normalise_log_weights(torch.tensor(values))


def test_equal_weights_return_every_particle_once() -> None:
    weights = normalise_log_weights(torch.zeros(1000))
    assert effective_sample_size(weights) == pytest.approx(1000)
    for seed in range(5):
        index = systematic_resample(weights, 1000, generator(seed))
        assert sorted(index.tolist()) == list(range(1000))


def test_float32_weights_are_summed_in_float64() -> None:
    """A running float32 sum of 200,000 shares of 5e-6 would be off by several shares."""
    weights = torch.full((200_000,), 1 / 200_000, dtype=torch.float32)
    index = systematic_resample(weights, 200_000, generator(3))
    counts = torch.bincount(index, minlength=len(weights))
    assert counts.max() <= 2
    assert (counts == 1).double().mean() > 0.99


@pytest.mark.parametrize("start", [0.0, 1.0 - 2**-53])
def test_draws_exactly_on_an_edge_never_pick_a_zero_weight(
    start: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixed = torch.tensor(start, dtype=torch.float64)
    monkeypatch.setattr(resampling.torch, "rand", lambda *_, **__: fixed)
    weights = torch.tensor([0.0, 0.25, 0.0, 0.25, 0.5, 0.0], dtype=torch.float64)
    index = systematic_resample(weights, 4, generator())
    assert (weights[index] > 0).all()
    assert torch.bincount(index, minlength=6).sub(4 * weights).abs().max() <= 1


@pytest.mark.parametrize("count", [20, 37, 150])
def test_intervals_of_few_draws_hold_a_further_draw_as_often_as_they_say(count: int) -> None:
    runs = 20_000
    draws = torch.randn(count, runs, generator=generator(1), dtype=torch.float64)
    truth = torch.randn(runs, generator=generator(2), dtype=torch.float64)
    weights = torch.full((count,), 1.0 / count, dtype=torch.float64)
    for level in (0.5, 0.9):
        ends = [0.5 - level / 2, 0.5 + level / 2]
        low, high = (weighted_quantile(draws, weights, end, float(count)) for end in ends)
        inside = float(((low <= truth) & (truth <= high)).double().mean())
        # An interval ends at a draw: up to half a rank of what is asked for at each end.
        rounding = 1.0 / (count + 1)
        assert abs(inside - level) < rounding + 4 * math.sqrt(0.25 / runs)
    place = weighted_place(draws, weights, truth, float(count))
    held = ((place >= 0.05) & (place <= 0.95)).double().mean()
    plain = weighted_place(draws, weights, truth)
    without = ((plain >= 0.05) & (plain <= 0.95)).double().mean()
    assert abs(float(held) - 0.9) < 2.0 / (count + 1)
    assert float(without) <= float(held)
    quantile = weighted_quantile(draws, weights, 0.3, float(count))
    at_quantile = weighted_place(draws, weights, quantile, float(count))
    assert ((at_quantile - 0.3).abs() <= 1.0 / (count + 1)).all()


def test_quantiles_and_places_stay_within_values_that_have_a_weight() -> None:
    values = torch.tensor([[5.0], [1.0], [2.0], [9.0]], dtype=torch.float64)
    weights = torch.tensor([0.5, 0.0, 0.5, 0.0], dtype=torch.float64)
    for level in (0.001, 0.05, 0.95, 0.999):
        for effective in (1.0, 2.0, math.inf):
            found = float(weighted_quantile(values, weights, level, effective))
            assert found == (2.0 if level < 0.5 else 5.0)
    at = torch.tensor([1.5], dtype=torch.float64)
    assert weighted_place(values, weights, at, 2.0).tolist() == [0.0]
    assert weighted_place(values, weights, at + 7, 2.0).tolist() == [1.0]
    assert weighted_place(values, weights, at + 2, 2.0).tolist() == [0.5]
