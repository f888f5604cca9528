"""Numbers that stand for 'no reading': -999, 9999, the largest float, 1e30.

They are what drivers and loggers write where nothing was read. A number of that kind counts as one
only where it lies apart from everything else that its channel reads; so a channel that moves up to
999 has none.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from tpcd.quality.channels import listed_rows

BEYOND = 1e15
"""No channel of an arm reads so much in any unit."""
LIMITS = (2.0**15, 2.0**15 - 1, 2.0**16 - 1, 2.0**31, 2.0**31 - 1, 2.0**32 - 1)
"""Ends of whole numbers: the largest one is written where nothing was read."""
APART = 10.0
"""A sentinel lies so many times further from all other readings than nearly all of their steps,"""
NEARLY_ALL = 0.999
OUTSIDE, NEAR = 0.25, 0.05
"""further than this part of their range, and than this part of itself."""
LARGEST = 1e6
"""A channel that reads one number only is believed up to here."""


def without_sentinels(
    values: Mapping[str, Float[np.ndarray, " n"]], where: str = ""
) -> tuple[dict[str, Float[np.ndarray, " n"]], list[str]]:
    """Channels with NaN in place of what stands for no reading, and sentences that tell of it."""
    kept, told = dict(values), []
    for name, column in values.items():
        for number, marked in find_sentinels(column).items():
            kept[name] = np.where(marked, np.nan, kept[name])
            count = int(marked.sum())
            told.append(
                f"{where}{name}: {count} of {len(column)} readings are {number:.7g}, which stands"
                f" for no reading (rows {listed_rows(np.flatnonzero(marked))}): left out"
            )
    return kept, told


def find_sentinels(values: Float[np.ndarray, " n"]) -> dict[float, Bool[np.ndarray, " n"]]:
    """Each number that stands for no reading, with the samples that hold it."""
    found: dict[float, Bool[np.ndarray, " n"]] = {}
    kept = np.isfinite(values)
    while kept.any():
        others = values[kept]
        ends = float(others.min()), float(others.max())
        number = next((each for each in ends if _is_sentinel(each, others)), None)
        if number is None:
            break
        found[number] = values == number
        kept &= ~found[number]
    return found


def _is_sentinel(number: float, values: Float[np.ndarray, " k"]) -> bool:
    """Whether a number that some of `values` are looks like a sentinel, and lies apart."""
    size = abs(number)
    if size > BEYOND:
        return True
    digits = f"{size:.9g}".replace(".", "").strip("0")
    nines = size >= 100.0 and len(digits) > 2 and set(digits) == {"9"}
    if not (
        nines or size in LIMITS or (size >= LARGEST and f"{size:.9e}".startswith("1.000000000"))
    ):
        return False
    others = values[values != number]
    if not len(others):
        return size > LARGEST
    steps = np.abs(np.diff(others))
    usual = float(np.quantile(steps, NEARLY_ALL)) if len(steps) else 0.0
    least = max(APART * usual, OUTSIDE * float(np.ptp(others)), NEAR * size)
    return float(np.abs(others - number).min()) > least
