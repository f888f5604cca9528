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

from tpcd.shape.outline import Outline, hull, points_at, resample_positions
from tpcd.shape.protocol import Misfit

CHUNK = 1 << 16
"""Point-edge pairs looked at together; few enough to stay in the processor's cache."""


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
        """Signed distance to the polygon [m], positive outside; exact, and differentiable.

        The nearest edge is found without autograd. Where it is met between its ends, the
        distance is the height over it, `n . (p - a)`; where it is met at a vertex, the distance
        to that vertex with the sign of `(n_before + n_after) . (p - v)` (the angle-weighted
        normal of Baerentzen and Aanaes, IEEE TVCG 2005, in the plane). The gradient is a unit
        vector everywhere, on the outline too.
        """
        points = points_object.reshape(-1, 2)
        vertices = self._vertices.to(points)
        edges = torch.roll(vertices, -1, 0) - vertices
        lengths = edges.norm(dim=-1)
        normals = torch.stack((edges[:, 1], -edges[:, 0]), dim=-1) / lengths[:, None]
        with torch.no_grad():
            nearest = _nearest_edge(points, vertices, edges)
            along = _fraction_along(points, vertices[nearest], edges[nearest])
            at_start, at_end = along <= 0, along >= 1
            count = len(vertices)
            corner = torch.where(at_end, (nearest + 1) % count, nearest)
            corner_normals = (normals + torch.roll(normals, 1, 0))[corner]
            corner_offset = points - vertices[corner]
            outside = (corner_normals * corner_offset).sum(-1) >= 0
            sign = torch.where(outside, 1.0, -1.0).to(points.dtype)
            tiny = torch.finfo(points.dtype).eps * lengths.sum()
            from_corner = (at_start | at_end) & (corner_offset.norm(dim=-1) > tiny)
        offset = points - vertices[corner]
        # A unit stand-in where the height is taken keeps the norm away from its 0/0 gradient.
        safe = torch.where(from_corner[:, None], offset, torch.ones_like(offset))
        height = (normals[nearest] * (points - vertices[nearest])).sum(-1)
        distance = torch.where(from_corner, sign * safe.norm(dim=-1), height)
        return distance.reshape(points_object.shape[:-1])

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

    def sample_latent(self, count: int, generator: torch.Generator) -> Float64[Tensor, "count z"]:
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


def _fraction_along(points: Tensor, starts: Tensor, edges: Tensor) -> Tensor:
    return ((points - starts) * edges).sum(-1) / (edges * edges).sum(-1)


def _nearest_edge(points: Tensor, vertices: Tensor, edges: Tensor) -> Tensor:
    """Index of the edge nearest to each point (first of equals), without autograd."""
    found = []
    (edge_x, edge_z), squares = edges.unbind(-1), (edges * edges).sum(-1)
    unit_x, unit_z = edge_x / squares, edge_z / squares
    for chunk in points.split(max(1, CHUNK // len(vertices))):
        x = chunk[:, :1] - vertices[:, 0]
        z = chunk[:, 1:] - vertices[:, 1]
        along = (x * unit_x).addcmul_(z, unit_z).clamp_(0, 1)
        x.addcmul_(along, edge_x, value=-1)
        z.addcmul_(along, edge_z, value=-1)
        found.append(x.square_().addcmul_(z, z).argmin(-1))
    return torch.cat(found) if found else torch.zeros(0, dtype=torch.long, device=points.device)
