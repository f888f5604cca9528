"""Modes of a posterior: found by climbing, and kept from one datum to the next.

A mode that has no particle near it is hard to find by weighting draws. Many points from all
over the prior therefore climb at every datum, most of which give up on the way, besides the
modes remembered from the datum before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import SamplerSettings, Target

CURVATURE_COST = 3
"""Evaluations that gradient and information cost together."""
_SAME_MODE = 4.0
"""Squared distance, in the metric of the information, within which two modes are one."""


@dataclass(frozen=True)
class Peaks:
    """k points that climbed, with gradient and information of the log target there."""

    points: Float[Tensor, "k d"]
    gradient: Float[Tensor, "k d"]
    information: Float[Tensor, "k d d"]
    evaluations: int


def find_modes(
    target: Target,
    remembered: Float[Tensor, "k d"],
    settings: SamplerSettings,
    generator: torch.Generator,
) -> Peaks:
    """The highest distinct modes."""
    start = target.scatter(settings.fresh_modes, generator)
    fresh, evaluations = climb_with_the_best(target, start, settings)
    start = torch.cat((remembered, fresh))
    points, height = climb(target, start, settings.following_rounds)
    evaluations += climbing_cost(len(start), settings.following_rounds)
    gradient, information = target.curvature(points)
    kept: list[int] = []
    for i in height.argsort(descending=True).tolist():
        offset = points[kept] - points[i]
        square = (offset * (information[kept] @ offset[..., None])[..., 0]).sum(-1)
        if len(kept) < settings.modes and not bool((square < _SAME_MODE).any()):
            kept.append(i)
    evaluations += CURVATURE_COST * len(points)
    return Peaks(points[kept], gradient[kept], information[kept], evaluations)


def climb_with_the_best(
    target: Target, points: Float[Tensor, "k d"], settings: SamplerSettings
) -> tuple[Float[Tensor, "j d"], int]:
    """Points that climb in stages, after each of which the lower half gives up (successive
    halving), until `modes` are left; and what it cost."""
    evaluations = 0
    while len(points) > settings.modes:
        evaluations += climbing_cost(len(points), settings.climbing_rounds)
        points, height = climb(target, points, settings.climbing_rounds)
        half = max(settings.modes, len(points) // 2)
        points = points[height.argsort(descending=True)[:half]]
    return points, evaluations


def climb(
    target: Target, points: Float[Tensor, "k d"], rounds: int
) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]:
    """Points after some damped Newton steps up the log target, and its values there.

    A step is taken where it gains, and damped more where it does not (Levenberg 1944;
    Marquardt 1963).
    """
    height = log_target(target, points)
    damping = torch.ones_like(height)
    identity = torch.eye(points.shape[-1], dtype=points.dtype)
    for _ in range(rounds if len(points) else 0):
        gradient, information = target.curvature(points)
        damped = information + damping[:, None, None] * identity
        there = points + torch.linalg.solve(damped, gradient)
        found = log_target(target, there)
        better = found > height
        points = torch.where(better[:, None], there, points)
        height = torch.where(better, found, height)
        damping = torch.where(better, 0.2 * damping, 5.0 * damping)
    return points, height


def climbing_cost(points: int, rounds: int) -> int:
    """Evaluations that `climb` takes."""
    return points * (1 + rounds * (CURVATURE_COST + 1))


def log_target(target: Target, points: Float[Tensor, "k d"]) -> Float[Tensor, " k"]:
    """Log density of prior and history together, -inf where it has none."""
    if len(points) == 0:
        return points.new_zeros(0)
    value = target.log_prior(points) + target.log_likelihood(points, None)
    return torch.where(torch.isfinite(value), value, -torch.inf)
