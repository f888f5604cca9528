"""Scores on data that a model was not fitted to: blocks held out, and fresh episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.target import ContactTarget
from tpcd.data.episode import Episode
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question, posterior
from tpcd.discrepancy.gaps import RESAMPLES, Errors, contact_of
from tpcd.planar import wrap_angle
from tpcd.predict import ContactPredictor

FOLDS = 4
BLOCK = 5
"""Transitions that the bootstrap of a gain keeps together."""
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
    errors, noises, contacts = [], [], []
    for episode in episodes:
        arguments = (episode.poses[:-1], episode.commands[1:], episode.commands[:-1])
        stds = (episode.sensor_std[:3], episode.sensor_std)
        read = torch.cat((episode.poses, episode.wrenches), dim=-1)[1:]
        error = read - predictor.predict(*arguments, *stds).mean
        errors.append(torch.cat((error[:, :2], wrap_angle(error[:, 2:3]), error[:, 3:]), dim=-1))
        noises.append(ContactPredictor(alone).predict(*arguments, *stds).std)
        contacts.append(contact_of(episode))
    return Errors(*(torch.cat(part) for part in (errors, noises, contacts)))


def held_out_errors(question: Question, fit: Fit, episodes: Sequence[Episode]) -> Errors:
    """Prediction errors of every transition, by a model fitted without its block."""
    found: list[tuple[Tensor, ...]] = []
    for mask, part, trained in _fold_fits(question, fit):
        errors = prediction_errors(part, trained, episodes)
        rows = mask[~question.history.seams]
        found.append(tuple(one[rows] for one in (errors.error, errors.noise, errors.contact)))
    return Errors(*map(torch.cat, zip(*found, strict=True)))


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
