"""Lightning's model side: networks, losses and two optimisers.

Loss = mean w |f - d| + gradient_weight |grad f - n|^2 (near)         distance and normals
     + head_weight |g - target|^2 + consistency_weight f(g(z); z)^2    outline head
with exact distances d and normals n, w = 1 / (|d| + 5 mm). Every expectation runs over
the outlines (learned codes: an auto-decoder) and over the latents between them, whose
codes are fixed convex combinations of the learned ones and move with them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from lightning import LightningModule
from torch import Tensor, nn

from tpcd.shape.deepsdf import UNIT, Architecture, DeepSDFNetwork
from training.config import NetworkConfig, TrainingConfig
from training.data import Batch, Prepared
from training.rates import cosine_rate, split_optimizers

NEAR = 0.03
"""Distance up to which the gradient of f counts fully [m]."""
FAR_WEIGHT = 0.3
"""What it counts further away, where it keeps f from spurious level sets."""
SOFTENING = 0.005
"""Errors count in proportion to 1 / (distance + this) [m]."""


class PriorModule(LightningModule):
    """Trains one `DeepSDFNetwork`."""

    def __init__(self, prepared: Prepared, config: TrainingConfig) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.data, self.config = prepared, config
        self.network = initial_network(prepared, config)

    def between_latents(self, index: Int[Tensor, " k"]) -> Float[Tensor, "k z"]:
        """Current latents in between of these indices; they follow the codes."""
        return self.data.weights[index] @ self.network.codes + self.data.offsets[index]

    def training_step(self, batch: Batch, batch_index: int) -> None:
        """One step of both optimisers."""
        terms = self.loss_terms(batch, batch_index >= self.config.optim.steps // 3)
        loss = torch.stack(list(terms.values())).sum()
        optimizers = self.optimizers()
        for optimizer in optimizers:
            optimizer.zero_grad()
        self.manual_backward(loss)
        for optimizer, scheduler in zip(optimizers, self.lr_schedulers(), strict=True):
            optimizer.step()
            scheduler.step()
        with torch.no_grad():
            self.network.codes.clamp_(-1, 1)
        if batch_index % 20 == 0:
            self.log("loss", loss.detach(), prog_bar=True)
            self.log_dict({f"loss/{name}": term.detach() for name, term in terms.items()})

    def loss_terms(self, batch: Batch, consistent: bool) -> dict[str, Tensor]:
        """Weighted terms of the loss; `consistent` adds f(g(z); z)^2."""
        data, optim, network = self.data, self.config.optim, self.network
        terms = self._distance_terms(batch, self.between_latents(batch.between))
        # The head learns where the latents are; it does not move them.
        latents, codes = self.between_latents(batch.head).detach(), network.codes.detach()
        simple = data.simple[batch.head].float()
        between_error = (network.outline(latents) - data.morphs[batch.head]).square()
        object_error = (network.outline(codes) - data.targets).square()
        terms["head"] = optim.head_weight * (
            (between_error.sum(-1).mean(-1) * simple).mean() + object_error.sum(-1).mean()
        )
        if consistent:
            terms["consistency"] = optim.consistency_weight * self._consistency(batch)
        return terms

    def _distance_terms(self, batch: Batch, latents: Tensor) -> dict[str, Tensor]:
        data = self.data
        own = (batch.outline, batch.outline_sample)
        between = (batch.between, batch.between_sample)

        def pick(name: str) -> Tensor:
            first = getattr(data.object_samples, name)[own]
            return torch.cat((first, getattr(data.between_samples, name)[between]))

        points, distance, normal = pick("points"), pick("distance"), pick("gradient")
        points = points.requires_grad_()
        z = torch.cat((self.network.codes[batch.outline], latents))
        counts = torch.ones(len(z))
        counts[len(batch.outline) :] = data.simple[batch.between].float()
        value = self.network.distance(points[:, None], z)[:, 0]
        gradient = torch.autograd.grad(value.sum(), points, create_graph=True)[0]
        weight = counts / (distance.abs() + SOFTENING / UNIT)
        near = torch.where(distance.abs() < NEAR / UNIT, 1.0, FAR_WEIGHT) * counts
        return {
            "distance": (weight * (value - distance).abs()).mean(),
            "gradient": self.config.optim.gradient_weight
            * (near * (gradient - normal).square().sum(-1)).mean(),
        }

    def _consistency(self, batch: Batch) -> Tensor:
        """Mean f(g(z); z)^2, over latents in between plus over outlines."""
        codes = self.network.codes.detach()
        between = self.between_latents(batch.consistency).detach()
        z = torch.cat((between, codes[batch.consistency_outline]))
        points = self.network.outline(z)
        # A few points of many outlines teach as much as all points of few.
        stride = max(1, points.shape[1] // self.config.optim.consistency_points)
        some = points.roll(int(batch.consistency_start), 1)[:, ::stride]
        square = self.network.distance(some, z).square().mean(-1)
        counts = self.data.simple[batch.consistency].float()
        return (square[: len(counts)] * counts).mean() + square[len(counts) :].mean()

    def configure_optimizers(self) -> tuple[list, list]:
        """Adam and Muon, see `rates`; the schedules are stepped with them."""
        optim = self.config.optim
        optimizers = split_optimizers(
            [self.network.sdf, self.network.head],
            [self.network.codes],
            optim.adam_rate,
            optim.muon_rate,
            optim.code_rate,
        )
        schedulers = [
            torch.optim.lr_scheduler.LambdaLR(o, lambda k: cosine_rate(k, optim.steps))
            for o in optimizers
        ]
        return optimizers, schedulers


def initial_network(prepared: Prepared, config: TrainingConfig) -> DeepSDFNetwork:
    """Networks with sine-friendly initial weights (Sitzmann et al. 2020, section 3.2)."""
    sizes = config.network
    architecture = Architecture(
        latent_dim=sizes.latent_dim,
        sdf_width=sizes.sdf_width,
        sdf_depth=sizes.sdf_depth,
        head_width=sizes.head_width,
        head_depth=sizes.head_depth,
        points=config.layout.points,
        disc_radius=sizes.disc_radius,
    )
    network = DeepSDFNetwork(architecture, len(prepared.names))
    generator = torch.Generator().manual_seed(config.optim.seed)
    with torch.no_grad():
        _draw_weights(network.sdf, generator)
        _draw_weights(network.head, generator)
        network.sdf[0].weight.uniform_(-1, 1, generator=generator)
        network.sdf[0].weight[:, :2].mul_(sizes.point_frequency)
        network.sdf[0].weight[:, 2:].mul_(sizes.latent_frequency)
        network.head[0].weight.uniform_(-1, 1, generator=generator)
        network.head[0].weight.mul_(sizes.head_frequency)
        network.codes.copy_(prepared.codes)
    return network


def with_new_head(network: DeepSDFNetwork, sizes: NetworkConfig, seed: int) -> DeepSDFNetwork:
    """A network with the same signed distance and codes, and a head that has learnt nothing."""
    architecture = replace(
        network.architecture, head_width=sizes.head_width, head_depth=sizes.head_depth
    )
    fresh = DeepSDFNetwork(architecture, len(network.codes))
    kept = {k: v for k, v in network.state_dict().items() if not k.startswith("head.")}
    fresh.load_state_dict(fresh.state_dict() | kept)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        _draw_weights(fresh.head, generator)
        fresh.head[0].weight.uniform_(-1, 1, generator=generator)
        fresh.head[0].weight.mul_(sizes.head_frequency)
    return fresh


def _draw_weights(mlp: nn.Sequential, generator: torch.Generator) -> None:
    """Weights of all layers; the first one's depend on what it takes."""
    for layer in mlp:
        if isinstance(layer, nn.Linear):
            bound = math.sqrt(6 / layer.in_features)
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-math.pi, math.pi, generator=generator)
    mlp[-1].weight.mul_(0.3)
    mlp[-1].bias.zero_()
