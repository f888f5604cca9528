"""Where a trained prior decodes to one plausible outline, and the density on that region.

Two dimensions: a mask over the square, found by decoding every node of a grid. More
dimensions: the fitted mixture, a floor below which it is not trusted, and a small
classifier ("judge") that learns which draws of the mixture decode well.
"""

from __future__ import annotations

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tpcd.errors import TpcdError
from tpcd.shape.deepsdf import DeepSDFNetwork, DeepSDFShape
from tpcd.shape.density import MaskDensity, MixtureDensity
from tpcd.shape.levelset import LARGEST_SIZE, SMALLEST_SIZE, decode_many
from training.mixture import Mixture


class TrainingError(TpcdError):
    """A training that led to no usable prior."""


FARTHEST_HEAD = 0.002
"""A latent is not valid where the head strays from the level set by more than this [m]."""
SLIMMEST = 0.006
"""Nor where the head's outline vanishes when its boundary moves in by half of this [m]."""
LEFT_OUT = 0.01
"""Share of the mixture's draws that lie below the density floor."""
PRECISION = 0.999
"""Share of accepted draws that must be good, on draws the judge has not learned from."""


def decodes_well(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"], spacing: float = 0.004
) -> Bool[np.ndarray, " count"]:
    """One closed outline of plausible size, and the head's simple polygon lies on it."""
    good = head_is_sound(shape, latents)
    candidates = latents[torch.from_numpy(good)]
    good[good] = [found.plausible for found in decode_many(shape, candidates, spacing)]
    return good


def head_is_sound(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"]
) -> Bool[np.ndarray, " count"]:
    """The head's points form a simple polygon of plausible size and lie near f = 0."""
    sound = []
    for some in latents.split(500):
        with torch.no_grad():
            points = shape.boundary_points(some)
            distance = shape.signed_distance(points, some).abs().amax(-1).numpy()
        polygons = shapely.polygons(points.double().numpy())
        size = np.ptp(points.numpy(), axis=1).max(axis=1)
        good = shapely.is_valid(polygons) & (distance < FARTHEST_HEAD)
        good &= (size >= SMALLEST_SIZE) & (size <= LARGEST_SIZE)
        good[good] = ~shapely.is_empty(shapely.buffer(polygons[good], -SLIMMEST / 2))
        sound.append(good)
    return np.concatenate(sound)


def fit_mask(network: DeepSDFNetwork, cells: int) -> MaskDensity:
    """Mark the cells of the square whose four corners all decode well."""
    everywhere = MaskDensity(torch.ones(1, 1, dtype=torch.bool))
    shape = DeepSDFShape(network, everywhere)
    ticks = torch.linspace(-1, 1, cells + 1, dtype=torch.float64)
    nodes = torch.cartesian_prod(ticks, ticks)
    good = torch.from_numpy(decodes_well(shape, nodes)).reshape(cells + 1, cells + 1)
    if not good.any():
        raise TrainingError("no latent decodes to one closed outline; train for more steps")
    return MaskDensity(good[1:, 1:] & good[:-1, 1:] & good[1:, :-1] & good[:-1, :-1])


def fit_truncated_mixture(
    network: DeepSDFNetwork, mixture: Mixture, seed: int, draws: int
) -> MixtureDensity:
    """Truncate the mixture to where the trained networks decode well.

    The judge learns from three quarters of `draws`; its threshold is the lowest at which
    `PRECISION` of the accepted others are good.
    """
    generator = torch.Generator().manual_seed(seed + 10)
    parts = (mixture.weights, mixture.means, mixture.factors)
    whole = MixtureDensity(*(torch.from_numpy(part) for part in parts), -np.inf, 1.0)
    latents = whole.raw_sample(draws, generator)
    log_density = whole.raw_log_density(latents)
    floor = float(log_density.quantile(LEFT_OUT))
    inside = (latents.abs() <= 1).all(-1) & (log_density >= floor)
    inside_latents = latents[inside]
    sound = torch.from_numpy(head_is_sound(DeepSDFShape(network, whole), inside_latents))
    if not sound.any():
        raise TrainingError("no latent decodes to one closed outline; train for more steps")
    learn = 3 * len(sound) // 4
    judge = _fit_judge(inside_latents[:learn].float(), sound[:learn].float(), seed)
    with torch.no_grad():
        score = judge(inside_latents[learn:].float())[:, 0]
    last = judge[-1]
    with torch.no_grad():
        last.bias -= _threshold(score, sound[learn:])
    linear = [layer for layer in judge if isinstance(layer, nn.Linear)]
    tensors = tuple(p.detach() for layer in linear for p in (layer.weight, layer.bias))
    with torch.no_grad():
        accepted = judge(latents.float())[:, 0] > 0
    kept = float((inside & accepted).double().mean())
    return MixtureDensity(whole.weights, whole.means, whole.factors, floor, kept, tensors)


def _fit_judge(latents: Tensor, sound: Tensor, seed: int) -> nn.Sequential:
    """Logistic classifier with two hidden layers, by Adam on cross-entropy."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        judge = nn.Sequential(
            nn.Linear(latents.shape[1], 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(),
            nn.Linear(64, 1),
        )  # fmt: skip
    optimizer = torch.optim.Adam(judge.parameters(), 5e-3, weight_decay=1e-5)
    steps = 1500
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        pick = torch.randint(len(latents), (1024,), generator=generator)
        loss = nn.functional.binary_cross_entropy_with_logits(
            judge(latents[pick])[:, 0], sound[pick]
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return judge.requires_grad_(True)


def _threshold(score: Tensor, sound: Tensor) -> float:
    """Lowest score above which the share of sound draws reaches `PRECISION`."""
    order = score.argsort(descending=True)
    share = sound[order].double().cumsum(0) / torch.arange(1, len(order) + 1)
    enough = (share >= PRECISION).nonzero()
    if not len(enough):
        raise TrainingError("the judge finds no region that decodes well; train longer")
    return float(score[order[enough[-1, 0]]]) - 1e-6
