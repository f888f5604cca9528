"""The figures of a diagnosis with their captions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.commands.prediction import measured_rows, prediction_error
from tpcd.data.episode import Episode
from tpcd.discrepancy.diagnosis import Candidate, Cell, Diagnosis
from tpcd.figures.diagnosis import evidence_bars, gap_bars, residual_map, theta_shift, worst_stretch
from tpcd.predict import ContactPredictor
from tpcd.prediction import CHANNELS

STRETCH = 20
"""Rows of the worst stretch."""
STRETCH_CHANNELS = ("z", "F_x", "F_z", "tau")
PARTICLES = 100
"""Particles that predict it."""


def draw_diagnosis(
    diagnosis: Diagnosis, episodes: Sequence[Episode], least_gain: float
) -> dict[str, tuple[Figure, str]]:
    """The figures that the diagnosis has data for, each with its caption."""
    drawn: dict[str, tuple[Figure, str]] = {}
    rows: dict[str, int] = {}
    for cell in (*diagnosis.cells_before, *diagnosis.cells_after):
        if cell.covariate == "mean":
            rows[cell.mode] = max(rows.get(cell.mode, 0), cell.count)
    if rows:
        drawn["residuals"] = (
            residual_map(
                _largest_scores(diagnosis.cells_before),
                _largest_scores(diagnosis.cells_after),
                sorted(rows.items(), key=lambda row: (row[0] != "all", row[0])),
            ),
            "What the models leave, by contact mode (number of transitions) and channel: the"
            " largest score of residuals' mean, size, or slope with load, place, angle or time."
            " Forces and torque: what the wrench says beyond the pose.",
        )
    tried = shown_candidates(diagnosis)
    if tried:
        drawn["evidence"] = (
            evidence_bars(
                [f"{c.name}, round {c.round}" if c.round > 1 else c.name for c in tried],
                [c.gain for c in tried],
                [c.name in diagnosis.names for c in tried],
                least_gain,
            ),
            "Candidates of the first round, and what later rounds added.",
        )
    if diagnosis.gap:
        bars = [
            (
                *(g.channel, g.unit, (g.before, g.before_low, g.before_high)),
                *((g.after, g.after_low, g.after_high), g.noise_floor),
            )
            for g in diagnosis.gap
        ]
        drawn["gap"] = (
            gap_bars(bars),
            f"Errors of one-step predictions on {diagnosis.held_out}, with 90 % intervals.",
        )
    if diagnosis.theta_before and diagnosis.theta_after != diagnosis.theta_before:
        drawn["theta"] = (
            theta_shift(
                [e.name for e in diagnosis.theta_after],
                [(e.value, e.sd) for e in diagnosis.theta_before],
                [(e.value, e.sd) for e in diagnosis.theta_after],
            ),
            "What the base model held for true, against the model found.",
        )
    before, after = diagnosis.belief_before, diagnosis.belief
    if before is not None and after is not None and after is not before:
        drawn["stretch"] = _stretch(before, after, episodes)
    return drawn


def shown_candidates(diagnosis: Diagnosis) -> list[Candidate]:
    """Those of the first round; what a later round added as it was then, over the model before."""
    shown: dict[str, Candidate] = {}
    for candidate in sorted(diagnosis.candidates, key=lambda c: c.round):
        added = candidate.round > 1 and candidate.outcome.startswith("accepted")
        if math.isfinite(candidate.gain) and (candidate.round == 1 or added):
            shown[candidate.name] = candidate
    return list(shown.values())


def _largest_scores(cells: Sequence[Cell]) -> list[tuple[str, str, float]]:
    """The largest score of every mode and channel, whatever it goes with."""
    largest: dict[tuple[str, str], float] = {}
    for cell in cells:
        key = (cell.mode, cell.channel)
        if abs(cell.score) > abs(largest.get(key, 0.0)):
            largest[key] = cell.score
    return [(*key, score) for key, score in largest.items()]


def _stretch(before: Belief, after: Belief, episodes: Sequence[Episode]) -> tuple[Figure, str]:
    """The rows in a row of all episodes that the base model predicts worst, and the caption."""
    places = [(*_worst_rows(before, episode), k) for k, episode in enumerate(episodes)]
    _, part, k = max(places, key=lambda place: place[0])
    episode = episodes[k]
    channels = [CHANNELS.index(name) for name in STRETCH_CHANNELS]
    values = (measured_rows(episode)[1:], *(_predicted(b, episode) for b in (before, after)))
    figure = worst_stretch(
        torch.arange(1, len(episode))[part].numpy(),
        *(value[part][:, channels].numpy() for value in values),
        episode.sensor_std[channels].numpy(),
    )
    where = f" of {episode.path.name}" if episode.path else ""
    count = part.stop - part.start
    return figure, f"The {count} rows in a row{where} that the base model predicts worst."


def _worst_rows(belief: Belief, episode: Episode) -> tuple[float, slice]:
    """The rows in a row that a belief predicts worst, and how badly, in squares of the noise."""
    off = prediction_error(measured_rows(episode)[1:], _predicted(belief, episode))
    square = (off / episode.sensor_std).square().nan_to_num(0.0).sum(-1)
    length = min(STRETCH, len(square))
    sums = square.unfold(0, length, 1).sum(-1)
    first = int(sums.argmax())
    return float(sums[first]), slice(first, first + length)


def _predicted(belief: Belief, episode: Episode) -> Float[Tensor, "n 6"]:
    """Pose and wrench of every row but the first, each foreseen from the row before."""
    return (
        ContactPredictor(belief, PARTICLES)
        .predict(episode.poses[:-1], episode.commands[1:], episode.commands[:-1])
        .mean
    )
