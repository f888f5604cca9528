"""Which outline points can touch: the nearest one to a surface, and the first touch on a way.

A half-plane touches an outline only at its hull, and over the few angles that the steps of
one scene pass through only at a short piece of it. `build_chains` finds that piece once for
each scene and terrain, rigorously and for points in any order; the many questions for the
lowest point then look at a handful of points. Directions outside of the piece fall back to
all points, so the answers are exact always.

A surface that leaves its plane keeps all points that may come below by as much as it does.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.geometry.query import bent, plane_of, query, spread
from tpcd.geometry.surfaces import HalfPlanes, SurfaceTable
from tpcd.loops import inner

FREE_GAP = 1e-5
"""A start pose flies when every gap exceeds this [m]."""
TOUCH_ROUNDS = 20
"""Cap on the points that the search for the first touch may try; it mostly needs two."""
ADVANCES, TOUCHED = 1000, 1e-9
"""Most steps of conservative advancement, and the gap at which it has arrived [m]."""
WIDEST = 1.2
"""Largest half angle for which a chain is built [rad]; wider turns look at all points."""


class World(NamedTuple):
    """Objects and what they meet: outlines `points` (s, 2, p) in the end-effector frame [m], a
    table of surfaces, and `friction` and `compliance` [m/N] (s, t) of each.

    Of one element, `where` (1) says which of the table's environments it meets, and `clearance`
    (1, t) how much further away its surfaces are [m].
    """

    points: np.ndarray
    surfaces: HalfPlanes | SurfaceTable
    where: np.ndarray
    clearance: np.ndarray
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
    """The normal of terrain t's plane as the object sees it, turned by the angle of cosine and
    sine."""
    nx, nz, _ = plane_of(world.surfaces, world.where[0], t)
    return cosine * nx + sine * nz, cosine * nz - sine * nx


@inner(forceinline=True)
@no_type_check
def frame(world, o, t, x, z, pose, turn):
    """Contact of the object's point (x, z) [m] with surface t at a pose, turned by `turn` (cos,
    sin): gap, normal, height over the end effector along it, lever along its tangent, curvature."""
    ax, az = turn[0] * x - turn[1] * z, turn[1] * x + turn[0] * z
    gap, nx, nz, bend = query(world.surfaces, world.where[0], t, pose[0] + ax, pose[1] + az)
    return gap + world.clearance[o, t], nx, nz, nx * ax + nz * az, nz * ax - nx * az, bend


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
    for t in range(world.friction.shape[1]):
        a, b = object_normal(world, o, t, cosine, sine)
        chains.centre[t, 0], chains.centre[t, 1], chains.slope[t] = a, b, slope
        height, lever, index = chains.height, chains.lever, chains.index
        lowest = _coordinates(world.points, o, a, b, height, lever, t)
        best = 0
        while height[t, best] > lowest:
            best += 1
        foot = lever[t, best]
        # Only these can come below the lowest point within the half angle.
        kept, leaves = 0, spread(world.surfaces, world.where[0], t)
        for i in range(count):
            up, side = height[t, i], lever[t, i]
            if up - lowest <= slope * abs(side - foot) + leaves:
                # Sort by lever as they come; counter-clockwise outlines are nearly sorted.
                k = kept
                while k > 0 and lever[t, k - 1] > side:
                    height[t, k], lever[t, k] = height[t, k - 1], lever[t, k - 1]
                    index[t, k] = index[t, k - 1]
                    k -= 1
                height[t, k], lever[t, k], index[t, k] = up, side, i
                kept += 1
        chains.size[t] = kept if leaves > 0.0 else _lower_hull(height, lever, index, t, kept)


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
def nearest(world, o, chains, t, pose, turn):
    """Least gap of the outline to surface t at a pose [m], and the point that has it."""
    u, v = object_normal(world, o, t, turn[0], turn[1])
    if not spread(world.surfaces, world.where[0], t) > 0.0:
        low, point = lowest_point(world, o, chains, t, u, v)
        gap, _, _, _ = query(world.surfaces, world.where[0], t, pose[0], pose[1])
        return low + gap + world.clearance[o, t], point
    a, b = chains.centre[t, 0], chains.centre[t, 1]
    inside = abs(b * u - a * v) <= chains.slope[t] * (a * u + b * v)
    least, best = np.inf, 0
    for k in range(chains.size[t] if inside else world.points.shape[2]):
        i = chains.index[t, k] if inside else k
        gap, _, _, _, _, _ = frame(
            world, o, t, world.points[o, 0, i], world.points[o, 1, i], pose, turn
        )
        if gap < least:
            least, best = gap, i
    return least, best


@inner
@no_type_check
def lowest_gap(world, o, chains, x, z, angle):
    """Smallest gap over all terrains at a pose, with its point and terrain."""
    turn = (math.cos(angle), math.sin(angle))
    best, best_point, best_terrain = np.inf, 0, 0
    for t in range(world.friction.shape[1]):
        gap, point = nearest(world, o, chains, t, (x, z), turn)
        if gap < best:
            best, best_point, best_terrain = gap, point, t
    return best, best_point, best_terrain


@inner
@no_type_check
def touching(world, o, chains, pose):
    """Bit mask of the terrains within `FREE_GAP` of the object."""
    turn = (math.cos(pose[2]), math.sin(pose[2]))
    mask = 0
    for t in range(world.friction.shape[1]):
        gap, _ = nearest(world, o, chains, t, (pose[0], pose[1]), turn)
        if gap <= FREE_GAP:
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
    if bent(world.surfaces):
        return _advance(world, o, chains, start, command, gap_start)
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
def _advance(world, o, chains, start, command, gap):
    """The same where surfaces are curved, and what is free at the command may be on the way: by
    conservative advancement (Mirtich 1996), which never goes further than the least gap allows.
    That is known to first order, of which half is taken."""
    reach = 0.0
    for i in range(world.points.shape[2]):
        reach = max(reach, world.points[o, 0, i] ** 2 + world.points[o, 1, i] ** 2)
    way = math.hypot(command[0] - start[0], command[1] - start[1])
    way += math.sqrt(reach) * abs(command[2] - start[2])
    done, point, terrain = 0.0, 0, 0
    for _ in range(ADVANCES):
        done += 0.5 * gap / way if 0.5 * gap < way else 1.0
        if done >= 1.0:
            return 1.0, point, terrain
        gap, point, terrain = lowest_gap(
            world, o, chains, start[0] + done * (command[0] - start[0]),
            start[1] + done * (command[1] - start[1]), start[2] + done * (command[2] - start[2]),
        )  # fmt: skip
        if gap <= TOUCHED:
            break
    return done, point, terrain


@inner
@no_type_check
def _touch_of_point(world, o, t, i, start, command, high, gap_high):
    """Fraction of the way, below `high`, at which point i comes to terrain t.

    Newton's method on its gap, which is free at the start and below zero at `high`, kept
    in the bracket by bisection.
    """
    x, z = world.points[o, 0, i], world.points[o, 1, i]
    turn = command[2] - start[2]
    low, trial, gap = 0.0, high, gap_high
    for _ in range(60):
        angle = start[2] + trial * turn
        here = (
            start[0] + trial * (command[0] - start[0]),
            start[1] + trial * (command[1] - start[1]),
        )
        gap, nx, nz, _, lever, _ = frame(
            world, o, t, x, z, here, (math.cos(angle), math.sin(angle))
        )
        if abs(gap) <= 1e-16:
            break
        if gap > 0.0:
            low = trial
        else:
            high = trial
        rate = nx * (command[0] - start[0]) + nz * (command[1] - start[1]) + turn * lever
        newton = trial - gap / rate if rate < 0.0 else -1.0
        if not (newton > low and newton < high):
            newton = 0.5 * (low + high)
        if abs(newton - trial) <= 1e-15:
            trial = newton
            break
        trial = newton
    return trial
