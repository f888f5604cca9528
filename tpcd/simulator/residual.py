"""How far an answer is from rest, whatever found it, and whether a start pose can have been one.

At rest the object is inside no terrain, bears the load of what it touches alone, and the wrench
K (x' - u) is the sum of the contact forces. How far an answer is from that is told as a length:
what the forces do not balance by the way that the arm would still go for it, turns by the way of
the furthest point of the outline. The arm knows angles to half a turn: where the object is turned
further from its command, the spring pulls another way, and nothing rests.
"""

from __future__ import annotations

import math
from typing import no_type_check

from tpcd.geometry.candidates import nearest
from tpcd.loops import inner


@inner
@no_type_check
def depth_inside(world, o, chains, pose, load):
    """How deep the object is inside a terrain that yields to its `load` (t) [m]; at least 0."""
    turn, deepest = (math.cos(pose[2]), math.sin(pose[2])), 0.0
    for t in range(len(load)):
        deepest = max(deepest, -_gap(world, o, chains, t, pose, turn, load[t]))
    return deepest


@inner(error_model="numpy", forceinline=True)
@no_type_check
def distance_from_rest(world, o, chains, law, extent, command, pose, turn, space):
    """How far a settled pose, turned by `turn` (cos, sin), is from rest at a command [m].

    `linear_system` must be filled for the pose. Infinite where it is no number.
    """
    system, total = space.system, 0.0
    worst = extent * 2.0 * math.pi * abs(round((pose[2] - command[2]) / (2.0 * math.pi)))
    for a in range(3):
        off = abs(system.unbalanced[a]) / law.stiffness[a]
        off = off if a < 2 else off * extent
        worst, total = max(worst, off), total + off
    for t in range(world.friction.shape[1]):
        gap = _gap(world, o, chains, t, pose, turn, space.load[t])
        # What is pushed by convex friction may be away from the terrain.
        pushed = law.coulomb and space.load[t] > 0.0
        worst, total = max(worst, abs(gap) if pushed else -gap), total + gap
    return worst if math.isfinite(total) else math.inf


@inner
@no_type_check
def _gap(world, o, chains, t, pose, turn, load):
    """Gap to terrain t where it has yielded to a load [m]."""
    gap, _ = nearest(world, o, chains, t, (pose[0], pose[1]), turn)
    return gap + world.compliance[o, t] * load
