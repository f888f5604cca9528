"""How much of a gap is closed, and the bound of a gain, from numbers that are known."""

from __future__ import annotations

import math

import pytest
import torch

from tpcd.discrepancy.heldout import Errors, gaps, lower_bound, typical_share


def test_gaps_and_bounds_of_numbers_known_by_hand() -> None:
    n = 40
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    sign = torch.tensor([1.0, -1.0]).double().repeat(n // 2)[:, None]
    before, after = Errors(0.5 * sign.expand(n, 6), noise), Errors(0.2 * sign.expand(n, 6), noise)
    found, share = gaps(before, after, torch.Generator().manual_seed(0))
    expected = (0.25 - 0.04) / (0.25 - 0.01)
    assert [gap.closed for gap in found] == pytest.approx([expected] * 6)
    assert found[0].low == pytest.approx(expected) and share == pytest.approx(expected)
    nothing, none = gaps(Errors(noise, noise), Errors(noise, noise), torch.Generator())
    assert math.isnan(nothing[0].closed) and math.isnan(none)
    gain = torch.ones(n, dtype=torch.float64)
    assert lower_bound(gain, torch.Generator().manual_seed(0)) == pytest.approx(1.0)
    gain[: n // 2] = -1.0
    assert lower_bound(gain, torch.Generator().manual_seed(0)) < 0


def test_a_row_in_another_contact_decides_nothing() -> None:
    """All others go from five times the noise to once; one goes to thirty times."""
    n = 40
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    before, after = Errors(5 * noise, noise), Errors(noise.clone(), noise)
    after.error[7] = 30 * noise[7]
    assert gaps(before, after, torch.Generator().manual_seed(0))[1] < 0.1
    # At most as far off as before: one row of forty.
    assert typical_share(before, after) == pytest.approx(1 - 1 / n)
    assert math.isnan(typical_share(Errors(noise, noise), Errors(noise, noise)))
    assert typical_share(before, Errors(6 * noise, noise)) == 0.0
    # What shows in a few rows and channels alone is a gap.
    rare = Errors(noise.clone(), noise)
    rare.error[:5, :2] = 8 * noise[:5, :2]
    assert typical_share(rare, Errors(noise, noise)) == pytest.approx(1.0)
