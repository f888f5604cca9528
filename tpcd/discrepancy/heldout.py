"""Scores on data that a model was not fitted to: blocks held out, and fresh episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.target import ContactTarget
from tpcd.data.episode import Episode
from tpcd.discrepancy.diagnosis import CHANNELS, Gap
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question, posterior
from tpcd.planar import wrap_angle
from tpcd.predict import ContactPredictor

FOLDS = 4
BLOCK = 5
"""Transitions that the bootstrap keeps together."""
RESAMPLES = 2000
LEAST_EXCESS = 0.1
"""Share of the noise's variance that counts as a gap."""
TYPICAL = 0.95
"""Share of the rows whose largest square before bounds what a number counts in what is typical."""
FOLD_SAMPLER = SamplerSettings(
    particles=200,
    places=80,
    draws_per_place=9,
    rounds=2,
    draws=1000,
    flat_rounds=0,
    rough=False,
    prior_draws=100,
    modes=12,
    fresh_modes=24,
)
"""Budget of a fit that starts where the fit of all data arrived."""
UNITS = ("m", "m", "rad", "N", "N", "N·m")


@dataclass(frozen=True)
class Errors:
    """Errors of one-step predictions in the mean, and what noise alone would leave."""

    error: Float[Tensor, "n 6"]
    noise: Float[Tensor, "n 6"]
    """Standard deviation of the error of a perfect model."""


def folds(history: History, count: int = FOLDS) -> list[Bool[Tensor, " n"]]:
    """Transitions held out in each fold: blocks one after the other."""
    place = torch.nonzero(history.used).flatten()
    parts = []
    for block in place.tensor_split(min(count, len(place))):
        mask = torch.zeros_like(history.used)
        mask[block] = True
        parts.append(mask)
    return parts


def held_out_scores(question: Question, fit: Fit) -> Float[Tensor, " n"]:
    """Log predictive density of every transition that counts, fitted without its block."""
    scores = torch.zeros(len(question.history), dtype=torch.float64)
    for mask, _, trained in _fold_fits(question, fit):
        scores[mask] = _predictive(question, trained)[mask]
    return scores[question.history.used]


def _fold_fits(question: Question, fit: Fit) -> Iterator[tuple[Tensor, Question, Fit]]:
    """The transitions held out in each fold, what is asked of the others, and the fit to them.

    The search starts from the fit of all data; the weights of its draws see the others alone.
    """
    for k, mask in enumerate(folds(question.history)):
        part = replace(question, history=question.history.using(~mask), sampler=FOLD_SAMPLER)
        yield mask, part, fit_model(part, fit.effects, (100 + k,), start=(fit,), step=fit.step)


def lower_bound(
    gain: Float[Tensor, " n"], generator: torch.Generator, level: float = 0.05
) -> float:
    """Lower bound of the mean gain by a block bootstrap."""
    blocks = torch.stack([part.sum() for part in gain.split(BLOCK)])
    draws = torch.randint(len(blocks), (RESAMPLES, len(blocks)), generator=generator)
    return float(torch.quantile(blocks[draws].sum(1) / len(gain), level))


def prediction_errors(question: Question, fit: Fit, episodes: Sequence[Episode]) -> Errors:
    """One-step predictions of whole episodes of the same set-up."""
    belief = posterior(question, fit)
    predictor = ContactPredictor(belief, particles=100)
    best = belief.weights.argmax()[None]
    alone = replace(
        belief,
        vectors=belief.vectors[best],
        weights=torch.ones(1, dtype=torch.float64),
        misfit=MisfitField(0.0),
        misfit_sd=torch.zeros(1, dtype=torch.float64),
        misfit_mean=torch.zeros(1, 0, dtype=torch.float64),
        misfit_covariance=torch.zeros(1, 0, 0, dtype=torch.float64),
    )
    errors, noises = [], []
    for episode in episodes:
        arguments = (episode.poses[:-1], episode.commands[1:], episode.commands[:-1])
        stds = (episode.sensor_std[:3], episode.sensor_std)
        read = torch.cat((episode.poses, episode.wrenches), dim=-1)[1:]
        error = read - predictor.predict(*arguments, *stds).mean
        errors.append(torch.cat((error[:, :2], wrap_angle(error[:, 2:3]), error[:, 3:]), dim=-1))
        noises.append(ContactPredictor(alone).predict(*arguments, *stds).std)
    return Errors(torch.cat(errors), torch.cat(noises))


