"""Geometry of the quasi-static step: which outline point is lowest over a half-plane.

A half-plane touches an outline only at its hull, and over the few angles that the steps of
one scene pass through only at a short piece of it. `build_chains` finds that piece once for
each scene and terrain, rigorously and for points in any order; the many questions for the
lowest point then look at a handful of points. Directions outside of the piece fall back to
all points, so the answers are exact always.

Arrays of the flat batch of scenes: `points` (s, 2, p) outline in the end-effector frame,
`normals` (s, t, 2), `offsets`, `friction` and `compliance` (s, t).
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.loops import inner

FREE_GAP = 1e-5
"""A start pose flies when every gap exceeds this [m]."""
TOUCH_ROUNDS = 20
"""Cap on the points that the search for the first touch may try; it mostly needs two."""
WIDEST = 1.2
"""Largest half angle for which a chain is built [rad]; wider turns look at all points."""


class World(NamedTuple):
    """All scenes of the batch, as in the file's opening."""

    points: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    friction: np.ndarray
    compliance: np.ndarray


class Chains(NamedTuple):
    """Hull pieces of one scene, one for each terrain, in the frame of the middle direction.

    `centre` (t, 2) is the terrain's normal in the object frame at the middle angle, `slope`
    (t) the tangent of the half angle, `size` (t) the number of points kept; `height`,
    `lever`, `index` (t, p) their coordinates along and across the centre, and who they are.
    """

    centre: np.ndarray
    slope: np.ndarray
    size: np.ndarray
    height: np.ndarray
    lever: np.ndarray
    index: np.ndarray


@inner(_nrt=True)
@no_type_check
def new_chains(terrains, count):
    """Room for the chains of scenes of `count` points."""
    return Chains(
        np.empty((terrains, 2)),
        np.empty(terrains),
        np.zeros(terrains, np.int64),
        np.empty((terrains, count)),
        np.empty((terrains, count)),
        np.zeros((terrains, count), np.int64),
    )


@inner
@no_type_check
def object_normal(world, o, t, cosine, sine):
    """The normal of terrain t as the object sees it, turned by the angle of cosine and sine."""
    nx, nz = world.normals[o, t, 0], world.normals[o, t, 1]
    return cosine * nx + sine * nz, cosine * nz - sine * nx


@inner(fastmath={"nsz", "contract", "nnan"})
@no_type_check
def _coordinates(points, o, a, b, height, lever, t):
    """Coordinates of all points along (a, b) and across; returns the least height."""
    lowest = np.inf
    for i in range(points.shape[2]):
        x, z = points[o, 0, i], points[o, 1, i]
        value = a * x + b * z
        height[t, i] = value
        lever[t, i] = b * x - a * z
        lowest = min(lowest, value)
    return lowest


@inner
@no_type_check
def build_chains(world, o, low, high, margin, chains):
    """Find the hull pieces of scene o for object angles from `low` to `high` [rad].

    `margin` widens the piece; directions may lean by it beyond the angles.
    """
    half = min(0.5 * (high - low) + margin, WIDEST)
    cosine, sine = math.cos(0.5 * (low + high)), math.sin(0.5 * (low + high))
    slope = math.tan(half)
    count = world.points.shape[2]
    for t in range(world.normals.shape[1]):
        a, b = object_normal(world, o, t, cosine, sine)
        chains.centre[t, 0], chains.centre[t, 1], chains.slope[t] = a, b, slope
        height, lever, index = chains.height, chains.lever, chains.index
        lowest = _coordinates(world.points, o, a, b, height, lever, t)
        best = 0
        while height[t, best] > lowest:
            best += 1
        foot = lever[t, best]
        # Only these can come below the lowest point within the half angle.
        kept = 0
        for i in range(count):
            up, side = height[t, i], lever[t, i]
            if up - lowest <= slope * abs(side - foot):
                # Sort by lever as they come; counter-clockwise outlines are nearly sorted.
                k = kept
                while k > 0 and lever[t, k - 1] > side:
                    height[t, k], lever[t, k] = height[t, k - 1], lever[t, k - 1]
                    index[t, k] = index[t, k - 1]
                    k -= 1
                height[t, k], lever[t, k], index[t, k] = up, side, i
                kept += 1
        chains.size[t] = _lower_hull(height, lever, index, t, kept)


@inner
@no_type_check
def _lower_hull(height, lever, index, t, kept):
    """Keep the corners of the lower hull of points sorted by lever (Andrew 1979)."""
    size = 0
    for i in range(kept):
        up, side, who = height[t, i], lever[t, i], index[t, i]
        while size > 0 and lever[t, size - 1] == side and height[t, size - 1] >= up:
            size -= 1
        if size > 0 and lever[t, size - 1] == side:
            continue
        while size > 1:
            run, rise = (
                lever[t, size - 1] - lever[t, size - 2],
                height[t, size - 1] - height[t, size - 2],
            )
            if run * (up - height[t, size - 2]) - rise * (side - lever[t, size - 2]) > 0.0:
                break
            size -= 1
        height[t, size], lever[t, size], index[t, size] = up, side, who
        size += 1
    return size


