"""What the rest of the library asks of a shape model.

Two kinds exist: a learned family of outlines (`DeepSDFShape`, one latent per particle)
and a fixed polygon (`PolygonShape`, latent of size zero). Lengths are metres in the
object frame at scale 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LEAST_WIDTH = 0.01
"""Narrower bumps of the misfit field would be hundreds [rad]."""


@dataclass(frozen=True)
class Misfit:
    """How an outline differs from the best one of a family, seen from a flat terrain: its support
    function is off by a random function of the angle, which `training.misfit` measures.

    The defaults of the texture are those of `ycb-rich`, for shapes of which nothing was measured.
    """

    sd: float = 0.0
    """Standard deviation of its smooth part [m], in the geometric mean over outlines; 0 where the
    outline is exact."""
    spread: float = 1.0
    """Standard deviation of the logarithm of that standard deviation, by outline."""
    width: float = 0.159
    """Between two angles that has the correlation exp(-(a - b)^2 / (4 width^2)) [rad]."""
    grain: float = 0.059
    """Standard deviation of what is not smooth, as a share of `sd`."""
    roughness: float = 2.76
    """The same of its slope [1/rad], by which contact is elsewhere along the terrain."""

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        for name, value in vars(self).items():
            least = LEAST_WIDTH if name == "width" else 0.0
            if not least <= value < math.inf:
                raise ValueError(
                    f"{name} of the misfit is {value}, expected a finite number of at least {least}"
                )


@runtime_checkable
class Shape(Protocol):
    """A family of closed planar outlines indexed by a latent in [-1, 1]^z."""

    @property
    def latent_dim(self) -> int:
        """Size z of the latent; 0 for a fixed outline."""
        ...

    @property
    def misfit(self) -> Misfit:
        """How outlines differ from the best one of the family."""
        ...

    def signed_distance(
        self, points_object: Float[Tensor, "*batch p 2"], latent: Float[Tensor, "*batch z"]
    ) -> Float[Tensor, "*batch p"]:
        """Signed distance to the outline [m], positive outside the object."""
        ...

    def boundary_points(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch p 2"]:
        """Outline points, counter-clockwise, dense where the outline bends [m].

        The number of points p is the same for every latent of one model; differentiable
        with respect to the latent; dtype and device follow the latent.
        """
        ...

    def valid(self, latent: Float[Tensor, "*batch z"]) -> Bool[Tensor, "*batch"]:
        """Whether the latent decodes to exactly one closed outline of plausible size."""
        ...

    def log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """Log of the prior density of the latent; -inf far from what is valid."""
        ...

    def latent_curvature(
        self, latent: Float[Tensor, "*batch z"]
    ) -> tuple[Float[Tensor, "*batch z"], Float[Tensor, "*batch z z"]]:
        """Gradient of the log density within the valid region, and a precision, positive
        semi-definite, that bounds its curvature."""
        ...

    def sample_latent(
        self, count: int, generator: torch.Generator, checked: bool = True
    ) -> Float[Tensor, "count z"]:
        """Draw valid latents from the prior, float64 on the CPU; without the check, which takes
        time, a few of them may not be valid."""
        ...
