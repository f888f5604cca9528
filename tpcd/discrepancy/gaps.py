"""How large the gap between prediction and measurement is before and after, and what is closed.

Errors are those of one-step predictions, of all rows and by what the rows touch. A few rows that
follow each other count as one block. Intervals of errors are those of Student's t for the
logarithm of the mean square, intervals of shares those of a bootstrap of blocks, with percentiles
as wide as so few blocks ask for (expanded percentile intervals: Hesterberg 2015).
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

BLOCK = 3
"""Rows that the bootstrap keeps together: about as many as a touch lasts."""
FEWEST_BLOCKS = 5
"""With fewer there are no intervals."""
RESAMPLES = 2000
LEVEL = 0.9
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
    """90 % interval of that share; NaN where there is no share or chance may leave none."""
    high: float
    typical: float
    """That share by `typical_share`."""


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
        return Gaps((), (), *(math.nan,) * 4)
    contact = before.contact[_known(before, after)]
    everything = torch.ones(len(floor), dtype=torch.bool)
    channels = _of_rows(ALL, everything, squares, floor, generator)
    by_contact: list[Gap] = []
    for place, name in enumerate(CONTACTS):
        rows = contact == place
        if int(rows.sum()) >= FEWEST:
            by_contact += _of_rows(name, rows, squares, floor, generator)
    each = torch.stack([(part / floor).mean(-1) for part in squares], dim=-1)
    share = _together(*each.mean(0), floor.numel())
    drawn = _together(*_resampled(each, generator).T, floor.numel())
    ends = _ends(share, drawn, len(each))
    typical = typical_share(before, after)
    return Gaps(tuple(channels), tuple(by_contact), float(share), *ends, typical)


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
    generator: torch.Generator,
) -> list[Gap]:
    """The gap of each channel over some of the rows."""
    count = int(rows.sum())
    table = torch.stack([part[rows] for part in (*squares, floor)], dim=1)
    found = table.mean(0)
    drawn = _resampled(table.flatten(1), generator).unflatten(1, found.shape)
    closed, closes = _closed(*found, count), _closed(*drawn.unbind(1), count)
    before, after, noise = found.sqrt().tolist()
    ends = [_ends_of_errors(part[rows]) for part in squares]
    return [
        Gap(
            *(channel, UNITS[c], contact, count),
            *(before[c], *ends[0][c], after[c], *ends[1][c], noise[c]),
            *(float(closed[c]), *_ends(closed[c], closes[:, c], count)),
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


def _blocks(values: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b 1"]]:
    """Sums over blocks of rows, and numbers of rows."""
    blocks = values.split(BLOCK)
    sums = torch.stack([block.sum(0) for block in blocks])
    return sums, values.new_tensor([[len(block)] for block in blocks])


def _resampled(values: Float[Tensor, "n k"], generator: torch.Generator) -> Float[Tensor, "r k"]:
    """Means over blocks of rows that are drawn with replacement."""
    sums, counts = _blocks(values)
    draws = torch.randint(len(sums), (RESAMPLES, len(sums)), generator=generator)
    times = values.new_zeros(RESAMPLES, len(sums))
    times.scatter_add_(1, draws, torch.ones_like(times))
    return (times @ sums) / (times @ counts)


def _quantile_of_t(blocks: int) -> float:
    from scipy.stats import t

    return float(t.ppf((1 + LEVEL) / 2, blocks - 1))


def _ends_of_errors(squares: Float[Tensor, "n 6"]) -> list[tuple[float, float]]:
    """90 % interval of the root mean square of each channel; NaN for too few rows."""
    sums, counts = _blocks(squares)
    if len(sums) < FEWEST_BLOCKS:
        return [(math.nan, math.nan)] * squares.shape[1]
    mean = squares.mean(0)
    variance = (sums - counts * mean).square().sum(0) * len(sums) / (len(sums) - 1)
    deviation = variance.sqrt() / (mean * len(squares))  # of the logarithm of the mean
    factor = torch.exp(0.5 * _quantile_of_t(len(sums)) * deviation)
    rms = mean.sqrt()
    return list(zip((rms / factor).tolist(), (rms * factor).tolist(), strict=True))


def _ends(share: Tensor, drawn: Float[Tensor, " r"], rows: int) -> tuple[float, float]:
    """90 % interval of a share of so many rows; NaN where it is not known, or of more of those that
    were drawn than the interval leaves out."""
    from scipy.stats import norm

    blocks = -(-rows // BLOCK)
    known = drawn[~drawn.isnan()]
    if blocks < FEWEST_BLOCKS or not bool(share.isfinite()):
        return math.nan, math.nan
    # Percentiles of few blocks are too narrow, by the factor of t and of the variance.
    deviation = _quantile_of_t(blocks) * math.sqrt(blocks / (blocks - 1))
    tail = float(norm.sf(deviation))
    if len(known) < (1 - tail) * len(drawn):
        return math.nan, math.nan
    low, high = torch.quantile(known, known.new_tensor([tail, 1 - tail])).tolist()
    return low, high


def _known(before: Errors, after: Errors) -> Bool[Tensor, " n"]:
    """Rows in which all numbers are known, before and after."""
    parts = (before.error, after.error, after.noise)
    return torch.stack([torch.isfinite(part).all(-1) for part in parts]).all(0)


def _squares(before: Errors, after: Errors) -> list[Float[Tensor, "n 6"]]:
    """Squared errors before and after, and noise, of the rows that are known."""
    known = _known(before, after)
    return [torch.square(part[known]) for part in (before.error, after.error, after.noise)]
