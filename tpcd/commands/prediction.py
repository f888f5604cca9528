"""One-step and rollout predictions of an episode, as rows and as scores.

Row k predicts row k of the episode from the measured pose of row k - 1 and command k. The
command of row k - 1 tells what the arm was pressed against. Intervals are of what sensors
read (the episode's noise included) or of what is true, as asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.data.files import write_together
from tpcd.data.table import encode_table
from tpcd.planar import wrap_angle
from tpcd.predict import LEAST_STD, ContactPredictor
from tpcd.prediction import CHANNELS, Prediction

CHANNEL_UNITS = ("m", "m", "rad", "N", "N", "N·m")
ROLLOUT_SAMPLES = 400
LEAST_LOAD = 1e-3
"""Noise-free wrench from which a row counts as contact [N, N·m]."""


@dataclass(frozen=True)
class PredictedRows:
    """Predictions of rows 1..n of an episode; channels as in `CHANNELS`, SI units."""

    mean: Float[Tensor, "n 6"]
    std: Float[Tensor, "n 6"]
    low: Float[Tensor, "n 6"]
    high: Float[Tensor, "n 6"]
    transform: Float[Tensor, "n 6"]
    """The predicted distribution function at the episode's own rows."""


def predict_rows(
    predictor: ContactPredictor,
    episode: Episode,
    of: Literal["measured", "true"] = "measured",
    reference: Episode | None = None,
) -> PredictedRows:
    """One-step predictions of every row but the first.

    `reference` holds the rows to evaluate the distribution function at (default: the
    episode's own); with `of='true'` it should be noise-free.
    """
    prediction = one_step(predictor, episode, of)
    rows = measured_rows(reference or episode)[1:]
    return PredictedRows(
        mean=prediction.mean,
        std=prediction.std,
        low=prediction.quantile(0.05),
        high=prediction.quantile(0.95),
        transform=prediction.probability_below(rows),
    )


def one_step(
    predictor: ContactPredictor, episode: Episode, of: Literal["measured", "true"]
) -> Prediction:
    """The distribution of every row but the first, given the row before and the command."""
    return predictor.predict(
        episode.poses[:-1],
        episode.commands[1:],
        previous=episode.commands[:-1],
        pose_std=episode.sensor_std[:3],
        sensor_std=episode.sensor_std if of == "measured" else None,
    )


def rollout_rows(
    predictor: ContactPredictor,
    episode: Episode,
    generator: torch.Generator,
    of: Literal["measured", "true"] = "measured",
    reference: Episode | None = None,
) -> PredictedRows:
    """Predictions that start at row 0 and feed on themselves, by sampling trajectories."""
    draws = predictor.rollout(
        episode.poses[0], episode.commands[1:], generator, samples=ROLLOUT_SAMPLES
    )
    # What the numerics leave is part of every prediction, so that free rows have a width.
    least = LEAST_STD * torch.cat((torch.ones_like(episode.stiffness), episode.stiffness))
    added = torch.hypot(least, episode.sensor_std) if of == "measured" else least
    draws = draws + torch.randn(draws.shape, generator=generator, dtype=draws.dtype) * added
    # Angles about their circular mean, or those around pi would be averaged to 0.
    centre = torch.atan2(draws[..., 2].sin().mean(0), draws[..., 2].cos().mean(0))
    draws[..., 2] = centre + wrap_angle(draws[..., 2] - centre)
    rows = measured_rows(reference or episode)[1:]
    levels = torch.tensor([0.05, 0.95], dtype=draws.dtype)
    low, high = torch.quantile(draws, levels, dim=0)
    return PredictedRows(
        mean=draws.mean(0),
        std=draws.std(0),
        low=low,
        high=high,
        transform=(prediction_error(rows, draws) < 0).double().mean(0),
    )


def joined(predicted: list[PredictedRows]) -> PredictedRows:
    """The rows of several episodes as those of one."""
    names = vars(predicted[0])
    return PredictedRows(*(torch.cat([getattr(p, name) for p in predicted]) for name in names))


def measured_rows(episode: Episode) -> Float[Tensor, "n 6"]:
    """Pose and wrench of every row side by side."""
    return torch.cat((episode.poses, episode.wrenches), dim=-1)


def in_contact(true: Episode) -> Bool[Tensor, " n"]:
    """Which of rows 1..n of a noise-free episode touch. In free motion the arm reaches its command:
    such rows are certain, and say nothing of how good an interval is."""
    return true.wrenches[1:].abs().amax(-1) > LEAST_LOAD


def prediction_error(
    rows: Float[Tensor, "n 6"], mean: Float[Tensor, "*batch n 6"]
) -> Float[Tensor, "*batch n 6"]:
    """Predicted minus actual for each row and channel, angles wrapped."""
    error = mean - rows
    return torch.cat((error[..., :2], wrap_angle(error[..., 2:3]), error[..., 3:]), dim=-1)


def score_rows(predicted: PredictedRows, rows: Float[Tensor, "n 6"]) -> list[dict[str, Any]]:
    """For each channel: mean absolute error, its standard deviation, 90 % coverage."""
    error = prediction_error(rows, predicted.mean).abs()
    inside = (predicted.transform > 0.05) & (predicted.transform < 0.95)
    return [
        {
            "channel": name,
            "unit": unit,
            "mae": float(error[:, i].mean()),
            "sd": float(error[:, i].std(correction=0)),
            "coverage_90": float(inside[:, i].double().mean()),
            "rows": len(error),
        }
        for i, (name, unit) in enumerate(zip(CHANNELS, CHANNEL_UNITS, strict=True))
    ]


def write_prediction(predicted: list[PredictedRows], path: Path) -> None:
    """Write predictions of one or several episodes in one move, as CSV or, where the path ends
    so, Parquet.

    Columns `step`, then mean, sd, q05 and q95 of each channel; with several episodes a first
    column `episode` counts them from 0.
    """
    counts = [len(rows.mean) for rows in predicted]
    table: dict[str, np.ndarray] = {}
    if len(predicted) > 1:
        table["episode"] = np.repeat(np.arange(len(counts)), counts)
    table["step"] = np.concatenate([np.arange(1, count + 1) for count in counts])
    parts = [(rows.mean, rows.std, rows.low, rows.high) for rows in predicted]
    values = torch.cat([torch.stack(part, dim=-1) for part in parts]).numpy()
    for channel, name in enumerate(CHANNELS):
        for i, what in enumerate(("mean", "sd", "q05", "q95")):
            table[f"{name}_{what}"] = values[:, channel, i]
    write_together({path: encode_table(table, path)})
