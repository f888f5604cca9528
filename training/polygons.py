"""Polygons in batches: points worth knowing the distance at, normals, support functions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.shape.distance import polygon_distance

NEAR_SHARE = 0.7
"""Share of the samples that lie near the outline."""
AT_ONCE = 200
"""Outlines whose samples are measured together."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Points around each of n outlines with their exact signed distance."""

    points: Float[Tensor, "n s 2"]
    distance: Float[Tensor, "n s"]
    """Positive outside."""


def sample_around(
    base: Float[Tensor, "n p 2"],
    polygons: Float[Tensor, "n v 2"],
    count: int,
    spreads: tuple[float, float],
    generator: torch.Generator,
) -> Samples:
    """Draw `count` points around each outline and measure their distance to it.

    They are points of the polygons `base`, whose dense corners draw dense samples, with normal
    noise of sd `spreads[0]` (a share `NEAR_SHARE` of them) or `spreads[1]`. Distances are to
    `polygons`.
    """
    n, p, _ = base.shape
    pick = torch.randint(p, (n, count), generator=generator)
    share = torch.rand(n, count, 1, generator=generator)
    start = base.gather(1, pick[..., None].expand(-1, -1, 2))
    end = base.gather(1, ((pick + 1) % p)[..., None].expand(-1, -1, 2))
    spread = torch.full((count, 1), spreads[1])
    spread[: round(NEAR_SHARE * count)] = spreads[0]
    noise = torch.randn(n, count, 2, generator=generator)
    points = start + share * (end - start) + spread * noise
    distance = [
        polygon_distance(points[i : i + AT_ONCE], polygons[i : i + AT_ONCE])
        for i in range(0, n, AT_ONCE)
    ]
    return Samples(points, torch.cat(distance))


def support(polygons: Float[Tensor, "n v 2"], angles: Float[Tensor, " k"]) -> Float[Tensor, "n k"]:
    """Support function in the directions of `angles` [rad], in the unit of the input."""
    outward = torch.stack((angles.cos(), angles.sin()))
    return (polygons @ outward).amax(-2)


def outward_normals(polygons: Float[Tensor, "n v 2"]) -> Float[Tensor, "n v 2"]:
    """Unit normals at the vertices of counter-clockwise polygons, across both neighbours."""
    along = polygons.roll(-1, 1) - polygons.roll(1, 1)
    normals = torch.stack((along[..., 1], -along[..., 0]), dim=-1)
    return normals / normals.norm(dim=-1, keepdim=True).clamp_min(1e-9)
