"""Outlines of many particles, decoded in several threads."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import place_points
from tpcd.parameters import Parameters
from tpcd.shape.protocol import Shape
from tpcd.threads import over_threads


def outlines(shape: Shape, parameters: Parameters) -> Float[Tensor, "m p 2"]:
    """Outline points of m particles in the end-effector frame [m], decoded in the same threads.

    Records no gradient.
    """
    points = decode(shape, parameters.latent)
    with torch.no_grad():
        return place_points(points, parameters.scale, parameters.mount)


def decode(shape: Shape, latent: Float[Tensor, "m z"]) -> Float[Tensor, "m p 2"]:
    """Outline points of m latents in the object frame [m], in the same threads, no gradient."""
    return torch.cat(over_threads(shape.boundary_points, latent))
