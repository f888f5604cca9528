"""Last stage: the outline head is taught the level set that the finished f really has.

The head's points are brought onto f = 0 by Newton steps at many latents, and the head learns
these positions by least squares. That costs far less than evaluating f in every step, and
what is left is the head's own resolution. It is spent on the distance from the level set:
deviations along the outline change neither outline nor support and count little.

What a head can learn is bounded by how fast outlines change with the latent: with six latents the
distance of head and level set is another one after 0.05. So it takes many latents and steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.shape.deepsdf import DeepSDFNetwork
from training.config import OptimConfig
from training.rates import cosine_rate, split_optimizers

PROJECTIONS = 2
"""Newton steps; points at which the last one is longer than `ACCURACY` teach nothing."""
ACCURACY = 0.01
"""Longest last step, in the networks' unit (1 mm); what is left then is of second order."""
LEAST_SLOPE = 0.2
"""Where |grad f| is less, a step is as long as if it were this."""
ALONG = 0.05
"""Weight of a squared deviation along the outline, against 1 across it."""
LATENTS_AT_ONCE = 250
REACH = 0.04
"""Longest way from head point to target, in the networks' unit (4 mm)."""


def refine_head(
    network: DeepSDFNetwork, latents: Float[Tensor, "m z"], config: OptimConfig
) -> None:
    """Train the head in place on projected points at `latents`; f and codes stay.

    The latents should be as the prior will draw them: between the latents of training the
    head strays further from the level set than at them.
    """
    latents = with_codes(latents, network, config)
    for stage in range(config.refine_rounds):
        targets = projected_outlines(network, latents)
        fit_head(network, latents, targets, config, stage)


def with_codes(
    latents: Float[Tensor, "m z"], network: DeepSDFNetwork, config: OptimConfig
) -> Float[Tensor, "n z"]:
    """The latents, and some copies of each code."""
    codes = network.codes.detach()
    return torch.cat((latents, codes.repeat(config.refine_copies, 1)))


@dataclass(frozen=True, eq=False)
class HeadTargets:
    """Where the head's points should lie, for m latents; lengths in `UNIT`."""

    points: Float[Tensor, "m p 2"]
    """Head points moved onto the zero level set."""
    normals: Float[Tensor, "m p 2"]
    """Unit normals of the level set there."""
    counts: Float[Tensor, "m p"]
    """1 where a point got onto the level set, else 0."""


def projected_outlines(network: DeepSDFNetwork, latents: Float[Tensor, "m z"]) -> HeadTargets:
    """Bring the head's points onto the zero level set."""
    m, p = len(latents), network.architecture.points
    # Made before anything else, so that what is kept does not lie between what is given back.
    found = HeadTargets(torch.empty(m, p, 2), torch.empty(m, p, 2), torch.empty(m, p))
    for first in range(0, m, LATENTS_AT_ONCE):
        part = slice(first, first + LATENTS_AT_ONCE)
        z = latents[part]
        start = points = network.outline(z).detach()
        for _ in range(PROJECTIONS):
            at = points.requires_grad_()
            value = network.distance(at, z)
            gradient = torch.autograd.grad(value.sum(), at)[0]
            slope = gradient.norm(dim=-1, keepdim=True)
            normal = gradient / slope.clamp_min(1e-9)
            step = value.detach()[..., None] / slope.clamp_min(LEAST_SLOPE)
            points = at.detach() - step * normal
        near = (points - start).norm(dim=-1) < REACH
        found.points[part], found.normals[part] = points, normal
        found.counts[part] = ((step[..., 0].abs() < ACCURACY) & near).float()
    return found


def fit_head(
    network: DeepSDFNetwork,
    latents: Tensor,
    targets: HeadTargets,
    config: OptimConfig,
    stage: int,
) -> None:
    """Train the head in place on targets at `latents`; `stage` makes the random draws others."""
    generator = torch.Generator().manual_seed(config.seed + 2 + stage)
    optimizers = split_optimizers([network.head], [], config.adam_rate, config.muon_rate, 0.0)
    schedulers = [
        torch.optim.lr_scheduler.LambdaLR(o, lambda k: cosine_rate(k, config.refine_steps))
        for o in optimizers
    ]
    network.head.requires_grad_(True)
    for _ in range(config.refine_steps):
        pick = torch.randint(len(latents), (config.head_batch,), generator=generator)
        offset = network.outline(latents[pick]) - targets.points[pick]
        away = (offset * targets.normals[pick]).sum(-1).square()
        error = (1 - ALONG) * away + ALONG * offset.square().sum(-1)
        loss = (error * targets.counts[pick]).mean()
        for optimizer in optimizers:
            optimizer.zero_grad()
        loss.backward()
        for optimizer, scheduler in zip(optimizers, schedulers, strict=True):
            optimizer.step()
            scheduler.step()
