"""Makers of what hands work with: tools, cutlery, clamps, weights, locks.

Every maker draws one silhouette in millimetres from its dimensions, upright where the tool
hangs or stands, lying otherwise. Where its origin lies means nothing, `builtin` centres it.
Edges stay sharp here; `drawing.rounded` rounds them afterwards.
"""

from __future__ import annotations

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry import Polygon

from tpcd.shape.drawing import ARC_SEGMENTS, eased, filleted, oval, rectangle, revolved, union
from tpcd.shape.vessels import egg


def screwdriver(
    *, handle: float, handle_length: float, shaft: float, shaft_length: float
) -> Polygon:
    """Point down: a blade, then a handle with a waist where the fingers lie."""
    waist = [
        (0.6 * handle / 2, shaft_length),
        (0.9 * handle / 2, shaft_length + 0.1 * handle_length),
        *eased(
            shaft_length + 0.12 * handle_length,
            0.9 * handle / 2,
            shaft_length + 0.3 * handle_length,
            0.75 * handle / 2,
        ),
        *eased(
            shaft_length + 0.32 * handle_length,
            0.75 * handle / 2,
            shaft_length + 0.6 * handle_length,
            handle / 2,
        ),
        (handle / 2, shaft_length + 0.92 * handle_length),
        (0.7 * handle / 2, shaft_length + handle_length),
    ]
    return union(rectangle(-shaft / 2, 0, shaft / 2, shaft_length + 1), revolved(waist))


def hammer(
    *, length: float, handle: float, head_length: float, head_height: float, face: float
) -> Polygon:
    """A handle under a head: a square face on the left, a wedge on the right."""
    top = length - head_height
    grip = revolved([(0.6 * handle, 0), *eased(0, 0.6 * handle, 0.45 * length, 0.4 * handle)])
    grip = union(grip, rectangle(-0.4 * handle, 0.4 * length, 0.4 * handle, top + 1))
    left, right = -0.45 * head_length, 0.55 * head_length
    middle = top + head_height / 2
    head = Polygon(
        [
            (left, middle - face / 2),
            (0.6 * left, middle - face / 2),
            (-0.7 * handle, top),
            (0.7 * handle, top),
            (right, length - 0.35 * head_height),
            (right, length - 0.12 * head_height),
            (0.7 * handle, length),
            (-0.7 * handle, length),
            (0.6 * left, middle + face / 2),
            (left, middle + face / 2),
        ]
    )
    return union(grip, head)


def wrench(*, length: float, shank: float, head: float, ring: float, jaw: float) -> Polygon:
    """A combination spanner: open jaw on top, turned by 15 degrees, ring below (filled)."""
    top = length - head / 2
    opening = rectangle(-jaw / 2, -0.05 * head, jaw / 2, head)
    opening = affinity.rotate(opening, -15, origin=(0, 0))
    open_end = oval(0, top, head, head) - affinity.translate(opening, 0, top)
    bar = rectangle(-shank / 2, ring / 2, shank / 2, top - 0.25 * head)
    return filleted(union(open_end, bar, oval(0, ring / 2, ring, ring)), 4)


def spoon(
    *, length: float, bowl_length: float, bowl_width: float, neck: float, end: float
) -> Polygon:
    """Bowl down: an egg, a thin neck, a handle that widens to its end."""
    scoop = egg(width=bowl_width, height=bowl_length, blunt=0.4 * bowl_length)
    scoop = affinity.translate(scoop, 0, 0.4 * bowl_length)
    handle = revolved(
        [
            (neck / 2, 0.8 * bowl_length),
            *eased(bowl_length, neck / 2, length - end, 0.9 * end / 2),
            (end / 2, length - 0.8 * end),
            (end / 2, length - 0.3 * end),
            (end / 4, length),
        ]
    )
    return filleted(union(scoop, handle), 6)


def knife(*, length: float, blade: float, blade_length: float, handle: float) -> Polygon:
    """Point up: a straight-backed blade on a handle."""
    grip = length - blade_length
    edge = [(blade - t * t * 0.9 * blade, grip + t * blade_length) for t in np.linspace(0, 1, 16)]
    shape = Polygon([(0, grip), *edge[:-1], (0.1 * blade, length), (0, length)])
    return union(shape, rectangle(0, 0, handle, grip + 1))


def c_clamp(
    *, opening: float, throat: float, bar: float, screw: float, screw_length: float
) -> Polygon:
    """A C-shaped frame, open to the right, with a spindle from below and its pad."""
    height = opening + 2 * bar
    frame = rectangle(0, 0, throat + bar, height) - rectangle(
        bar, bar, throat + 2 * bar, height - bar
    )
    axis = throat + bar - 0.7 * bar
    spindle = rectangle(axis - screw / 2, -0.5 * screw_length, axis + screw / 2, 0.5 * screw_length)
    pad = rectangle(axis - screw, 0.5 * screw_length - 6, axis + screw, 0.5 * screw_length)
    grip = rectangle(
        axis - 2.5 * screw, -0.5 * screw_length - 7, axis + 2.5 * screw, -0.5 * screw_length
    )
    return union(frame, spindle, pad, grip)


