"""Planar outlines: one simple closed polygon in the object frame.

An `Outline` holds the vertices of a simple polygon in metres, counter-clockwise, closed
implicitly (the first vertex is not repeated), with the origin at the area centroid unless
it was made with `recentre=False`. Everything that enters the project as an outline passes
through `make_outline`, so whoever holds an `Outline` can rely on that. Signed distances
are positive outside, computed by shapely; the torch counterpart is `polygon.PolygonShape`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float, Float64
from numpy.typing import ArrayLike

from tpcd.errors import OutlineError

SMALLEST_SIZE = 0.005
"""Smallest plausible longer side of the bounding box [m]."""
LARGEST_SIZE = 1.0
"""Largest plausible longer side of the bounding box [m]."""
SMALLEST_EDGE = 1e-8
"""Vertices nearer than this to their predecessor count as the same vertex [m]."""
LIKELY_MILLIMETRES = 30.0
"""A size from which numbers that are no metres are likely millimetres."""
METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Units of length a file with outlines can be in."""
LARGEST_CORNER_REACH = 0.01
"""`resample` spreads the turning of a corner over at most this share of the perimeter on
each side, so that two points never coincide."""


@dataclass(frozen=True, eq=False)
class Outline:
    """A simple polygon, counter-clockwise, in the object frame. Make it by `make_outline`."""

    name: str
    """What the object is called in tables and file names."""
    vertices: Float64[np.ndarray, "n 2"]
    """Vertices (x, z) [m], read-only, counter-clockwise, first vertex not repeated."""
    source: str = ""
    """Where the shape comes from: a file, or the publication of its dimensions."""
    notes: str = ""
    """Anything a user should know about it."""

    @property
    def polygon(self) -> shapely.Polygon:
        """The same curve as a shapely polygon."""
        return shapely.Polygon(self.vertices)

    @property
    def area(self) -> float:
        """Enclosed area [m^2]."""
        return float(self.polygon.area)

    @property
    def perimeter(self) -> float:
        """Length of the boundary [m]."""
        return float(np.linalg.norm(_edges(self.vertices), axis=1).sum())

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the bounding box [m]."""
        width, height = np.ptp(self.vertices, axis=0)
        return float(width), float(height)


def make_outline(
    name: str,
    vertices: ArrayLike,
    *,
    recentre: bool = True,
    path: str | Path | None = None,
    source: str = "",
    notes: str = "",
) -> Outline:
    """Check the vertices (n, 2) [m] of a polygon and make an `Outline` of them.

    Repeated vertices are dropped, the order becomes counter-clockwise, and the origin moves
    to the area centroid unless `recentre` is False. `path` is the file to blame in errors.

    Raises:
        OutlineError: not (n, 2) numbers, NaN, fewer than three distinct vertices, a curve
            that crosses or touches itself (with the place), no area, a longer side outside
            `SMALLEST_SIZE` .. `LARGEST_SIZE` (with a hint when it looks like mm).
    """
    blame = path if path is not None else f"outline '{name}'"
    where = f"outline '{name}' " if path is not None else ""
    points = _finite_points(vertices, blame, where)
    _check_once_round(points, blame, where)
    points = _without_repeats(points)
    if len(points) < 3:
        raise OutlineError(
            blame,
            f"{where}has {len(points)} distinct vertices",
            "a closed curve needs at least 3",
        )
    _check_size(points, blame, where)
    polygon = shapely.Polygon(points)
    if polygon.convex_hull.area < 1e-6 * float(np.ptp(points, axis=0).max()) ** 2:
        raise OutlineError(blame, f"{where}encloses no area", "give a closed curve, not a line")
    _check_simple(polygon, blame, where)
    if not shapely.is_ccw(polygon.exterior):
        points = points[::-1]
    if recentre:
        points = points - np.array(polygon.centroid.coords[0])
    points = np.ascontiguousarray(points)
    points.setflags(write=False)
    return Outline(name=name, vertices=points, source=source, notes=notes)


def signed_distance(
    outline: Outline, points: Float[np.ndarray, "points 2"]
) -> Float64[np.ndarray, " points"]:
    """Signed distance of points in the object frame to the outline [m], positive outside."""
    polygon = outline.polygon
    shapely.prepare(polygon)
    distance = shapely.distance(polygon.exterior, shapely.points(points))
    inside = shapely.contains_xy(polygon, points[:, 0], points[:, 1])
    return np.where(inside, -distance, distance)


def hull(outline: Outline) -> Float64[np.ndarray, "h 2"]:
    """Vertices of the convex hull [m], counter-clockwise; exact vertices of the outline.

    A half-plane touches an outline only at these.
    """
    ring = shapely.get_exterior_ring(shapely.convex_hull(outline.polygon))
    points = shapely.get_coordinates(ring)[:-1]
    return points if shapely.is_ccw(ring) else points[::-1].copy()


def support(
    outline: Outline, directions: Float[np.ndarray, "directions 2"]
) -> Float64[np.ndarray, " directions"]:
    """Support function `h(d) = max over the outline of d . p` [m for unit directions]."""
    return (directions @ hull(outline).T).max(axis=1)


def resample(
    outline: Outline, count: int, turning_weight: float = 0.5
) -> Float64[np.ndarray, "count 2"]:
    """Points on the polygon, evenly spaced in a blend of arc length and turning angle [m].

    The measure of a stretch of boundary is `(1 - w) length / perimeter + w |turning| /
    total |turning|`, with the turning of each vertex spread over the nearer halves of its
    two edges (at most `LARGEST_CORNER_REACH` of the perimeter each), so that corners get
    dense points which never coincide. Counter-clockwise; the first point is vertex 0.
    """
    if count < 3:
        raise ValueError(f"count must be at least 3, got {count}")
    if not 0.0 <= turning_weight <= 1.0:
        raise ValueError(f"turning_weight must lie in [0, 1], got {turning_weight}")
    return points_at(outline, resample_positions(outline, count, turning_weight))


def resample_positions(
    outline: Outline, count: int, turning_weight: float
) -> Float64[np.ndarray, " count"]:
    """Arc-length positions of the points of `resample`, increasing from 0 [m]."""
    lengths = np.linalg.norm(_edges(outline.vertices), axis=1)
    perimeter = lengths.sum()
    half_turning = np.abs(turning_angles(outline)) / 2
    reach = np.minimum(lengths / 2, LARGEST_CORNER_REACH * perimeter)
    # Three stretches of every edge: the end of one corner, straight, the start of the next.
    stretch_lengths = np.stack((reach, lengths - 2 * reach, reach), axis=1).ravel()
    stretch_turning = np.stack(
        (half_turning, np.zeros_like(lengths), np.roll(half_turning, -1)), axis=1
    ).ravel()
    measure = (1 - turning_weight) * stretch_lengths / perimeter
    measure += turning_weight * stretch_turning / stretch_turning.sum()
    positions = np.concatenate(([0.0], np.cumsum(stretch_lengths)))
    levels = np.concatenate(([0.0], np.cumsum(measure)))
    return np.interp(np.arange(count) / count, levels, positions)


def points_at(
    outline: Outline, positions: Float[np.ndarray, " count"]
) -> Float64[np.ndarray, "count 2"]:
    """Points of the boundary at arc-length positions from vertex 0 [m]."""
    closed = np.vstack((outline.vertices, outline.vertices[:1]))
    ends = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    wrapped = np.mod(positions, ends[-1])
    return np.stack([np.interp(wrapped, ends, closed[:, axis]) for axis in (0, 1)], axis=1)


def turning_angles(outline: Outline) -> Float64[np.ndarray, " n"]:
    """Exterior angle at each vertex [rad]: positive where convex; they sum to 2 pi."""
    after = _edges(outline.vertices)
    before = np.roll(after, 1, axis=0)
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.arctan2(cross, (before * after).sum(axis=1))


def _edges(vertices: np.ndarray) -> np.ndarray:
    return np.roll(vertices, -1, axis=0) - vertices


def _finite_points(vertices: object, blame: str | Path, where: str) -> np.ndarray:
    try:
        points = np.array(vertices, dtype=np.float64)
    except (TypeError, ValueError):
        raise OutlineError(
            blame, f"{where}holds something that is not a number", "give (n, 2) numbers in metres"
        ) from None
    if points.ndim != 2 or points.shape[1] != 2:
        raise OutlineError(blame, f"{where}has shape {points.shape}", "expected (n, 2)")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise OutlineError(
            blame,
            f"{where}vertex {bad[0]} is {tuple(points[bad[0]].tolist())}",
            "every coordinate must be finite",
        )
    return points


def _check_once_round(points: np.ndarray, blame: str | Path, where: str) -> None:
    """Refuse vertices that go on after the first one has come again: another outline, a hole."""
    away = np.abs(points - points[:1]).max(axis=1) > SMALLEST_EDGE
    left = np.flatnonzero(away)
    back = np.flatnonzero(~away)
    back = back[back > max(2, left[0])] if len(left) else left
    if len(back) and back[0] < left[-1]:
        closed = f"{where}is closed by vertex {back[0]}, and {len(points) - 1 - back[0]} follow"
        raise OutlineError(blame, closed, "give one simple closed curve")


def _without_repeats(points: np.ndarray) -> np.ndarray:
    if not len(points):
        return points
    step = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    kept = points[step > SMALLEST_EDGE]
    return kept if len(kept) else points[:1]


def _check_size(points: np.ndarray, blame: str | Path, where: str) -> None:
    size = float(np.ptp(points, axis=0).max())
    if SMALLEST_SIZE <= size <= LARGEST_SIZE:
        return
    limits = f"expected {SMALLEST_SIZE:g} to {LARGEST_SIZE:g} m"
    fitting = [
        f"{size * factor:.2g} m in {unit}"
        for unit, factor in METRES_PER_UNIT.items()
        if SMALLEST_SIZE <= size * factor <= LARGEST_SIZE
    ]
    if size > LIKELY_MILLIMETRES and fitting:
        limits += ", this looks like millimetres: give metres, or the unit mm"
    elif size > LARGEST_SIZE and fitting:
        limits += f", it would be {', '.join(fitting)}: give metres, or the unit"
    raise OutlineError(blame, f"{where}is {size:.4g} m long", limits)


def _check_simple(polygon: shapely.Polygon, blame: str | Path, where: str) -> None:
    if polygon.is_valid:
        return
    reason = shapely.is_valid_reason(polygon)
    place = re.search(r"\[(\S+) (\S+)\]", reason)
    at = f" at ({float(place[1]):.5g}, {float(place[2]):.5g}) m" if place else f" ({reason})"
    raise OutlineError(
        blame, f"{where}crosses or touches itself{at}", "give one simple closed curve"
    )
