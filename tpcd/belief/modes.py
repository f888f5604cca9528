"""Modes of a posterior: found by climbing, and kept from one datum to the next.

A mode that the particles lost early cannot be found again by moving them. Some draws from the
prior therefore climb at every datum, besides the modes remembered from the datum before.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import SamplerSettings, Target
from tpcd.belief.proposals import StudentMixture, newton_mixture

_SAME_MODE = 4.0
"""Squared distance, in the metric of the information, within which two modes are one."""


def find_modes(
    target: Target,
    remembered: Float[Tensor, "k d"],
    spread: Float[Tensor, " d"],
    settings: SamplerSettings,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "j d"], StudentMixture, int]:
    """The highest distinct modes, a component at each, and how many evaluations it took."""
    fresh = target.sample(settings.at_most(settings.fresh_modes), generator)
    climbs = (fresh, settings.climbing_rounds), (remembered, settings.following_rounds)
    found = [climb(target, points, rounds) for points, rounds in climbs]
    points, height = (torch.cat(values) for values in zip(*found, strict=True))
    gradient, information = target.curvature(points, spread, 1.0)
    kept: list[int] = []
    most = settings.at_most(settings.modes)
    for i in height.argsort(descending=True).tolist():
        offset = points[kept] - points[i]
        square = (offset * (information[kept] @ offset[..., None])[..., 0]).sum(-1)
        if len(kept) < most and not bool((square < _SAME_MODE).any()):
            kept.append(i)
    mixture = newton_mixture(points[kept], gradient[kept], information[kept], share=1.0)
    evaluations = sum(len(points) * (rounds + 1) for points, rounds in climbs)
    return points[kept], mixture, evaluations


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
    spread = torch.ones(points.shape[-1], dtype=points.dtype)
    for _ in range(rounds if len(points) else 0):
        gradient, information = target.curvature(points, spread, 1.0)
        damped = information + damping[:, None, None] * identity
        there = points + torch.linalg.solve(damped, gradient)
        found = log_target(target, there)
        better = found > height
        points = torch.where(better[:, None], there, points)
        height = torch.where(better, found, height)
        damping = torch.where(better, 0.2 * damping, 5.0 * damping)
    return points, height


def log_target(target: Target, points: Float[Tensor, "k d"]) -> Float[Tensor, " k"]:
    """Log density of prior and history together, -inf where it has none."""
    if len(points) == 0:
        return points.new_zeros(0)
    value = target.log_prior(points) + target.log_likelihood(points, None)[1]
    return torch.where(torch.isfinite(value), value, -torch.inf)
