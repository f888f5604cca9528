"""Lightning's model side: the decoder, its losses and two optimisers.

Loss = distance_weight mean w (f - d)^2           signed distances around the true outlines
     + support_weight mean (h - h_true)^2         support functions, which contact feels
     + outline_weight (error at the codes + error at the latents in between)
with exact distances d, w = 1 / (1 + (d / 5 mm)^2), and the error of `Targets`: how far points are
from where correspondence puts them. Codes are learned (an auto-decoder). Latents in between
are fixed convex combinations of the codes and move with them, but do not pull at them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from lightning import LightningModule
from torch import Tensor, nn

from tpcd.shape.deepsdf import UNIT, Architecture, DeepSDFNetwork
from tpcd.shape.distance import polygon_distance
from training.config import TrainingConfig
from training.data import Batch, Prepared
from training.polygons import outward_normals, support
from training.rates import cosine_rate, split_optimizers
from training.watch import check_loss

SOFTENING = 0.005
"""Distances count half at this distance from the outline [m], and less beyond."""
ALONG = 0.5
"""Weight of a squared offset along the outline, against 1 across it."""
EDGE = 3e-5
"""Weight of the squared error of an edge, relative to its length: it keeps edges from turning."""
LEAST_EDGE = 1e-3
"""Shorter edges count as so long, in units of `UNIT`."""


@dataclass(frozen=True, eq=False)
class Targets:
    """Where decoded points should be, in units of `UNIT`."""

    points: Float[Tensor, "n p 2"]
    normals: Float[Tensor, "n p 2"]
    edges: Float[Tensor, "n p"]
    """Lengths of the edges that begin at the points."""

    @staticmethod
    def of(points: Float[Tensor, "n p 2"]) -> Targets:
        """Targets with the normals and edges of these polygons."""
        edges = (points.roll(-1, 1) - points).norm(dim=-1)
        return Targets(points, outward_normals(points), edges.clamp_min(LEAST_EDGE))

    def error(self, outlines: Float[Tensor, "k p 2"], which: Int[Tensor, " k"]) -> Tensor:
        """Mean squared error of k outlines, as it counts."""
        offset = outlines - self.points[which]
        across = (offset * self.normals[which]).sum(-1).square()
        turned = (offset.roll(-1, 1) - offset).square().sum(-1) / self.edges[which].square()
        return ((1 - ALONG) * across + ALONG * offset.square().sum(-1) + EDGE * turned).mean()


class PriorModule(LightningModule):
    """Trains one `DeepSDFNetwork`."""

    def __init__(self, prepared: Prepared, config: TrainingConfig) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.data, self.config = prepared, config
        self.network = initial_network(prepared, config)
        self.first_loss: float | None = None
        """Loss of the first step, with which later ones are compared."""
        self.terms: dict[str, Tensor] = {}
        """Loss of the last step, whole and term by term."""
        self.own, self.morphs = Targets.of(prepared.targets), Targets.of(prepared.morphs)

    def between_latents(self, index: Int[Tensor, " k"]) -> Float[Tensor, "k z"]:
        """Current latents in between of these indices; they follow the codes."""
        return self.data.weights[index] @ self.network.codes + self.data.offsets[index]

    def training_step(self, batch: Batch, batch_index: int) -> None:
        """One step of both optimisers; TrainingError where the loss says that it would be in
        vain."""
        terms = self.loss_terms(batch)
        loss = torch.stack(list(terms.values())).sum()
        self.first_loss = self.first_loss if batch.step else float(loss.detach())
        self.terms = {"loss": loss.detach()} | {f"loss/{k}": v.detach() for k, v in terms.items()}
        check_loss(self.terms, self.first_loss, batch.step + 1, self.config.optim)
        optimizers = self.optimizers()
        for optimizer in optimizers:
            optimizer.zero_grad()
        self.manual_backward(loss)
        for optimizer, scheduler in zip(optimizers, self.lr_schedulers(), strict=True):
            optimizer.step()
            scheduler.step()
        with torch.no_grad():
            self.network.codes.clamp_(-1, 1)

    def loss_terms(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted terms of the loss."""
        data, optim, network = self.data, self.config.optim, self.network
        outlines = network.outline(network.codes)
        between = network.outline(self.between_latents(batch.between).detach())
        points = data.samples.points[batch.outline, batch.sample]
        wanted = data.samples.distance[batch.outline, batch.sample]
        found = polygon_distance(points[:, None], outlines[batch.outline])[:, 0]
        weight = 1 / (1 + (wanted / (SOFTENING / UNIT)).square())
        felt = support(outlines, batch.angles) - support(data.true, batch.angles)
        every = torch.arange(len(outlines))
        off = self.own.error(outlines, every) + self.morphs.error(between, batch.between)
        return {
            "distance": optim.distance_weight * (weight * (found - wanted).square()).mean(),
            "support": optim.support_weight * felt.square().mean(),
            "outline": optim.outline_weight * off,
        }

    def configure_optimizers(self) -> tuple[list, list]:
        """Adam and Muon, see `rates`; the schedules are stepped with them."""
        optim = self.config.optim
        optimizers = split_optimizers(
            self.network.decoder,
            self.network.codes,
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
    """A decoder with sine-friendly initial weights (Sitzmann et al. 2020, section 3.2)."""
    sizes = config.network
    architecture = Architecture(sizes.latent_dim, sizes.width, sizes.depth, config.layout.points)
    network = DeepSDFNetwork(architecture, len(prepared.names))
    generator = torch.Generator().manual_seed(config.optim.seed)
    with torch.no_grad():
        _draw_weights(network.decoder, generator)
        network.decoder[0].weight.uniform_(-1, 1, generator=generator).mul_(sizes.frequency)
        network.codes.copy_(prepared.codes)
    return network


def _draw_weights(mlp: nn.Sequential, generator: torch.Generator) -> None:
    """Weights of all layers; the first one's depend on what it takes."""
    for layer in mlp:
        if isinstance(layer, nn.Linear):
            bound = math.sqrt(6 / layer.in_features)
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-math.pi, math.pi, generator=generator)
    mlp[-1].weight.mul_(0.3)
    mlp[-1].bias.zero_()
