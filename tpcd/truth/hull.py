"""The few hull vertices through which an outline touches half-planes.

A half-plane touches a closed outline only at its convex hull, so floor and wall never see
the rest. Vertices whose removal moves the hull by less than a tolerance are dropped.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def hull_vertices(
    vertices: Float[np.ndarray, "p 2"], tolerance: float = 2e-5
) -> Float[np.ndarray, "h 2"]:
    """Vertices of the convex hull, counter-clockwise, thinned to a tolerance [m].

    The hull of the answer lies inside the full hull and nowhere further from it than
    `tolerance`. Convex hull by Andrew's monotone chain (1979). Raises `ValueError` for
    points without area.
    """
    points = np.unique(np.asarray(vertices, dtype=np.float64), axis=0)
    hull = np.array(_chain(points)[:-1] + _chain(points[::-1])[:-1])
    if len(hull) < 3:
        raise ValueError("the outline has no area: its points lie on one line")
    return hull[_keep(hull, tolerance)] if tolerance > 0 else hull


def _chain(points: np.ndarray) -> list[np.ndarray]:
    chain: list[np.ndarray] = []
    for point in points:
        while len(chain) > 1 and _cross(chain[-1] - chain[-2], point - chain[-2]) <= 0:
            chain.pop()
        chain.append(point)
    return chain


def _keep(hull: np.ndarray, tolerance: float) -> list[int]:
    """Indices to keep: from each kept vertex jump as far as the chord stays near the hull."""
    count = len(hull)
    start = int(np.argmax(hull[:, 0]))
    kept, position = [start], 0
    while True:
        reach = position + 1
        while reach < count and _deviation(hull, start, position, reach + 1) <= tolerance:
            reach += 1
        if reach >= count:
            break
        position = reach
        kept.append((start + position) % count)
    return kept if len(kept) > 2 else list(range(count))


def _deviation(hull: np.ndarray, start: int, first: int, last: int) -> float:
    """Largest distance from the hull vertices between two of them to their chord [m]."""
    count = len(hull)
    a, b = hull[(start + first) % count], hull[(start + last) % count]
    between = hull[(start + np.arange(first + 1, last)) % count]
    length = float(np.hypot(*(b - a)))
    if length == 0.0:
        return np.inf
    offsets = between - a
    return float(np.abs((b - a)[0] * offsets[:, 1] - (b - a)[1] * offsets[:, 0]).max() / length)


def _cross(first: np.ndarray, second: np.ndarray) -> float:
    return float(first[0] * second[1] - first[1] * second[0])
