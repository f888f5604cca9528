"""Last stage: the outline head is taught the level set that the finished f really has.

The head's points are brought onto f = 0 by Newton steps at every training latent, and the
head learns these positions by least squares. That costs far less than evaluating f in every
step, and what is left is the head's own resolution.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.shape.deepsdf import DeepSDFNetwork, project
from training.config import OptimConfig
from training.rates import cosine_rate, split_optimizers

PROJECTIONS = 2
"""Newton steps; points that are then still off by more than `ACCURACY` teach nothing."""
ACCURACY = 0.002
"""Largest |f| of a target, in the networks' unit (0.2 mm)."""
REACH = 0.04
"""Longest way from head point to target, in the networks' unit (4 mm)."""


def refine_head(
    network: DeepSDFNetwork, latents: Float[Tensor, "m z"], config: OptimConfig
) -> None:
    """Train the head in place on projected points at `latents`; f and codes stay."""
    latents = latents[: config.refine_latents]
    latents = torch.cat((latents, network.codes.detach().repeat(8, 1)))
    for stage in range(config.refine_rounds):
        targets, counts = projected_outlines(network, latents)
        _fit_head(network, latents, targets, counts, config, stage)


def projected_outlines(
    network: DeepSDFNetwork, latents: Float[Tensor, "m z"]
) -> tuple[Float[Tensor, "m p 2"], Float[Tensor, "m p"]]:
    """Head points moved onto the zero level set, and 1 where that succeeded, else 0."""
    targets, counts = [], []
    for z in latents.split(250):
        start = network.outline(z).detach()
        points = start
        for _ in range(PROJECTIONS):
            points = project(network, points, z).detach()
        with torch.no_grad():
            on_level = network.distance(points, z).abs() < ACCURACY
        near = (points - start).norm(dim=-1) < REACH
        targets.append(points)
        counts.append((on_level & near).float())
    return torch.cat(targets), torch.cat(counts)


def _fit_head(
    network: DeepSDFNetwork,
    latents: Tensor,
    targets: Tensor,
    counts: Tensor,
    config: OptimConfig,
    stage: int,
) -> None:
    generator = torch.Generator().manual_seed(config.seed + 2 + stage)
    optimizers = split_optimizers([network.head], [], config.adam_rate, config.muon_rate, 0.0)
    schedulers = [
        torch.optim.lr_scheduler.LambdaLR(o, lambda k: cosine_rate(k, config.refine_steps))
        for o in optimizers
    ]
    network.head.requires_grad_(True)
    for _ in range(config.refine_steps):
        pick = torch.randint(len(latents), (config.head_batch,), generator=generator)
        error = (network.outline(latents[pick]) - targets[pick]).square().sum(-1)
        loss = (error * counts[pick]).mean()
        for optimizer in optimizers:
            optimizer.zero_grad()
        loss.backward()
        for optimizer, scheduler in zip(optimizers, schedulers, strict=True):
            optimizer.step()
            scheduler.step()
