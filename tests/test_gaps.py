"""How much of a gap is closed, and the bound of a gain, from numbers that are known."""

from __future__ import annotations

import math

import pytest
import torch
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
    assert gaps(before, after, torch.Generator()).typical == pytest.approx(1 - 1 / n)
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


@pytest.mark.parametrize(("rows", "runs"), [(31, 1), (60, 6)])
def test_intervals_hold_the_truth_as_often_as_they_say(rows: int, runs: int) -> None:
    """Of independent normal errors, all of them or half of them in runs of one contact."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.full((rows, 6), 0.1, dtype=torch.float64)
    contact = (torch.arange(rows) // runs) % 2
    held = []
    for _ in range(60):
        error = torch.randn(rows, 6, generator=generator, dtype=torch.float64)
        found = gaps(*(errors_of(error, noise, contact),) * 2, generator)
        some = found.channels if runs == 1 else found.by_contact
        held += [gap.before_low < 1.0 < gap.before_high for gap in some]
    assert 0.85 < sum(held) / len(held) < 0.95


def test_few_rows_of_a_contact_have_no_interval() -> None:
    n = 40
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    contact = torch.zeros(n, dtype=torch.long)
    contact[20:24] = 1
    off = torch.where(contact == 1, 4.0, 2.0)[:, None] * noise
    before, after = errors_of(off, noise, contact), errors_of(noise, noise, contact)
    found = {gap.contact: gap for gap in gaps(before, after, torch.Generator()).by_contact}
    few, many = found["floor"], found["free"]
    assert few.rows == 4 and few.before == pytest.approx(0.4) and few.closed == pytest.approx(1.0)
    assert math.isnan(few.before_low) and math.isnan(few.closed_low)
    assert many.before_low == pytest.approx(0.2) and many.closed_low == pytest.approx(1.0)


def test_what_chance_may_make_has_no_interval() -> None:
    """An excess of a fifth of the noise in the mean, of which many resamples have none."""
    n, generator = 60, torch.Generator().manual_seed(1)
    noise = torch.full((n, 6), 0.1, dtype=torch.float64)
    shares = []
    for _ in range(40):
        error = 0.11 * torch.randn(n, 6, generator=generator, dtype=torch.float64)
        found = gaps(errors_of(error, noise), errors_of(0.9 * error, noise), generator)
        shares += [(found.share, found.low)]
        shares += [(gap.closed, gap.closed_low) for gap in found.channels]
    known = [(share, low) for share, low in shares if not math.isnan(share)]
    assert 20 < len(known) < len(shares) - 20
    assert all(math.isnan(low) for share, low in shares if math.isnan(share))
    assert any(math.isnan(low) for _, low in known)


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
