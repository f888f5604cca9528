"""Modes of a posterior: found by climbing, and kept from one datum to the next.

A mode that has no particle near it is hard to find by weighting draws. Many points from all
over the prior therefore climb at every datum, most of which give up on the way, besides the
modes remembered from the datum before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.belief.cloud import Target
from tpcd.belief.settings import SamplerSettings

_SAME_MODE = 4.0
"""Squared distance, in the metric of the information, within which two modes are one."""


@dataclass(frozen=True)
class Climbers:
    """k points on their way up a log target, with its values there; gradient and information
    where they are known."""

    points: Float[Tensor, "k d"]
    height: Float[Tensor, " k"]
    gradient: Float[Tensor, "k d"]
    information: Float[Tensor, "k d d"]
    known: Bool[Tensor, " k"]

    def __getitem__(self, index: Tensor | slice) -> Climbers:
        return Climbers(**{name: value[index] for name, value in vars(self).items()})

    def beside(self, others: Climbers) -> Climbers:
        """These and then the others."""
        pairs = {name: (value, getattr(others, name)) for name, value in vars(self).items()}
        return Climbers(**{name: torch.cat(pair) for name, pair in pairs.items()})

    def surveyed(self, target: Target) -> Climbers:
        """The same with gradient and information everywhere."""
        index = torch.nonzero(~self.known).flatten()
        if len(index) == 0:
            return self
        gradient, information = target.curvature(self.points[index])
        return replace(
            self,
            gradient=self.gradient.index_copy(0, index, gradient),
            information=self.information.index_copy(0, index, information),
            known=torch.ones_like(self.known),
        )


def set_out(
    target: Target, points: Float[Tensor, "k d"], height: Float[Tensor, " k"] | None = None
) -> Climbers:
    """Points before they climb, whose log targets may be known."""
    k, d = points.shape
    return Climbers(
        points=points,
        height=log_target(target, points) if height is None else height,
        gradient=torch.zeros_like(points),
        information=points.new_zeros(k, d, d),
        known=torch.zeros(k, dtype=torch.bool),
    )


def find_modes(
    target: Target,
    remembered: Float[Tensor, "k d"],
    settings: SamplerSettings,
    generator: torch.Generator,
    fresh: Float[Tensor, "f d"] | None = None,
) -> Climbers:
    """The highest distinct modes, with gradient and information; `fresh` points climb besides
    those from all over the prior."""
    points = torch.cat((remembered, target.scatter(settings.fresh_modes, generator)))
    start = set_out(target, points if fresh is None else torch.cat((points, fresh)))
    kept_on, new = start[: len(remembered)], start[len(remembered) :]
    start = kept_on.beside(climb_with_the_best(target, new, settings))
    arrived = climb(target, start, settings.following_rounds).surveyed(target)
    points, information = arrived.points, arrived.information
    kept: list[int] = []
    for i in arrived.height.argsort(descending=True).tolist():
        offset = points[kept] - points[i]
        square = (offset * (information[kept] @ offset[..., None])[..., 0]).sum(-1)
        if len(kept) < settings.modes and not bool((square < _SAME_MODE).any()):
            kept.append(i)
    return arrived[torch.tensor(kept, dtype=torch.long)]


def climb_with_the_best(target: Target, climbers: Climbers, settings: SamplerSettings) -> Climbers:
    """Points that climb in stages, after each of which the lower half gives up (successive
    halving), until `modes` are left."""
    while len(climbers.points) > settings.modes:
        climbers = climb(target, climbers, settings.climbing_rounds)
        half = max(settings.modes, len(climbers.points) // 2)
        climbers = climbers[climbers.height.argsort(descending=True)[:half]]
    return climbers


def climb(target: Target, climbers: Climbers, rounds: int) -> Climbers:
    """Points after some damped Newton steps up the log target.

    A step is taken where it gains, and damped more where it does not (Levenberg 1944;
    Marquardt 1963).
    """
    damping = torch.ones_like(climbers.height)
    identity = torch.eye(climbers.points.shape[-1], dtype=climbers.points.dtype)
    for _ in range(rounds if len(damping) else 0):
        climbers = climbers.surveyed(target)
        damped = climbers.information + damping[:, None, None] * identity
        there = climbers.points + torch.linalg.solve(damped, climbers.gradient)
        found = log_target(target, there, climbers.height)
        better = found > climbers.height
        climbers = replace(
            climbers,
            points=torch.where(better[:, None], there, climbers.points),
            height=torch.where(better, found, climbers.height),
            known=~better,
        )
        damping = torch.where(better, 0.2 * damping, 5.0 * damping)
    return climbers


def log_target(
    target: Target, points: Float[Tensor, "k d"], least: Float[Tensor, " k"] | None = None
) -> Float[Tensor, " k"]:
    """Log density of prior and history together, -inf where it has none or may stay below
    `least`."""
    if len(points) == 0:
        return points.new_zeros(0)
    log_prior = target.log_prior(points)
    if least is not None:
        least = torch.where(torch.isfinite(log_prior), least - log_prior, torch.inf)
    value = log_prior + target.log_likelihood(points, least)
    return torch.where(torch.isfinite(value), value, -torch.inf)