def held_out_errors(question: Question, fit: Fit, episodes: Sequence[Episode]) -> Errors:
    """Prediction errors of every transition, by a model fitted without its block."""
    errors, noises = [], []
    for mask, part, trained in _fold_fits(question, fit):
        found = prediction_errors(part, trained, episodes)
        rows = mask[~question.history.seams]
        errors.append(found.error[rows])
        noises.append(found.noise[rows])
    return Errors(*(torch.cat(part) for part in (errors, noises)))


def gaps(before: Errors, after: Errors, generator: torch.Generator) -> tuple[list[Gap], float]:
    """The gap of each channel before and after, and the share closed of all of it."""
    *squares, floor = _squares(before, after)
    n = len(floor)
    draws = _block_draws(n, generator)

    def closed(rows: Tensor) -> Tensor:
        was, now, least = (part[rows].mean(-2) for part in (*squares, floor))
        excess = was - least
        share = (was - torch.maximum(now, least)) / excess
        # Below this, chance alone makes an excess.
        chance = max(LEAST_EXCESS, 2.0 * math.sqrt(2.0 / n))
        return torch.where(excess > chance * least, share, torch.nan)

    whole, resampled = closed(torch.arange(n)), closed(draws)
    found = []
    for c, channel in enumerate(CHANNELS):
        known = resampled[:, c][~resampled[:, c].isnan()]
        ends = torch.quantile(known, torch.tensor([0.05, 0.95]).double()) if len(known) else None
        found.append(
            Gap(
                channel,
                UNITS[c],
                *(float(part[:, c].mean().sqrt()) for part in (*squares, floor)),
                float(whole[c]),
                *((math.nan, math.nan) if ends is None else ends.tolist()),
            )
        )
    return found, _together(*(part / floor for part in squares))


def typical_share(before: Errors, after: Errors) -> float:
    """Share closed of all of the gap (nan where there is none), where no number counts for more
    than in nearly all rows before: a few rows that land in another contact decide nothing."""
    *squares, floor = _squares(before, after)
    was, now = (part / floor for part in squares)
    most = torch.quantile(was.amax(-1), TYPICAL)
    return _together(was.clamp_max(most), now.clamp_max(most))


def _squares(before: Errors, after: Errors) -> list[Float[Tensor, "n 6"]]:
    """Squared errors before and after, and noise, of the rows in which all of them are known."""
    parts = (before.error, after.error, after.noise)
    known = torch.stack([torch.isfinite(part).all(-1) for part in parts]).all(0)
    return [torch.square(part[known]) for part in parts]


def _together(before: Float[Tensor, "n 6"], after: Float[Tensor, "n 6"]) -> float:
    """Share closed of the gap of all channels, from squares in units of the noise."""
    was, now = before.mean() - 1, after.mean() - 1
    chance = max(LEAST_EXCESS, 2.0 * math.sqrt(2.0 / before.numel()))
    return float((was - now.clamp_min(0.0)) / was) if was > chance else math.nan


def _block_draws(n: int, generator: torch.Generator) -> Tensor:
    """Rows (RESAMPLES, about n) of blocks drawn with replacement."""
    starts = torch.arange(0, n, BLOCK)
    chosen = starts[torch.randint(len(starts), (RESAMPLES, len(starts)), generator=generator)]
    rows = chosen[..., None] + torch.arange(min(BLOCK, n))
    return rows.flatten(1).clamp_max(n - 1)


def _predictive(question: Question, fit: Fit) -> Float[Tensor, " n"]:
    """Log predictive density of every transition under the particles of a fit."""
    target = ContactTarget(fit.prior, question.misfit, fit.step, question.history)
    order = fit.cloud.weights.argsort(descending=True)[:100]
    positions = fit.cloud.positions[order]
    weights = fit.cloud.weights[order]
    found = target.evaluate(positions, innovations=True)
    assert found.whitened is not None and found.log_scale is not None
    each = -(0.5 * found.whitened**2 + found.log_scale + 0.5 * math.log(2 * math.pi)).sum(-1)
    if fit.effects:
        # What pose and wrench say about each other is relative to the model without effects.
        whitened, scale = target.parity(positions)
        base, base_scale = question.history.merged.standard_parity(question.history.read)
        own = -(0.5 * whitened**2 + scale).sum(-1) + (0.5 * base**2 + base_scale).sum(-1)
        each = each + own[:, 1:]
    each = torch.where(torch.isfinite(each), each, -100.0)
    return torch.logsumexp(each + (weights / weights.sum()).log()[:, None], 0)
