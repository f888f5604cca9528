"""Where on the path contact is expected to change next, and passing on to there.

As long as contact stays as it is, the loads of its rows and the gaps of the other terrains change
in proportion to the path, to first order. Contact changes where the first of them comes to zero:
a contact is lost, comes to the edge of its friction cone, or another terrain is touched. Locating
such changes and starting anew there is the event-driven scheme for nonsmooth systems (Acary and
Brogliato, "Numerical Methods for Nonsmooth Dynamical Systems", 2008).

An event is (which, point, inverse): the one of k rows whose load comes to zero, or k + t where the
point touches terrain t, and the inverse of the rate at which that load or gap falls.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from tpcd.geometry.candidates import frame, nearest
from tpcd.loops import inner
from tpcd.simulator.response import respond

SLOWEST = 1e-3
"""Share of a load or gap that must be lost on a whole path for its end to be foreseen."""
NOTHING = (-1, 0, 0.0)
"""No event."""


@inner(error_model="numpy")
@no_type_check
def next_event(world, o, chains, law, before, command, pose, space, rate):
    """Share of the path from `before` to `command` until contact changes, and the event.

    `linear_system` must be filled for the pose. Leaves the pose's rate of change in `rate`.
    """
    margins, k = space.margins, len(space.room)
    for j in range(k):
        space.right[j] = -space.system.violated[j]
    for a in range(3):
        space.force[a] = -space.system.unbalanced[a]
    respond(space)
    for j in range(k):
        margins[j] = space.multiplier[j] + space.gain[j]
        space.right[j] = 0.0
    for a in range(3):
        space.force[a] = law.stiffness[a] * (command[a] - before[a])
    respond(space)
    for a in range(3):
        rate[a] = space.change[a]
    ahead, which, point, inverse = np.inf, -1, 0, 0.0
    for j in range(k):
        margin, slope = max(margins[j], 0.0), space.gain[j]
        if space.chosen[j, 0] >= 0 and slope < -SLOWEST * margin and margin < -slope * ahead:
            ahead, which, inverse = -margin / slope, j, -1.0 / slope
    turn = (math.cos(pose[2]), math.sin(pose[2]))
    for t in range(world.friction.shape[1]):
        touched = False
        for j in range(k):
            touched = touched or space.chosen[j, 0] >= 0 and space.chosen[j, 1] == t
        if touched:
            continue
        gap, lowest = nearest(world, o, chains, t, (pose[0], pose[1]), turn)
        margin = max(gap, 0.0)
        _, nx, nz, _, across, _ = frame(
            world, o, t, world.points[o, 0, lowest], world.points[o, 1, lowest],
            (pose[0], pose[1]), turn,
        )  # fmt: skip
        slope = nx * rate[0] + nz * rate[1] + across * rate[2]
        if slope < -SLOWEST * margin and margin < -slope * ahead:
            ahead, which, point, inverse = -margin / slope, k + t, lowest, -1.0 / slope
    # What is not above zero, by rounding, changes here and now, whatever moves.
    return ahead, (which, point, inverse if ahead > 0.0 else 0.0)


@inner
@no_type_check
def respond_until(world, o, law, event, pose, space, slopes):
    """Turn the response of a settling into that of the pose at the event."""
    which, point, inverse = event
    response, by_terrain, system = slopes.response, slopes.by_terrain, space.system
    terrains, row, k = slopes.land_gap.shape[0], space.right, len(space.room)
    if which >= k:
        touch_row(world, o, which - k, point, pose, row)
    for c in range(3):
        by_start, by_command = 0.0, 0.0
        if which >= k:
            for a in range(3):
                by_start += row[a] * response[a, c]
                by_command += row[a] * response[3 + a, c]
        else:
            for i in range(k):
                share = system.inverse[which, i]
                by_start -= share * system.starts[i, c]
                by_command -= share * system.left[i, c] * law.stiffness[c]
        for a in range(3):
            response[a, c] += slopes.rate[a] * inverse * by_start
            response[3 + a, c] += slopes.rate[a] * inverse * by_command
    for t in range(terrains):
        by_gap, by_lever = 1.0 if t == which - k else 0.0, 0.0
        if which >= k:
            for a in range(3):
                by_gap += row[a] * by_terrain[t, a]
                by_lever += row[a] * by_terrain[terrains + t, a]
        else:
            for i in range(k):
                share = system.inverse[which, i]
                if space.chosen[i, 0] >= 0 and space.chosen[i, 1] == t:
                    by_gap -= share
                by_lever -= share * system.left[i, 2] * space.load[t]
        for a in range(3):
            by_terrain[t, a] += slopes.rate[a] * inverse * by_gap
            by_terrain[terrains + t, a] += slopes.rate[a] * inverse * by_lever


@inner
@no_type_check
def touch_row(world, o, t, point, pose, row):
    """How the gap of a point to terrain t moves with the pose."""
    _, row[0], row[1], _, row[2], _ = frame(
        world, o, t, world.points[o, 0, point], world.points[o, 1, point], (pose[0], pose[1]),
        (math.cos(pose[2]), math.sin(pose[2])),
    )  # fmt: skip
