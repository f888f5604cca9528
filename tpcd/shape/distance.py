"""Exact signed distances to closed polygons, one for each element of a batch.

Shared by everything that knows an outline by its vertices: fixed polygons and the decoded
outlines of the learned family. Dtype and device follow the points.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

CHUNK = 1 << 16
"""Point-edge pairs looked at together; few enough to stay in the processor's cache."""


def polygon_distance(
    points: Float[Tensor, "n s 2"], polygons: Float[Tensor, "n v 2"]
) -> Float[Tensor, "n s"]:
    """Signed distance of points to the polygon of their element, positive outside; exact, and
    differentiable with respect to both.

    Vertices run counter-clockwise. Inside is where the winding number is not zero, so that a
    polygon that crosses itself counts as the union of its loops. The nearest edge is found
    without autograd. Where it is met between its ends, the distance is the height over it,
    `n . (p - a)`; where it is met at a vertex v, the distance to v with the sign of
    `(n_before + n_after) . (p - v)` (the angle-weighted normal of Baerentzen and Aanaes, IEEE
    TVCG 2005, in the plane). The gradient by the points is a unit vector everywhere, on the
    polygon too. Edges of no length are allowed; they never are the nearest between their ends.
    """
    after = torch.roll(polygons, -1, 1)
    edges = after - polygons
    with torch.no_grad():
        nearest, inside = _nearest_edge(points, polygons, edges)
        lengths = edges.norm(dim=-1)
        tiny = torch.finfo(points.dtype).eps * lengths.sum(-1, keepdim=True)
        start, edge = _pick(polygons, nearest), _pick(edges, nearest)
        square = edge.square().sum(-1).clamp_min(torch.finfo(points.dtype).tiny)
        along = ((points - start) * edge).sum(-1) / square
        at_end = along >= 1
        corner = torch.where(at_end, (nearest + 1) % polygons.shape[1], nearest)
        between = (along > 0) & ~at_end
    normals = torch.stack((edges[..., 1], -edges[..., 0]), dim=-1)
    normals = normals / edges.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(points.dtype).tiny)
    height = (_pick(normals, nearest) * (points - _pick(polygons, nearest))).sum(-1)
    offset = points - _pick(polygons, corner)
    with torch.no_grad():
        corner_normals = _pick(normals + torch.roll(normals, 1, 1), corner)
        outwards = (corner_normals * offset).sum(-1) >= 0
        sign = torch.where(outwards, 1.0, -1.0).to(points.dtype)
        from_corner = ~between & (offset.norm(dim=-1) > tiny)
    # A unit stand-in where the height is taken keeps the norm away from its 0/0 gradient.
    safe = torch.where(from_corner[..., None], offset, torch.ones_like(offset))
    distance = torch.where(from_corner, sign * safe.norm(dim=-1), height)
    with torch.no_grad():
        # Within a knot the nearest edge may run the other way round.
        wrong = (inside != (distance < 0)) & (distance.abs() > tiny)
    return torch.where(wrong, -distance, distance)


def _pick(of_vertices: Float[Tensor, "n v 2"], index: Int[Tensor, "n s"]) -> Float[Tensor, "n s 2"]:
    return of_vertices.gather(1, index[..., None].expand(-1, -1, 2))


def _nearest_edge(
    points: Float[Tensor, "n s 2"], starts: Float[Tensor, "n v 2"], edges: Float[Tensor, "n v 2"]
) -> tuple[Int[Tensor, "n s"], Bool[Tensor, "n s"]]:
    """Index of the edge nearest to each point (first of equals), and whether the winding number
    is not zero; without autograd."""
    n, s, v = points.shape[0], points.shape[1], starts.shape[1]
    nearest = torch.zeros((n, s), dtype=torch.long, device=points.device)
    inside = torch.zeros((n, s), dtype=torch.bool, device=points.device)
    squares = edges.square().sum(-1, keepdim=True).clamp_min(torch.finfo(points.dtype).tiny)
    units = edges / squares
    many = max(1, CHUNK // max(v * s, 1))
    few = max(1, CHUNK // v)
    for first in range(0, n, many):
        polygon = slice(first, first + many)
        start, edge, unit = (x[polygon, None] for x in (starts, edges, units))
        low = start[..., 1]
        high = low.roll(-1, -1)
        for begin in range(0, s, few):
            part = (polygon, slice(begin, begin + few))
            point = points[part]
            x = point[..., :1] - start[..., 0]
            z = point[..., 1:] - start[..., 1]
            left = edge[..., 0] * z - edge[..., 1] * x
            height = point[..., 1:]
            crossed = (low <= height) != (high <= height)
            turn = crossed & ((left > 0) == (high > low))
            signs = torch.where(high > low, 1, -1)
            inside[part] = (turn * signs).sum(-1) != 0
            along = (x * unit[..., 0]).addcmul_(z, unit[..., 1]).clamp_(0, 1)
            x.addcmul_(along, edge[..., 0], value=-1)
            z.addcmul_(along, edge[..., 1], value=-1)
            nearest[part] = x.square_().addcmul_(z, z).argmin(-1)
    return nearest, inside
