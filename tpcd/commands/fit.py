"""Whether what was measured fits a belief: how often its intervals hold, how large errors are
beside what was predicted and the noise, and whether the shape prior knows the object.

`fit_of` compares predictions with readings. `learnt_fit` does so for the rows that a belief was
learnt from, and looks at the error of the outline that it had to believe in to explain them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from scipy.stats import binom
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.commands.prediction import (
    PredictedRows,
    measured_rows,
    predict_rows,
    prediction_error,
)
from tpcd.commands.unexplained import FAR, LARGE_SHARE, MANY
from tpcd.data.episode import Episode
from tpcd.predict import ContactPredictor

SURE = 1e-3
"""Chance of fewer readings within their intervals than the bound, were all predictions right."""
LEAST_SHARE = 0.7
"""Share of readings in 90 % intervals that is never told: rows share the error of one theta."""
LARGE_ERROR = 2.0
"""Errors of less than so many predicted standard deviations (root mean square) are never told."""
LARGE_MISFIT = 2e-3
"""Error of the outline [m] from which an object is none of the prior's, even where a prior expects
more: a tenth of what is held is no error of a shape but another shape."""
UNLIKELY = 0.95
"""And so is one whose error exceeds this quantile of what the prior expects."""


def fit_of(
    predicted: PredictedRows, rows: Float[Tensor, "n 6"], sensor_std: Float[Tensor, "*#n 6"]
) -> dict[str, Any]:
    """How readings fit the predictions of them, in plain numbers.

    `in_90` is the share of readings in their 90 % intervals, `in_90_least` the least that chance
    leaves where the predictions are right: of so many rows, since the channels of a row err
    together. `error_mm`, `predicted_sd_mm` and `noise_mm` are of x and z, `error_over_sd` is the
    root mean square of errors by predicted standard deviations over all channels, and `beyond` how
    many rows are further off than `FAR` of them. Many such rows do not fit, and neither do readings
    that are too seldom within their intervals and too far off on the whole.
    """
    told = torch.isfinite(predicted.std).all(-1)
    count = int(told.sum())
    if count == 0:
        return {"rows": len(rows), "answered": 0, "fits": False}
    error = prediction_error(rows, predicted.mean)[told]
    std, transform = predicted.std[told], predicted.transform[told]
    inside = float(((transform > 0.05) & (transform < 0.95)).double().mean())
    least = min(float(binom.ppf(SURE, count, 0.9)) / count, LEAST_SHARE)
    ratio = float((error / std).square().mean().sqrt())
    beyond = int(((error / std).abs().amax(-1) > FAR).sum())
    common = inside >= least or ratio < LARGE_ERROR
    return {
        "rows": len(rows),
        "answered": count,
        "in_90": inside,
        "in_90_least": least,
        "error_mm": 1e3 * float(error[:, :2].abs().mean()),
        "predicted_sd_mm": 1e3 * float(std[:, :2].mean()),
        "noise_mm": 1e3 * float(sensor_std[..., :2].mean()),
        "error_over_sd": ratio,
        "beyond": beyond,
        "fits": common and beyond < max(MANY, LARGE_SHARE * count),
    }


def fit_line(found: Mapping[str, Any]) -> str:
    """The figures of `fit_of` in one line."""
    if not found["answered"]:
        return f"no particle of the belief has an answer for any of {found['rows']} rows"
    return (
        f"{found['in_90']:.0%} of the readings lie in their 90 % intervals (at least"
        f" {found['in_90_least']:.0%} expected of {found['answered']} rows); x and z are off by"
        f" {found['error_mm']:.2g} mm, where {found['predicted_sd_mm']:.2g} mm are predicted and"
        f" the noise is {found['noise_mm']:.2g} mm; {found['beyond']} rows lie further than"
        f" {FAR:.0f} standard deviations off"
    )


def foreign_warning(found: Mapping[str, Any]) -> str | None:
    """One line where a recording does not fit the belief it is predicted with; else None."""
    if found["fits"]:
        return None
    return (
        f"the recording does not fit this belief: {fit_line(found)}; is it of the same object,"
        " grasp, scene and frame?"
    )


@torch.no_grad()
def learnt_fit(episode: Episode, belief: Belief) -> dict[str, Any]:
    """How the rows that a belief was learnt from fit it, and how wrong it takes its outlines."""
    predicted = predict_rows(ContactPredictor(belief), episode)
    found = fit_of(predicted, measured_rows(episode)[1:], episode.sensor_std)
    field = belief.misfit
    usual = math.nan
    if field.sd > 0:
        score = math.sqrt(2) * torch.erfinv(torch.tensor(2 * UNLIKELY - 1)).item()
        usual = min(field.sd * math.exp(field.spread * score), LARGE_MISFIT)
    misfit = float(belief.quantile_of(belief.misfit_sd, 0.5))
    found["misfit_mm"], found["misfit_usual_mm"] = 1e3 * misfit, 1e3 * usual
    found["known"] = not misfit > usual
    return found


def unknown_warning(found: Mapping[str, Any]) -> str | None:
    """One line where the shape prior does not know the object of an estimate; else None."""
    if found.get("known", True):
        return None
    return (
        f"the prior does not know this object: its outline differs from every shape of the prior by"
        f" {found['misfit_mm']:.2g} mm, where up to {found['misfit_usual_mm']:.2g} mm are usual;"
        f" {fit_line(found)}. Outline and intervals are not to be trusted: check that frame, signs"
        " and priors are right, then train a prior with such objects"
    )
