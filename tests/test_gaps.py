"""How much of a gap is closed, and the bound of a gain, from numbers that are known."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.discrepancy.gaps import CONTACTS, FEWEST, Errors, contact_of, gaps, typical_share
from tpcd.discrepancy.heldout import lower_bound


def errors_of(error: Tensor, noise: Tensor, contact: Tensor | None = None) -> Errors:
    """Of rows that touch nothing, unless said."""
    free = torch.zeros(len(error), dtype=torch.long)
    return Errors(error, noise, free if contact is None else contact)


def test_gaps_and_bounds_of_numbers_known_by_hand() -> None:
    n = 40
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    sign = torch.tensor([1.0, -1.0]).double().repeat(n // 2)[:, None]
    before, after = (
        errors_of(0.5 * sign.expand(n, 6), noise),
        errors_of(0.2 * sign.expand(n, 6), noise),
    )
    found = gaps(before, after, torch.Generator().manual_seed(0))
    expected = (0.25 - 0.04) / (0.25 - 0.01)
    assert [gap.closed for gap in found.channels] == pytest.approx([expected] * 6)
    first = found.channels[0]
    assert (first.closed_low, first.closed_high) == pytest.approx((expected, expected))
    assert (first.before, first.before_low, first.after, first.after_high) == pytest.approx(
        (0.5, 0.5, 0.2, 0.2)
    )
    assert (found.share, found.low, found.high) == pytest.approx((expected,) * 3)
    nothing = gaps(errors_of(noise, noise), errors_of(noise, noise), torch.Generator())
    assert math.isnan(nothing.channels[0].closed) and math.isnan(nothing.share)
    assert math.isnan(nothing.low) and math.isnan(nothing.channels[0].closed_low)
    gain = torch.ones(n, dtype=torch.float64)
    assert lower_bound(gain, torch.Generator().manual_seed(0)) == pytest.approx(1.0)
    gain[: n // 2] = -1.0
    assert lower_bound(gain, torch.Generator().manual_seed(0)) < 0


def test_a_row_in_another_contact_decides_nothing() -> None:
    """All others go from five times the noise to once; one goes to thirty times."""
    n = 40
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    before, after = errors_of(5 * noise, noise), errors_of(noise.clone(), noise)
    after.error[7] = 30 * noise[7]
    assert gaps(before, after, torch.Generator().manual_seed(0)).share < 0.1
    # At most as far off as before: one row of forty.
    assert typical_share(before, after) == pytest.approx(1 - 1 / n)
    assert math.isnan(typical_share(errors_of(noise, noise), errors_of(noise, noise)))
    assert typical_share(before, errors_of(6 * noise, noise)) == 0.0
    # What shows in a few rows and channels alone is a gap.
    rare = errors_of(noise.clone(), noise)
    rare.error[:5, :2] = 8 * noise[:5, :2]
    assert typical_share(rare, errors_of(noise, noise)) == pytest.approx(1.0)


def test_each_contact_has_its_own_gap() -> None:
    """The floor's rows are off by four times the noise before, all others by none."""
    n = 48
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    floor, corner = CONTACTS.index("floor"), CONTACTS.index("floor and wall")
    contact = torch.tensor([0, floor, floor, 0]).repeat(n // 4)
    contact[: FEWEST - 1] = corner
    off = torch.where(contact == floor, 4.0, 1.0)[:, None] * noise
    before, after = errors_of(off, noise, contact), errors_of(noise.clone(), noise, contact)
    found = gaps(before, after, torch.Generator().manual_seed(0))
    by_contact = {(gap.contact, gap.channel): gap for gap in found.by_contact}
    assert {contact for contact, _ in by_contact} == {"free", "floor"}  # too few of the corner
    soft, free = by_contact["floor", "z"], by_contact["free", "z"]
    assert soft.rows == int((contact == floor).sum()) and soft.rows + free.rows == n - FEWEST + 1
    assert (soft.before, soft.after, soft.closed) == pytest.approx((0.4, 0.1, 1.0))
    assert free.before == pytest.approx(0.1) and math.isnan(free.closed)
    assert {gap.contact for gap in found.channels} == {"all"}


def test_intervals_are_as_wide_as_chance_makes_them() -> None:
    """Of independent normal errors: chi-square with as many degrees of freedom as rows."""
    n, generator = 400, torch.Generator().manual_seed(3)
    error = torch.randn(n, 6, generator=generator, dtype=torch.float64)
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    contact = torch.arange(n) % 2
    found = gaps(*(errors_of(error, noise, contact),) * 2, generator)
    for rows, some in ((n, found.channels), (n // 2, found.by_contact)):
        expected = math.sqrt(chi2.ppf(0.95, rows) / rows) - math.sqrt(chi2.ppf(0.05, rows) / rows)
        widths = torch.tensor([gap.before_high - gap.before_low for gap in some])
        assert float(widths.mean()) == pytest.approx(expected, rel=0.15)
        assert all(gap.before_low < gap.before < gap.before_high for gap in some)


def test_a_gap_of_which_no_row_is_known_is_none() -> None:
    unknown = torch.full((5, 6), math.nan, dtype=torch.float64)
    before = errors_of(unknown, torch.ones_like(unknown))
    found = gaps(before, before, torch.Generator())
    assert found.channels == found.by_contact == () and math.isnan(found.share)
    assert math.isnan(typical_share(before, before))


def test_what_rows_touch_is_read_from_pose_and_command() -> None:
    """Stiffness of 1000 N/m: a hand held 2 mm from its command is held with 2 N."""
    commands = torch.tensor([[0.0, 0.1], [0.0, -0.002], [0.502, 0.1], [0.506, -0.002]])
    poses = torch.tensor([[0.0, 0.1], [0.0, 0.0], [0.5, 0.1], [0.5, 0.0]])
    angle = torch.zeros(4, 1)
    episode = Episode(
        commands=torch.cat((commands, angle), 1).double(),
        poses=torch.cat((poses, angle), 1).double(),
        wrenches=torch.zeros(4, 3).double(),
        stiffness=torch.tensor([1000.0, 1000.0, 30.0]).double(),
        sensor_std=torch.full((6,), 1e-3).double(),
    )
    assert [CONTACTS[place] for place in contact_of(episode)] == ["floor", "wall", "floor and wall"]
