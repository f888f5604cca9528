"""How well a belief explains a recording: the one that it was learnt from, or another one.

An estimate takes rows that fit nothing for outliers. That is right of single ones; of many it
hides that the data are not of such a scene, or that the model lacks something. A prediction of a
recording from elsewhere is as sure as one of the right scene, and wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.commands.prediction import PredictedRows, measured_rows, predict_rows, prediction_error
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
FEW_INSIDE = 0.5
"""Share of readings in their 90 % intervals below which a recording does not fit. Of one scene it
varies by more than the number of rows tells, since all of them have the errors of one belief."""
BEYOND_NOISE = 3.0
"""An outline that is surely off by so many times the noise of the position is none of the prior."""


@dataclass(frozen=True)
class Fit:
    """What one-step predictions, noise included, say of a recording."""

    rows: int
    """Rows predicted."""
    inside: float
    """Share of readings that lie in their 90 % intervals; what has no answer lies outside."""
    unexplained: list[dict[str, Any]]
    """The rows further than `FAR` from their prediction: `row` (0 is the free start), the `channel`
    that is furthest off, and by how many `deviations`, without a sign; both None where no particle
    has an answer."""

    @property
    def doubtful(self) -> bool:
        """Whether the recording does not fit."""
        return _many(self.unexplained, self.rows) or (
            self.rows >= MANY and self.inside < FEW_INSIDE
        )


def fit_of(predicted: PredictedRows, episode: Episode) -> Fit:
    """Compare rows 1..n as measured with their one-step predictions, `predict_rows`."""
    rows = measured_rows(episode)[1:]
    off = (prediction_error(rows, predicted.mean) / predicted.std).abs()
    answered = torch.isfinite(off).all(-1)
    inside = (predicted.transform > 0.05) & (predicted.transform < 0.95) & answered[:, None]
    most, channel = off.nan_to_num(0.0).max(-1)
    return Fit(
        len(rows),
        float(inside.double().mean()),
        [
            {
                "row": k + 1,
                "channel": CHANNELS[int(channel[k])] if answered[k] else None,
                "deviations": float(most[k]) if answered[k] else None,
            }
            for k in torch.nonzero(~answered | (most > FAR)).flatten().tolist()
        ],
    )


@torch.no_grad()
def fit_to(belief: Belief, episode: Episode) -> Fit:
    """The fit of an episode to a belief."""
    return fit_of(predict_rows(ContactPredictor(belief), episode), episode)


def unexplained_rows(episode: Episode, belief: Belief) -> list[dict[str, Any]]:
    """`Fit.unexplained` of an episode."""
    return fit_to(belief, episode).unexplained


def other_scene_warning(fit: Fit) -> str | None:
    """One line where a predicted recording does not fit the belief; else None."""
    if not fit.doubtful:
        return None
    far = ""
    if fit.unexplained:
        far = (
            f" and {len(fit.unexplained)} of {fit.rows} rows lie more than {FAR:.0f} standard"
            f" deviations from their predictions{_worst(fit.unexplained)}"
        )
    return (
        f"what was measured does not fit the belief: {fit.inside:.0%} of the readings lie in their"
        f" 90 % intervals{far}; predict recordings of the scene, object and grasp that it was"
        " learnt from, or let scripts/diagnose.py find what the model lacks"
    )


def unexplained_warning(found: list[dict[str, Any]], total: int) -> str | None:
    """One line where at least `LARGE_SHARE` of a `total` of rows, and at least `MANY`, are not
    explained; else None."""
    if not _many(found, total):
        return None
    return (
        f"{len(found)} of {total} rows lie more than {FAR:.0f} standard deviations from what was"
        f" learnt{_worst(found)}: the estimate is not to be trusted; check the recording, its"
        " stiffness and sensor_std, or let scripts/diagnose.py find what the model lacks"
    )


def unknown_object_warning(belief: Belief, pose_std: Float[Tensor, " 3"]) -> str | None:
    """One line where what was touched is of no outline that the prior knows: its misfit is, but for
    5 %, more than `BEYOND_NOISE` times the position's noise; else None."""
    low, mean = misfit_sizes(belief)[:2]
    noise = float(pose_std[:2].mean())
    if low <= BEYOND_NOISE * noise or not belief.misfit.bumps:
        return None
    return (
        "the prior does not know this object: what was touched differs by about"
        f" {1e3 * mean:.2g} mm"
        f" (at least {1e3 * low:.2g}) from every outline of the prior, and the sensors by"
        f" {1e3 * noise:.2g} mm; sides that nothing touched are not to be trusted: touch them, or"
        " train a prior on such objects"
    )


def fit_sentence(fit: Fit, belief: Belief) -> str:
    """What a run says of its fit, whether good or bad."""
    low, mean, high = misfit_sizes(belief)
    outline = ""
    if belief.misfit.bumps:
        outline = (
            f"; where it was touched, the outline differs from those of the prior by"
            f" {1e3 * mean:.2g} mm ({1e3 * low:.2g} to {1e3 * high:.2g}), and sides that nothing"
            " touched are the prior's guess"
        )
    return f"{fit.inside:.0%} of the readings lie in their 90 % intervals{outline}"


def misfit_sizes(belief: Belief) -> tuple[float, float, float]:
    """The standard deviation of the outline's misfit [m]: 5 %, mean and 95 %."""
    low, high = (float(belief.quantile_of(belief.misfit_sd, level)) for level in (0.05, 0.95))
    return low, float(belief.weights @ belief.misfit_sd), high


def _many(found: list[dict[str, Any]], total: int) -> bool:
    return len(found) >= max(MANY, LARGE_SHARE * total)


def _worst(found: list[dict[str, Any]]) -> str:
    worst = max(found, key=lambda row: row["deviations"] or 0.0)
    if worst["deviations"] is None:
        return ""
    return f" (row {worst['row']}: {worst['channel']} by {worst['deviations']:.0f})"
