"""Where a trained prior decodes to one plausible outline, and the density on that region."""

from __future__ import annotations

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.errors import TpcdError
from tpcd.shape.deepsdf import DeepSDFNetwork, DeepSDFShape
from tpcd.shape.density import MaskDensity
from tpcd.shape.levelset import decode_many


class TrainingError(TpcdError):
    """A training that led to no usable prior."""


FARTHEST_HEAD = 0.002
"""A latent is not valid where the head strays from the level set by more than this [m]."""


def decodes_well(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"], spacing: float = 0.004
) -> Bool[np.ndarray, "count"]:
    """One closed outline of plausible size, and the head's simple polygon lies on it."""
    points = shape.boundary_points(latents).detach()
    distance = shape.signed_distance(points, latents).detach().abs().amax(-1).numpy()
    simple = shapely.is_valid(shapely.polygons(points.double().numpy()))
    good = simple & (distance < FARTHEST_HEAD)
    candidates = latents[torch.from_numpy(good)]
    good[good] = [found.plausible for found in decode_many(shape, candidates, spacing)]
    return good


def fit_mask(network: DeepSDFNetwork, cells: int = 64) -> MaskDensity:
    """Mark the cells of the square whose four corners all decode well."""
    everywhere = MaskDensity(torch.ones(1, 1, dtype=torch.bool))
    shape = DeepSDFShape(network, everywhere)
    ticks = torch.linspace(-1, 1, cells + 1, dtype=torch.float64)
    nodes = torch.cartesian_prod(ticks, ticks)
    good = torch.from_numpy(decodes_well(shape, nodes)).reshape(cells + 1, cells + 1)
    if not good.any():
        raise TrainingError("no latent decodes to one closed outline; train for more steps")
    return MaskDensity(good[1:, 1:] & good[:-1, 1:] & good[1:, :-1] & good[:-1, :-1])