@inner
@no_type_check
def lowest_point(world, o, chains, t, u, v):
    """Least of u x + v z over the outline, and the point that has it."""
    a, b = chains.centre[t, 0], chains.centre[t, 1]
    along, across = a * u + b * v, b * u - a * v
    lowest, best = np.inf, 0
    if abs(across) <= chains.slope[t] * along:
        for k in range(chains.size[t]):
            value = along * chains.height[t, k] + across * chains.lever[t, k]
            if value < lowest:
                lowest, best = value, k
        return lowest, chains.index[t, best]
    for i in range(world.points.shape[2]):
        value = u * world.points[o, 0, i] + v * world.points[o, 1, i]
        if value < lowest:
            lowest, best = value, i
    return lowest, best


@inner
@no_type_check
def lowest_gap(world, o, chains, x, z, angle):
    """Smallest gap over all terrains at a pose, with its point and terrain."""
    cosine, sine = math.cos(angle), math.sin(angle)
    best, best_point, best_terrain = np.inf, 0, 0
    for t in range(world.normals.shape[1]):
        u, v = object_normal(world, o, t, cosine, sine)
        low, point = lowest_point(world, o, chains, t, u, v)
        gap = low + world.normals[o, t, 0] * x + world.normals[o, t, 1] * z - world.offsets[o, t]
        if gap < best:
            best, best_point, best_terrain = gap, point, t
    return best, best_point, best_terrain


@inner
@no_type_check
def touching(world, o, chains, pose):
    """Bit mask of the terrains within `FREE_GAP` of the object."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    mask = 0
    for t in range(world.normals.shape[1]):
        u, v = object_normal(world, o, t, cosine, sine)
        low, _ = lowest_point(world, o, chains, t, u, v)
        nx, nz = world.normals[o, t, 0], world.normals[o, t, 1]
        if low + nx * pose[0] + nz * pose[1] - world.offsets[o, t] <= FREE_GAP:
            mask |= 1 << t
    return mask


@inner
@no_type_check
def first_touch(world, o, chains, start, command):
    """Free fraction of the way from start to command, with the touching point and terrain.

    Backwards from the command: the lowest point there is followed to where it touches, then
    whoever is lower at that place, until nobody is.
    """
    gap_start, point, terrain = lowest_gap(world, o, chains, start[0], start[1], start[2])
    if gap_start <= FREE_GAP:
        return 0.0, point, terrain
    gap, point, terrain = lowest_gap(world, o, chains, command[0], command[1], command[2])
    if gap >= 0.0:
        return 1.0, point, terrain
    high = 1.0
    for _ in range(TOUCH_ROUNDS):
        high = _touch_of_point(world, o, terrain, point, start, command, high, gap)
        gap, next_point, next_terrain = lowest_gap(
            world,
            o,
            chains,
            start[0] + high * (command[0] - start[0]),
            start[1] + high * (command[1] - start[1]),
            start[2] + high * (command[2] - start[2]),
        )
        if gap >= -1e-12:
            break
        point, terrain = next_point, next_terrain
    return high, point, terrain


@inner
@no_type_check
def _touch_of_point(world, o, t, i, start, command, high, gap_high):
    """Fraction of the way, below `high`, at which point i comes to terrain t.

    Newton's method on its gap, which is free at the start and below zero at `high`, kept
    in the bracket by bisection.
    """
    nx, nz = world.normals[o, t, 0], world.normals[o, t, 1]
    x, z = world.points[o, 0, i], world.points[o, 1, i]
    way = nx * (command[0] - start[0]) + nz * (command[1] - start[1])
    base = nx * start[0] + nz * start[1] - world.offsets[o, t]
    turn = command[2] - start[2]
    low, trial, gap = 0.0, high, gap_high
    for _ in range(60):
        angle = start[2] + trial * turn
        cosine, sine = math.cos(angle), math.sin(angle)
        u, v = cosine * nx + sine * nz, cosine * nz - sine * nx
        gap = base + trial * way + u * x + v * z
        if abs(gap) <= 1e-16:
            break
        if gap > 0.0:
            low = trial
        else:
            high = trial
        rate = way + turn * (v * x - u * z)
        newton = trial - gap / rate if rate < 0.0 else -1.0
        if not (newton > low and newton < high):
            newton = 0.5 * (low + high)
        if abs(newton - trial) <= 1e-15:
            trial = newton
            break
        trial = newton
    return trial
