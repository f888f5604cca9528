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
    rings = np.asarray(shapely.polygons(polygons[found]))
    crossed = ~shapely.is_valid(rings)
    fine[found[crossed]] = _knot_share(rings[crossed]) < LARGEST_KNOT
    return fine


def _knot_share(polygons: np.ndarray) -> Float64[np.ndarray, " k"]:
    """Share of the area that does not belong to the largest loop of each crossing polygon."""
    # By its structure: ten times as fast as by its lines, and the same to 1e-4.
    parts, owner = shapely.get_parts(
        shapely.make_valid(polygons, method="structure"), return_index=True
    )
    area, count = shapely.area(parts), len(polygons)
    largest = np.zeros(count)
    np.maximum.at(largest, owner, area)
    whole = np.bincount(owner, area, count)
    return 1.0 - np.divide(largest, whole, out=np.zeros(count), where=whole > 0)
