"""Which rows of an episode the belief that was learnt from them does not explain.

An estimate takes rows that fit nothing for outliers. That is right of single ones; of many it
hides that the data are not of such a scene, or that the model lacks something.
"""

from __future__ import annotations

from typing import Any

import torch

from tpcd.belief.belief import Belief
from tpcd.commands.prediction import measured_rows, one_step, prediction_error
from tpcd.data.episode import Episode
from tpcd.predict import ContactPredictor
from tpcd.prediction import CHANNELS

FAR = 5.0
"""Standard deviations from its prediction at which a row counts as not explained. What is learnt
from few draws is a little too sure, and the row itself is among what it was learnt from."""
LARGE_SHARE = 0.2
"""Share of rows that are not explained from which a command warns, and"""
MANY = 3
"""the least number of them."""


@torch.no_grad()
def unexplained_rows(episode: Episode, belief: Belief) -> list[dict[str, Any]]:
    """The rows that lie further than `FAR` from what the belief predicts of them one step ahead,
    noise included: `row` (0 is the free start), the `channel` that is furthest off, and by how many
    `deviations`, without a sign; both None where no particle has an answer."""
    found = one_step(ContactPredictor(belief), episode, "measured")
    off = (prediction_error(measured_rows(episode)[1:], found.mean) / found.std).abs()
    most, channel = off.max(-1)
    return [
        {
            "row": k + 1,
            "channel": CHANNELS[int(channel[k])] if found.answered[k] else None,
            "deviations": float(most[k]) if found.answered[k] else None,
        }
        for k in torch.nonzero(~found.answered | (most > FAR)).flatten().tolist()
    ]


def unexplained_warning(found: list[dict[str, Any]], total: int) -> str | None:
    """One line where at least `LARGE_SHARE` of a `total` of rows, and at least `MANY`, are not
    explained; else None."""
    if len(found) < max(MANY, LARGE_SHARE * total):
        return None
    worst = max(found, key=lambda row: row["deviations"] or 0.0)
    most = ""
    if worst["deviations"] is not None:
        most = f" (row {worst['row']}: {worst['channel']} by {worst['deviations']:.0f})"
    return (
        f"{len(found)} of {total} rows lie more than {FAR:.0f} standard deviations from what was"
        f" learnt{most}: the estimate is not to be trusted; check the recording, its stiffness and"
        " sensor_std, or let scripts/diagnose.py find what the model lacks"
    )
