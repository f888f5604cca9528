"""Drawing: the few strokes the household silhouettes are made of, in millimetres.

Everything returns one shapely polygon without holes, z up. Curves are drawn finer than
0.03 mm at household sizes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

Number = float | int
"""A coordinate or length [mm]."""
ARC_SEGMENTS = 32
"""Straight pieces per quarter of a circle: 0.03 mm from true at 50 mm radius."""
STATIONS = 24
"""Stations along a smooth ramp of a profile."""


def rounded(shape: Polygon, radius: Number) -> Polygon:
    """Round convex and concave corners with a radius [mm]; the outer boundary only.

    A morphological opening and closing. Where the opening would break a part thinner than
    two radii, the radius is halved until less than 3 % of the area is lost.

    Raises:
        ValueError: the shape is not one piece.
    """
    shape = outer(shape)
    for _ in range(5):
        smooth = shape.buffer(-radius, quad_segs=ARC_SEGMENTS // 2)
        smooth = smooth.buffer(2 * radius, quad_segs=ARC_SEGMENTS // 2)
        smooth = smooth.buffer(-radius, quad_segs=ARC_SEGMENTS // 2)
        if isinstance(smooth, Polygon) and smooth.area > 0.97 * shape.area:
            return outer(smooth)
        radius /= 2
    raise ValueError("the shape has parts too thin to round")


def union(*parts: BaseGeometry) -> Polygon:
    """Parts that touch or overlap, as one; `ValueError` where they do not hang together."""
    joined = shapely.union_all(list(parts))
    if not isinstance(joined, Polygon):
        raise ValueError("the parts do not hang together")
    return outer(joined)


def filleted(shape: Polygon, radius: Number) -> Polygon:
    """Fill concave corners with a radius [mm]; convex ones stay as they are."""
    filled = shape.buffer(radius, quad_segs=ARC_SEGMENTS)
    return outer(filled.buffer(-radius, quad_segs=ARC_SEGMENTS))


def rectangle(left: Number, bottom: Number, right: Number, top: Number) -> Polygon:
    """A rectangle with sides along the axes."""
    return shapely.box(left, bottom, right, top)


def oval(x: Number, z: Number, width: Number, height: Number) -> Polygon:
    """An ellipse about (x, z) with axes along x and z."""
    circle = shapely.Point(0, 0).buffer(0.5, quad_segs=ARC_SEGMENTS)
    return affinity.translate(affinity.scale(circle, width, height, origin=(0, 0)), x, z)


def revolved(stations: Sequence[tuple[Number, Number]]) -> Polygon:
    """The silhouette of a body of revolution: stations (radius, height) from the bottom up."""
    right = [(radius, height) for radius, height in stations]
    return Polygon([*right, *((-radius, height) for radius, height in reversed(right))])


def eased(
    low: Number, low_radius: Number, high: Number, high_radius: Number
) -> list[tuple[float, float]]:
    """Stations of a cosine ramp from one radius to another."""
    share = np.linspace(0, 1, STATIONS)
    radius = low_radius + (high_radius - low_radius) * (1 - np.cos(math.pi * share)) / 2
    return list(zip(radius.tolist(), (low + share * (high - low)).tolist(), strict=True))


def outer(shape: BaseGeometry) -> Polygon:
    """The shape without its holes; `ValueError` where it is not one piece."""
    if not isinstance(shape, Polygon) or shape.is_empty:
        raise ValueError("the shape is not one piece")
    return Polygon(shape.exterior)
