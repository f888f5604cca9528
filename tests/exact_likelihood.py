"""The likelihood of an episode without any linearisation, by importance sampling.

What each reading's outline has besides the field (grain and roughness) is drawn anew in every
step of every draw; that it acts linearly on the lever is its definition (`eval/drawn.py`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField
from tpcd.contact import ContactScene, terrain_gaps
from tpcd.effects.conditions import angle_difference
from tpcd.simulator import StepSettings, simulate_step

INFLATIONS = ((0.6, 1.0), (0.3, 1.5))
"""Shares of the draws, and how much wider than fitted they are; the rest is of the prior."""


def exact_log_likelihood(
    scene: ContactScene,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
    mean: Tensor,
    covariance: Tensor,
    generator: torch.Generator,
    draws: int = 1500,
    rounds: int = 6,
) -> tuple[float, float]:
    """Log likelihood of one theta, and the effective number of the last round's draws.

    Misfit coefficients and the first pose's error are drawn about `mean` and `covariance` of the
    coefficients [m], and in later rounds about where the draws before had weight; each draw is
    stepped through the history with its own terrains.
    """
    count = len(mean)
    size = count + 3
    place = torch.cat((mean / misfit_sd, torch.zeros(3, dtype=torch.float64)))
    spread = torch.block_diag(covariance / misfit_sd**2, torch.eye(3, dtype=torch.float64))
    found = -math.inf, 0.0
    for _ in range(rounds):
        factor = torch.linalg.cholesky(spread + 1e-8 * torch.eye(size, dtype=torch.float64))
        drawn, log_density = _draw(place, factor, draws, generator)
        coefficients = misfit_sd * drawn[:, :count]
        start = history.poses[0] + history.variance[0].sqrt() * drawn[:, count:]
        log_weights = -0.5 * (drawn**2).sum(-1) - 0.5 * size * math.log(2 * math.pi) - log_density
        log_weights = log_weights + _log_likelihood(
            scene, start, coefficients, misfit_sd, history, field, settings, generator
        )
        weights = log_weights.softmax(0)
        effective = float(1 / (weights**2).sum())
        found = float(torch.logsumexp(log_weights, 0)) - math.log(draws), effective
        power = 1.0
        while float(1 / (weights**2).sum()) < 60:
            power *= 0.7
            weights = (power * log_weights).softmax(0)
        place = weights @ drawn
        spread = (weights[:, None] * (drawn - place)).T @ (drawn - place)
        spread = spread + 1e-4 * torch.eye(size, dtype=torch.float64)
    return found


def _draw(
    place: Tensor, factor: Tensor, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draws from normal densities about a place and from the prior, and their log density."""
    size = len(place)
    which = torch.rand(count, generator=generator, dtype=torch.float64)
    normal = torch.randn(count, size, generator=generator, dtype=torch.float64)
    drawn, below, terms = normal.clone(), 0.0, []
    for share, wider in INFLATIONS:
        here = (which >= below) & (which < below + share)
        drawn[here] = place + wider * normal[here] @ factor.T
        below += share
    away = torch.linalg.solve_triangular(factor, (drawn - place).T, upper=False).T
    for share, wider in INFLATIONS:
        scale = factor.diagonal().log().sum() + size * math.log(wider)
        terms.append(math.log(share) - 0.5 * (away**2).sum(-1) / wider**2 - scale)
    terms.append(math.log(1 - below) - 0.5 * (drawn**2).sum(-1))
    return drawn, torch.logsumexp(torch.stack(terms), 0) - 0.5 * size * math.log(2 * math.pi)


def _log_likelihood(
    scene: ContactScene,
    pose: Tensor,
    coefficients: Tensor,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
    generator: torch.Generator,
) -> Tensor:
    """Of the history given each draw; -inf where it does not begin in free space."""
    terrains, count = len(scene.terrains), len(pose)
    friction = scene.friction.expand(count, -1)
    many = ContactScene(scene.points_ee[None], scene.terrains, friction)
    gaps = terrain_gaps(many, pose)
    free = gaps.amin(-1) + field.gap(coefficients, history.poses[0, 2].expand(count)) > 0
    total = torch.where(free.all(-1), 0.0, -math.inf).double()
    for k in range(len(history)):
        angle = history.settled[k, 2]
        value, slope = field.basis(angle)
        noise = torch.randn(2, count, terrains, generator=generator, dtype=torch.float64)
        gap = field.gap(coefficients, angle.expand(count))
        gap = gap + field.uncovered(value).sqrt() * misfit_sd * noise[0]
        settled = simulate_step(
            many.further(gap),
            pose,
            history.command[k],
            history.stiffness,
            settings,
            previous=history.previous[k],
        )
        lever = coefficients.reshape(count, terrains, -1) @ slope
        lever = lever + field.roughness * misfit_sd * noise[1]
        pose = settled.pose + (settled.pose_from_lever * lever[..., None]).sum(-2)
        error, variance = angle_difference(history.settled[k], pose), history.variance[k + 1]
        each = -0.5 * error**2 / variance - 0.5 * (2 * math.pi * variance).log()
        total = total + each.sum(-1).nan_to_num(-math.inf)
    return total
