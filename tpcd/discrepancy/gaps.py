"""How large the gap between prediction and measurement is before and after, and how much is closed.

Errors are those of one-step predictions, of all rows and by what the rows touch; intervals come
from a bootstrap of blocks of rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.discrepancy.coverage import contact_rows
from tpcd.discrepancy.diagnosis import CHANNELS, Gap

BLOCK = 5
"""Transitions that the bootstrap keeps together."""
RESAMPLES = 2000
LEAST_EXCESS = 0.1
"""Share of the noise's variance that counts as a gap."""
TYPICAL = 0.95
"""Share of the rows whose largest square before bounds what a number counts in what is typical."""
FEWEST = 4
"""Rows of a contact that is told of."""
UNITS = ("m", "m", "rad", "N", "N", "N·m")
ALL = "all"
CONTACTS = ("free", "floor", "wall", "floor and wall")
"""What a row touches, as pose and command say (`contact_rows`)."""
_ENDS = torch.tensor([0.05, 0.95], dtype=torch.float64)


@dataclass(frozen=True)
class Errors:
    """Errors of one-step predictions in the mean, and what noise alone would leave."""

    error: Float[Tensor, "n 6"]
    noise: Float[Tensor, "n 6"]
    """Standard deviation of the error of a perfect model."""
    contact: Int[Tensor, " n"]
    """Place in `CONTACTS` of what each row touches."""


@dataclass(frozen=True)
class Gaps:
    """The gap before and after."""

    channels: tuple[Gap, ...]
    """One of each channel, over all rows; empty where no row is known before and after."""
    by_contact: tuple[Gap, ...]
    """The same for the rows of each contact that has enough of them."""
    share: float
    """Share closed of the excess of all channels together, in units of the noise; NaN without."""
    low: float
    """90 % interval of that share; NaN where chance alone makes such an excess."""
    high: float


def contact_of(episode: Episode) -> Int[Tensor, " n"]:
    """What every transition of an episode ends in, as a place in `CONTACTS`."""
    floored, walled = contact_rows(episode)
    return (floored.long() + 2 * walled.long())[1:]


def gaps(before: Errors, after: Errors, generator: torch.Generator) -> Gaps:
    """The gap of each channel before and after, and the share closed of all of it.

    `generator` draws the blocks of the bootstrap. Rows that one of both does not predict count
    in neither.
    """
    *squares, floor = _squares(before, after)
    if not len(floor):
        return Gaps((), (), math.nan, math.nan, math.nan)
    contact = before.contact[_known(before, after)]
    draws = _block_draws(len(floor), generator)
    everything = torch.ones(len(floor), dtype=torch.bool)
    channels = _of_rows(ALL, everything, squares, floor, draws)
    by_contact: list[Gap] = []
    for place, name in enumerate(CONTACTS):
        rows = contact == place
        if int(rows.sum()) >= FEWEST:
            by_contact += _of_rows(name, rows, squares, floor, draws)
    was, now = (part / floor for part in squares)
    drawn = _together(was[draws].mean((1, 2)), now[draws].mean((1, 2)), was.numel())
    share = _together(was.mean(), now.mean(), was.numel())
    return Gaps(tuple(channels), tuple(by_contact), float(share), *_interval(drawn[:, None])[0])


def typical_share(before: Errors, after: Errors) -> float:
    """Share closed of all of the gap (nan where there is none), where no number counts for more
    than in nearly all rows before: a few rows that land in another contact decide nothing."""
    *squares, floor = _squares(before, after)
    if not len(floor):
        return math.nan
    was, now = (part / floor for part in squares)
    most = torch.quantile(was.amax(-1), TYPICAL)
    means = (part.clamp_max(most).mean() for part in (was, now))
    return float(_together(*means, was.numel()))


def _of_rows(
    contact: str,
    rows: Bool[Tensor, " n"],
    squares: list[Float[Tensor, "n 6"]],
    floor: Float[Tensor, "n 6"],
    draws: Int[Tensor, "r k"],
) -> list[Gap]:
    """The gap of each channel over some of the rows, with intervals of those that were drawn."""
    count = int(rows.sum())
    weight = rows[draws].double()
    weight = weight / weight.sum(1, keepdim=True)  # NaN where none of the rows was drawn
    means = [part[rows].mean(0) for part in (*squares, floor)]
    drawn = [torch.einsum("rk,rkc->rc", weight, part[draws]) for part in (*squares, floor)]
    closed, closes = _closed(*means, count), _closed(*drawn, count)
    rms, was, now = [part.sqrt() for part in means], drawn[0].sqrt(), drawn[1].sqrt()
    ends = [_interval(part) for part in (was, now, closes)]
    return [
        Gap(
            *(channel, UNITS[c], contact, count),
            *(float(rms[0][c]), *ends[0][c]),
            *(float(rms[1][c]), *ends[1][c]),
            float(rms[2][c]),
            *(float(closed[c]), *ends[2][c]),
        )
        for c, channel in enumerate(CHANNELS)
    ]


def _closed(was: Tensor, now: Tensor, least: Tensor, rows: int) -> Tensor:
    """Share of the excess over the noise that is gone, from mean squares of so many rows; NaN
    where chance alone makes such an excess."""
    excess = was - least
    share = (was - torch.maximum(now, least)) / excess
    return torch.where(excess > _chance(rows) * least, share, torch.nan)


def _together(was: Tensor, now: Tensor, numbers: int) -> Tensor:
    """The same of all channels, from mean squares of so many numbers in units of the noise."""
    return _closed(was, now, torch.ones_like(was), numbers)


def _chance(count: int) -> float:
    """The excess that chance makes in a mean of so many squares, in units of the noise."""
    return max(LEAST_EXCESS, 2.0 * math.sqrt(2.0 / count))


def _interval(drawn: Float[Tensor, "r c"]) -> list[tuple[float, float]]:
    """90 % interval of each column of what was drawn, as far as it is known."""
    found = []
    for column in drawn.T:
        known = column[~column.isnan()]
        low, high = torch.quantile(known, _ENDS).tolist() if len(known) else (math.nan, math.nan)
        found.append((low, high))
    return found


def _known(before: Errors, after: Errors) -> Bool[Tensor, " n"]:
    """Rows in which all numbers are known, before and after."""
    parts = (before.error, after.error, after.noise)
    return torch.stack([torch.isfinite(part).all(-1) for part in parts]).all(0)


def _squares(before: Errors, after: Errors) -> list[Float[Tensor, "n 6"]]:
    """Squared errors before and after, and noise, of the rows that are known."""
    known = _known(before, after)
    return [torch.square(part[known]) for part in (before.error, after.error, after.noise)]


def _block_draws(n: int, generator: torch.Generator) -> Int[Tensor, "r k"]:
    """Rows (RESAMPLES, about n) of blocks drawn with replacement."""
    starts = torch.arange(0, n, BLOCK)
    chosen = starts[torch.randint(len(starts), (RESAMPLES, len(starts)), generator=generator)]
    rows = chosen[..., None] + torch.arange(min(BLOCK, n))
    return rows.flatten(1).clamp_max(n - 1)
