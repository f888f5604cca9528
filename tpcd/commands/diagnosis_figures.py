"""The figures of a diagnosis with their captions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from matplotlib.figure import Figure

from tpcd.data.episode import Episode
from tpcd.discrepancy.diagnosis import Candidate, Cell, Diagnosis
from tpcd.figures.diagnosis import evidence_bars, gap_bars, residual_map, theta_shift, worst_stretch
from tpcd.predict import ContactPredictor

STRETCH = 20
"""Rows of the worst stretch."""


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
            " largest score of residuals' mean, size, or slope with load, place, angle or time.",
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
        drawn["theta"] = (
            theta_shift(
                [e.name for e in diagnosis.theta_after],
                [(e.value, e.sd) for e in diagnosis.theta_before],
                [(e.value, e.sd) for e in diagnosis.theta_after],
            ),
            "What the base model held for true, against the model found.",
        )
    if diagnosis.belief is not None and diagnosis.belief_before is not None and diagnosis.effects:
        drawn["stretch"] = (
            _stretch(diagnosis, episodes[0]),
            f"The {STRETCH} rows in a row that the base model predicts worst.",
        )
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


def _stretch(diagnosis: Diagnosis, episode: Episode) -> Figure:
    predicted = []
    for belief in (diagnosis.belief_before, diagnosis.belief):
        assert belief is not None
        found = ContactPredictor(belief, particles=100).predict(
            episode.poses[:-1], episode.commands[1:], episode.commands[:-1]
        )
        predicted.append(found.mean)
    measured = torch.cat((episode.poses, episode.wrenches), dim=-1)[1:]
    square = ((predicted[0] - measured) / episode.sensor_std).square().nan_to_num(0.0).sum(-1)
    length = min(STRETCH, len(square))
    first = int(square.unfold(0, length, 1).sum(-1).argmax())
    part, channels = slice(first, first + length), [1, 3, 4]
    return worst_stretch(
        (torch.arange(len(measured)) + 1)[part].numpy(),
        *(value[part][:, channels].numpy() for value in (measured, *predicted)),
        episode.sensor_std[channels].numpy(),
    )
