"""Rows that are the same measurement: copied within a recording, or given twice.

Noise leaves no two rows alike to the last digit, unless they are printed with few digits or have no
noise; so what is learnt from rows that come twice is too sure, and what is tested on rows that were
learnt from tells nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np

from tpcd.data.equilibrium import noise_ratio
from tpcd.quality.finding import Finding, Weight

if TYPE_CHECKING:
    from tpcd.data.episode import Episode

CHANCE = 1e-4
"""Rows alike are told where chance makes fewer of them than this."""
NOISELESS = 0.1
"""What is left over of the wrench, in its stated noise, from which on there is any noise."""


def row_marks(episode: Episode) -> list[str]:
    """A short fingerprint of each row's command, pose and wrench."""
    rows = np.column_stack(
        (episode.commands.numpy(), episode.poses.numpy(), episode.wrenches.numpy())
    )
    # Adding 0 makes -0 the same number.
    return [hashlib.blake2b(row.tobytes(), digest_size=8).hexdigest() for row in rows + 0.0]


def rows_among(episode: Episode, marks: Collection[str]) -> list[int]:
    """The rows after the start that are among those with such marks; none where chance, few digits
    or a lack of noise may make them so, unless all are."""
    own = row_marks(episode)[1:]
    found = [k + 1 for k, mark in enumerate(own) if mark in marks]
    sure = _alike(episode) * len(own) * len(marks) < CHANCE
    return found if sure or len(found) == len(own) else []


def copied_rows(episode: Episode) -> tuple[Finding, ...]:
    """Rows that are those of an earlier row again."""
    first: dict[str, int] = {}
    pairs = [(k, first.setdefault(mark, k)) for k, mark in enumerate(row_marks(episode))]
    pairs = [(k, of) for k, of in pairs if k != of and of > 0]
    if not pairs or _alike(episode) * len(episode) ** 2 > CHANCE:
        return ()
    shown = ", ".join(f"row {k} is row {of}" for k, of in pairs[:6])
    more = f" and {len(pairs) - 6} more" if len(pairs) > 6 else ""
    told = f"{shown}{more} again, to the last digit of all columns, which no two measurements are"
    remedy = "remove what was copied"
    return (Finding("copied", Weight.DOUBT, told, rows=(pairs[0][0], pairs[-1][0] + 1),
                    remedy=remedy),)  # fmt: skip


def _alike(episode: Episode) -> float:
    """Probability, roughly and at most, that two measurements of one place have the same digits:
    how often a reading comes twice in rows that are not alike, of each channel with noise; 1 where
    w is K (x - u) without any, as in a simulation."""
    std, stiffness = episode.sensor_std.numpy(), episode.stiffness.numpy()
    rows = (episode.commands.numpy(), episode.poses.numpy(), episode.wrenches.numpy())
    ratio = noise_ratio(rows, stiffness, std)
    if ratio is None or ratio < NOISELESS:
        return 1.0
    readings = np.unique(np.column_stack(rows), axis=0)[:, 3:]
    alike, pairs = 1.0, len(readings) * (len(readings) - 1) / 2
    for column in readings.T[std > 0]:
        _, counts = np.unique(column, return_counts=True)
        alike *= (float((counts * (counts - 1)).sum()) / 2 + 1) / (pairs + 1)
    return alike
