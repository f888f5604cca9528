"""`PolygonShape`: one fixed outline as a shape model, latent of size zero.

It stands in for the learned family wherever the outline is known: truth in simulation, tests
of contact, objects a user has measured. Distances and points are in the object frame at
scale 1 [m]; dtype and device follow the inputs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from tpcd.shape.distance import polygon_distance
from tpcd.shape.outline import Outline, hull, points_at, resample_positions
from tpcd.shape.protocol import Misfit


@dataclass(frozen=True, eq=False)
class PolygonShape:
    """The shape protocol for one outline: exact, differentiable in the points."""

    outline: Outline
    """The outline, in the object frame."""
    max_points: int = 96
    """Boundary points to aim at. All vertices are taken where they are no more than this;
    otherwise all hull vertices, however many, filled up with resampled points: a half-plane
    touches only hull vertices, so contact with floor and wall stays exact."""
    misfit: Misfit = Misfit()
    """How the true outline differs from this one."""
    latent_dim: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if self.max_points < 3:
            raise ValueError(f"max_points must be at least 3, got {self.max_points}")

    def signed_distance(
        self, points_object: Float[Tensor, "*batch p 2"], latent: Float[Tensor, "*batch z"]
    ) -> Float[Tensor, "*batch p"]:
        """Signed distance to the polygon [m], positive outside; exact and differentiable with
        a gradient of norm one everywhere, see `polygon_distance`."""
        points = points_object.reshape(1, -1, 2)
        found = polygon_distance(points, self._vertices.to(points)[None])
        return found.reshape(points_object.shape[:-1])

    def boundary_points(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch p 2"]:
        """The same outline points for the whole batch [m], counter-clockwise."""
        points = self._boundary.to(latent)
        return points.expand(*latent.shape[:-1], *points.shape)

    def valid(self, latent: Float[Tensor, "*batch z"]) -> Bool[Tensor, "*batch"]:
        """True for the whole batch."""
        return torch.ones(latent.shape[:-1], dtype=torch.bool, device=latent.device)

    def log_density(self, latent: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch"]:
        """Zero: the only latent has probability one."""
        return torch.zeros(latent.shape[:-1], dtype=latent.dtype, device=latent.device)

    def latent_curvature(
        self, latent: Float[Tensor, "*batch z"]
    ) -> tuple[Float[Tensor, "*batch z"], Float[Tensor, "*batch z z"]]:
        """Of a latent of size zero."""
        return torch.zeros_like(latent), latent.new_zeros(*latent.shape, latent.shape[-1])

    def sample_latent(
        self, count: int, generator: torch.Generator, checked: bool = True
    ) -> Float64[Tensor, "count z"]:
        """Latents of size zero (count, 0), float64 on the CPU."""
        return torch.zeros((count, 0), dtype=torch.float64)

    @cached_property
    def _vertices(self) -> Tensor:
        return torch.tensor(self.outline.vertices, dtype=torch.float64)

    @cached_property
    def _boundary(self) -> Tensor:
        return torch.tensor(_contact_points(self.outline, self.max_points), dtype=torch.float64)


def _contact_points(outline: Outline, max_points: int) -> np.ndarray:
    vertices = outline.vertices
    if len(vertices) <= max_points:
        return np.array(vertices)
    on_hull = (vertices[:, None] == hull(outline)[None]).all(-1).any(1)
    exact = vertices[on_hull]
    filler = max_points - len(exact)
    if filler < 3:
        return exact
    lengths = np.linalg.norm(np.roll(vertices, -1, axis=0) - vertices, axis=1)
    starts = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))
    positions = resample_positions(outline, filler, turning_weight=0.5)
    points = np.concatenate((exact, points_at(outline, positions)))
    return points[np.argsort(np.concatenate((starts[on_hull], positions)), kind="stable")]
