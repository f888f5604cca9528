"""Whether polygons that a network decodes are one closed outline of plausible size.

A decoded polygon is one closed curve by construction; what it may be is crossed, turned over, or
of no plausible size.
"""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Bool, Float64

from tpcd.shape.levelset import LARGEST_SIZE, SMALLEST_SIZE

LARGEST_KNOT = 2e-3
"""A polygon that crosses itself is one outline where loops other than the largest hold less than
this share of the area. Smaller knots come with points that crowd at a concave corner and change
nothing; to refuse them all would drop good outlines with thin parts."""


def one_outline(polygons: Float64[np.ndarray, "m p 2"]) -> Bool[np.ndarray, " m"]:
    """Whether each polygon [m] runs counter-clockwise, is of plausible size and, but for small
    knots, does not cross itself. Polygons that are not finite are none."""
    after = np.roll(polygons, -1, axis=1)
    area = (polygons[..., 0] * after[..., 1] - polygons[..., 1] * after[..., 0]).sum(1)
    size = np.ptp(polygons, axis=1).max(-1)
    fine = (area > 0) & (size >= SMALLEST_SIZE) & (size <= LARGEST_SIZE)
    found = np.flatnonzero(fine)
    rings = shapely.polygons(polygons[found])
    for index in np.flatnonzero(~shapely.is_valid(rings)):
        fine[found[index]] = _knot_share(rings[index]) < LARGEST_KNOT
    return fine


def _knot_share(polygon: shapely.Polygon) -> float:
    """Share of the area that does not belong to the largest loop of a crossing polygon."""
    parts = shapely.get_parts(shapely.make_valid(polygon))
    areas = [piece.area for part in parts for piece in shapely.get_parts(part)]
    return 1.0 - max(areas) / sum(areas) if sum(areas) > 0 else 1.0
