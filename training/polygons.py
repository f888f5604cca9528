"""Signed distances to many polygons at once, in torch, and points worth knowing them at."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Samples:
    """Points around each of n outlines with the exact signed distance and its gradient."""

    points: Float[Tensor, "n s 2"]
    distance: Float[Tensor, "n s"]
    """Positive outside."""
    gradient: Float[Tensor, "n s 2"]
    """Unit vectors, pointing away from the inside."""


def signed_distance(
    points: Float[Tensor, "n s 2"], polygons: Float[Tensor, "n v 2"]
) -> tuple[Float[Tensor, "n s"], Float[Tensor, "n s 2"]]:
    """Signed distance to closed polygons and its gradient, in the unit of the input.

    Inside is where the winding number is not zero, so that an outline that crosses itself
    counts as the union of its loops.
    """
    edges = torch.roll(polygons, -1, 1) - polygons
    offsets = points[:, :, None] - polygons[:, None]
    edge_squares = edges.square().sum(-1).clamp_min(1e-12)
    along = ((offsets * edges[:, None]).sum(-1) / edge_squares[:, None]).clamp(0, 1)
    to_point = offsets - along[..., None] * edges[:, None]
    nearest = to_point.square().sum(-1).argmin(-1)
    index = nearest[..., None, None].expand(-1, -1, 1, 2)
    away = to_point.gather(2, index)[:, :, 0]
    distance = away.norm(dim=-1)
    low, high = polygons[:, None, :, 1], torch.roll(polygons, -1, 1)[:, None, :, 1]
    height = points[:, :, None, 1]
    left = edges[:, None, :, 0] * offsets[..., 1] - edges[:, None, :, 1] * offsets[..., 0]
    upward = (low <= height) & (high > height) & (left > 0)
    downward = (low > height) & (high <= height) & (left < 0)
    winding = upward.sum(-1) - downward.sum(-1)
    sign = torch.where(winding != 0, -1.0, 1.0).to(points)
    return sign * distance, sign[..., None] * away / distance.clamp_min(1e-9)[..., None]


def sample_around(
    base: Float[Tensor, "n p 2"],
    polygons: Float[Tensor, "n v 2"],
    count: int,
    spreads: tuple[float, float],
    half_width: float,
    generator: torch.Generator,
) -> Samples:
    """Draw `count` points around each outline and measure their distance to it.

    Half lie near the outline (normal noise of sd `spreads[0]` about points of the polygon
    `base`, whose dense corners draw dense samples), 30 % further (`spreads[1]`), the rest
    are uniform in the square of `half_width` or in the bounding box. Distances are to `polygons`.
    """
    n, p, _ = base.shape
    near, middle = count // 2, 3 * count // 10
    pick = torch.randint(p, (n, near + middle), generator=generator)
    share = torch.rand(n, near + middle, 1, generator=generator)
    start = base.gather(1, pick[..., None].expand(-1, -1, 2))
    end = base.gather(1, ((pick + 1) % p)[..., None].expand(-1, -1, 2))
    spread = torch.full((near + middle, 1), spreads[1])
    spread[:near] = spreads[0]
    close = start + share * (end - start)
    close = close + spread * torch.randn(close.shape, generator=generator)
    far = 2 * torch.rand(n, count - near - middle, 2, generator=generator) - 1
    # A third of the far points fall into the bounding box, so that wide insides are covered.
    third = far.shape[1] // 3
    low, high = polygons.amin(1, keepdim=True), polygons.amax(1, keepdim=True)
    within = (low + high) / 2 + far[:, :third] * (high - low) / 2
    points = torch.cat((close, within, far[:, third:] * half_width), dim=1)
    # 4 million point-edge pairs at a time keep the scratch memory below 200 MB.
    block = max(1, 4_000_000 // (count * polygons.shape[1]))
    pieces = [
        signed_distance(points[i : i + block], polygons[i : i + block]) for i in range(0, n, block)
    ]
    distance, gradient = (torch.cat(piece) for piece in zip(*pieces, strict=True))
    return Samples(points, distance, gradient)