def toothbrush(
    *, length: float, handle: float, neck: float, head: float, head_length: float
) -> Polygon:
    """Head up, seen from the side of the bristles."""
    handle_length = 0.55 * length
    return revolved(
        [
            (0.6 * handle / 2, 0),
            *eased(0, 0.7 * handle / 2, 0.25 * length, handle / 2),
            *eased(handle_length, handle / 2, 0.7 * length, neck / 2),
            *eased(length - 1.3 * head_length, neck / 2, length - 0.9 * head_length, head / 2),
            (head / 2, length - 0.15 * head_length),
            (head / 4, length),
        ]
    )


def saucepan(*, diameter: float, height: float, handle_length: float, handle: float) -> Polygon:
    """A pot from the side with one long handle near its rim."""
    pot = rectangle(-diameter / 2, 0, diameter / 2, height)
    grip = rectangle(diameter / 2 - 2, -handle, diameter / 2 + handle_length, 0)
    grip = affinity.rotate(grip, 8, origin=(diameter / 2, -handle))
    return union(pot, affinity.translate(grip, 0, height - 3))


def drill(
    *,
    body_length: float,
    body: float,
    chuck: float,
    chuck_length: float,
    grip: float,
    grip_length: float,
    battery: float,
    battery_height: float,
) -> Polygon:
    """A cordless drill pointing right: motor, chuck, slanted grip, battery."""
    motor = rectangle(-0.45 * body_length, -body / 2, 0.55 * body_length, body / 2)
    front = 0.55 * body_length
    jaws = Polygon(
        [
            (front - 1, -chuck / 2),
            (front + 0.6 * chuck_length, -chuck / 2),
            (front + chuck_length, -chuck / 4),
            (front + chuck_length, chuck / 4),
            (front + 0.6 * chuck_length, chuck / 2),
            (front - 1, chuck / 2),
        ]
    )
    low = -body / 2 - grip_length
    slant = 0.15 * grip_length
    handle = Polygon(
        [
            (-grip / 2, -body / 2 + 1),
            (-grip / 2 - slant, low),
            (grip / 2 - slant, low),
            (grip / 2, -body / 2 + 1),
        ]
    )
    pack = rectangle(-battery / 2 - slant, low - battery_height, battery / 2 - slant, low + 1)
    return filleted(union(motor, jaws, handle, pack), 4)


def dumbbell(*, length: float, head: float, head_length: float, grip: float) -> Polygon:
    """Two heads on a bar, lying."""
    head_length = min(head_length, 0.45 * length)
    bar = rectangle(-length / 2, -grip / 2, length / 2, grip / 2)
    left = rectangle(-length / 2, -head / 2, -length / 2 + head_length, head / 2)
    return union(bar, left, affinity.scale(left, -1, 1, origin=(0, 0)))


def bracket(*, width: float, height: float, thickness: float) -> Polygon:
    """A shelf bracket: an L of flat steel."""
    return union(rectangle(0, 0, width, thickness), rectangle(0, 0, thickness, height))


def pliers(*, length: float, jaw_length: float, width: float, arm: float, spread: float) -> Polygon:
    """Closed jaws up, two arms that spread by `spread` at their ends."""
    pivot = length - jaw_length
    jaws = revolved([(width / 2, pivot), (0.3 * width, length)])
    joint = oval(0, pivot, 1.25 * width, 1.25 * width)
    inner, outer = 0.1 * width, max(spread / 2, arm)
    side = [(inner, pivot), (0.8 * outer, 0.65 * pivot), (outer, 0.35 * pivot), (0.85 * outer, 0)]
    right = shapely.LineString(side).buffer(arm / 2, quad_segs=ARC_SEGMENTS)
    return filleted(union(jaws, joint, right, affinity.scale(right, -1, 1, origin=(0, 0))), 3)


def scissors(
    *, length: float, blade_length: float, blade: float, loop: float, loop_height: float
) -> Polygon:
    """Closed blades up, two finger loops below (filled)."""
    pivot = length - blade_length
    blades = Polygon([(-blade / 2, pivot - 10), (blade / 2, pivot - 10), (3, length), (-1, length)])
    loops = [
        affinity.rotate(oval(side * 0.52 * loop, loop_height / 2, loop, loop_height), side * 10)
        for side in (-1, 1)
    ]
    arms = Polygon([(-0.6 * loop, loop_height / 2), (0.6 * loop, loop_height / 2), (0, pivot + 15)])
    return filleted(union(blades, arms, *loops), 4)


def padlock(*, width: float, height: float, shackle: float, shackle_height: float) -> Polygon:
    """A square body under its shackle (filled)."""
    bow = oval(0, height + shackle_height - shackle / 2, shackle, shackle)
    post = rectangle(-shackle / 2, height - 1, shackle / 2, height + shackle_height - shackle / 2)
    return union(rectangle(-width / 2, 0, width / 2, height), bow, post)


def stapler(*, length: float, base: float, gap: float, arm: float) -> Polygon:
    """Base plate and arm, hinged on the left, mouth open to the right."""
    plate = rectangle(0, 0, length, base)
    upper = Polygon(
        [
            (0, base - 1),
            (length, base + gap),
            (length, base + gap + 0.7 * arm),
            (0.1 * length, base + arm),
            (0, base + 0.8 * arm),
        ]
    )
    return union(plate, upper)
