"""Makers: families of household silhouettes, each drawn from a few dimensions in mm.

Every maker returns one shapely polygon in millimetres, upright (z up) where the object has
an upright; the position of its origin means nothing, `builtin` centres it. Makers take all
their dimensions as arguments, so that scaling these makes variants of an object, and leave
edges sharp; `rounded` gives every outline its edge radius afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry import MultiPolygon, Polygon

ARC_SEGMENTS = 32
"""Straight pieces per quarter of a circle: 0.03 mm from true at 50 mm radius."""
SAMPLES = 24
"""Stations along a smooth profile."""


def rounded(shape: Polygon, radius: float) -> Polygon:
    """Round convex and concave corners with a radius [mm]; the outer boundary only.

    A morphological opening and closing. Where the opening would break a part thinner than
    two radii, the radius is halved until less than 3 % of the area is lost.

    Raises:
        ValueError: the shape is not one piece.
    """
    shape = _outer(shape)
    for _ in range(5):
        smooth = shape.buffer(-radius, quad_segs=ARC_SEGMENTS // 2)
        smooth = smooth.buffer(2 * radius, quad_segs=ARC_SEGMENTS // 2)
        smooth = smooth.buffer(-radius, quad_segs=ARC_SEGMENTS // 2)
        if isinstance(smooth, Polygon) and smooth.area > 0.97 * shape.area:
            return _outer(smooth)
        radius /= 2
    raise ValueError("the shape has parts too thin to round")


def box(*, width: float, height: float) -> Polygon:
    """A rectangle: cans, cartons, books seen from the side."""
    return _rectangle(-width / 2, 0, width / 2, height)


def card(*, width: float, height: float, corner: float) -> Polygon:
    """A rectangle with generous corners of a given radius: cards, phones, remote controls."""
    radius = min(corner, 0.49 * min(width, height))
    core = _rectangle(-width / 2 + radius, radius, width / 2 - radius, height - radius)
    return core.buffer(radius, quad_segs=ARC_SEGMENTS)


def ellipse(*, width: float, height: float) -> Polygon:
    """An ellipse; a disc where both are equal."""
    return _ellipse(0, 0, width, height)


def ball(*, diameter: float) -> Polygon:
    """A disc."""
    return _ellipse(0, 0, diameter, diameter)


def egg(*, width: float, height: float, blunt: float) -> Polygon:
    """Two half ellipses of one width; the blunt one is `blunt` high, below."""
    angle = np.linspace(0, 2 * math.pi, 4 * ARC_SEGMENTS, endpoint=False)
    vertical = np.where(np.sin(angle) > 0, max(height - blunt, 0.2 * height), blunt)
    return Polygon(np.stack((width / 2 * np.cos(angle), vertical * np.sin(angle)), 1))


def regular(*, across_flats: float, sides: int = 6) -> Polygon:
    """A regular polygon, flat at the bottom: nuts, pencils, stacking blocks."""
    angle = (np.arange(sides) + 0.5) * 2 * math.pi / sides - math.pi / 2
    radius = across_flats / 2 / math.cos(math.pi / sides)
    return Polygon(radius * np.stack((np.cos(angle), np.sin(angle)), 1))


def tapered(*, bottom: float, top: float, height: float) -> Polygon:
    """A trapezium: paper cups, flower pots, tumblers."""
    return _revolved([(bottom / 2, 0), (top / 2, height)])


def bottle(
    *, body: float, body_height: float, shoulder: float, neck: float, neck_height: float
) -> Polygon:
    """Body, smooth shoulder and neck of given diameters and heights."""
    neck = min(neck, body)
    top = body_height + shoulder
    return _revolved(
        [(body / 2, 0), *_ease(body_height, body / 2, top, neck / 2), (neck / 2, top + neck_height)]
    )


def capped_bottle(
    *,
    body: float,
    body_height: float,
    shoulder: float,
    neck: float,
    neck_height: float,
    cap: float,
    cap_height: float,
) -> Polygon:
    """A bottle or jar whose cap is wider or narrower than its neck."""
    vessel = bottle(
        body=body, body_height=body_height, shoulder=shoulder, neck=neck, neck_height=neck_height
    )
    top = body_height + shoulder + neck_height
    return _union(vessel, _rectangle(-cap / 2, top - 0.5, cap / 2, top + cap_height))


def spray_bottle(
    *,
    body: float,
    body_height: float,
    shoulder: float,
    neck: float,
    neck_height: float,
    head: float,
    head_height: float,
    nozzle: float,
    trigger: float,
) -> Polygon:
    """A bottle under a spray head that reaches `nozzle` beyond the neck, with a trigger."""
    vessel = bottle(
        body=body, body_height=body_height, shoulder=shoulder, neck=neck, neck_height=neck_height
    )
    top = body_height + shoulder + neck_height
    left, right = head / 2 - head, head / 2 + nozzle
    lever = Polygon(
        [
            (head / 2, top + 2),
            (head / 2 + 0.7 * nozzle, top + 2),
            (head / 2 + 0.5 * nozzle, top - trigger),
            (head / 2 + 0.5 * nozzle - 8, top - trigger),
        ]
    )
    return _union(vessel, _rectangle(left, top - 1, right, top + head_height), lever)


def mug(*, diameter: float, height: float, handle_reach: float, handle_height: float) -> Polygon:
    """A cylinder with an ear; the opening of the handle is filled."""
    ear = _ellipse(diameter / 2, height / 2, 2 * handle_reach, min(handle_height, height))
    return _union(_rectangle(-diameter / 2, 0, diameter / 2, height), ear)


def bowl(*, rim: float, foot: float, height: float, foot_height: float) -> Polygon:
    """A round bowl on a foot, its open top closed by a straight line."""
    foot = min(foot, 0.9 * rim)
    rise = np.linspace(0, 1, SAMPLES)
    radius = foot / 2 + (rim - foot) / 2 * np.sqrt(1 - (1 - rise) ** 2)
    side = list(zip(radius, foot_height + rise * (height - foot_height), strict=True))
    return _revolved([(0.96 * foot / 2, 0), *side])


def wine_glass(
    *, foot: float, stem: float, stem_height: float, bowl: float, bowl_height: float
) -> Polygon:
    """Foot plate, stem, and a bowl: an ellipse cut at 80 % of its height."""
    ellipse_height = bowl_height / 0.8
    top = stem_height + bowl_height
    cup = _ellipse(0, stem_height + ellipse_height / 2, bowl, ellipse_height)
    cup = cup & _rectangle(-bowl, 0, bowl, top)
    plate = _revolved([(foot / 2, 0), (foot / 2, 3), *_ease(3, foot / 2, 14, stem / 2)])
    column = _rectangle(-stem / 2, 1, stem / 2, stem_height + 5)
    return _filleted(_union(plate, column, cup), 6)


def light_bulb(*, globe: float, height: float, base: float, base_height: float) -> Polygon:
    """A globe that runs into a screw base at the bottom."""
    middle = max(height - globe / 2, base_height + globe / 4)
    neck = _revolved([*_ease(base_height, base / 2, middle, 0.97 * globe / 2)])
    cap = _revolved([(base / 5, 0), (base / 2, 0.25 * base_height), (base / 2, base_height + 0.5)])
    return _union(_ellipse(0, middle, globe, globe), neck, cap)


def gable_carton(*, width: float, height: float, gable: float, fin: float) -> Polygon:
    """A milk carton seen from the side of its roof, with the sealed fin on top."""
    roof = Polygon([(-width / 2, height), (width / 2, height), (0, height + gable)])
    body = _rectangle(-width / 2, 0, width / 2, height + 0.5)
    return _union(body, roof, _rectangle(-3, height, 3, height + gable + fin))


def squeeze_tube(
    *, crimp: float, shoulder: float, length: float, cap: float, cap_height: float
) -> Polygon:
    """A toothpaste tube standing on its cap."""
    return _revolved(
        [
            (cap / 2, 0),
            (cap / 2, cap_height),
            (shoulder / 2, cap_height + 8),
            (crimp / 2, cap_height + length),
        ]
    )


def screwdriver(
    *, handle: float, handle_length: float, shaft: float, shaft_length: float
) -> Polygon:
    """Point down: a blade, then a handle with a waist where the fingers lie."""
    waist = [
        (0.6 * handle / 2, shaft_length),
        (0.9 * handle / 2, shaft_length + 0.1 * handle_length),
        *_ease(
            shaft_length + 0.12 * handle_length,
            0.9 * handle / 2,
            shaft_length + 0.3 * handle_length,
            0.75 * handle / 2,
        ),
        *_ease(
            shaft_length + 0.32 * handle_length,
            0.75 * handle / 2,
            shaft_length + 0.6 * handle_length,
            handle / 2,
        ),
        (handle / 2, shaft_length + 0.92 * handle_length),
        (0.7 * handle / 2, shaft_length + handle_length),
    ]
    return _union(_rectangle(-shaft / 2, 0, shaft / 2, shaft_length + 1), _revolved(waist))


def hammer(
    *, length: float, handle: float, head_length: float, head_height: float, face: float
) -> Polygon:
    """A handle under a head: a square face on the left, a wedge on the right."""
    top = length - head_height
    grip = _revolved([(0.6 * handle, 0), *_ease(0, 0.6 * handle, 0.45 * length, 0.4 * handle)])
    grip = _union(grip, _rectangle(-0.4 * handle, 0.4 * length, 0.4 * handle, top + 1))
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
    return _union(grip, head)


def wrench(*, length: float, shank: float, head: float, ring: float, jaw: float) -> Polygon:
    """A combination spanner: open jaw on top, turned by 15 degrees, ring below (filled)."""
    top = length - head / 2
    opening = _rectangle(-jaw / 2, -0.05 * head, jaw / 2, head)
    opening = affinity.rotate(opening, -15, origin=(0, 0))
    open_end = _ellipse(0, top, head, head) - affinity.translate(opening, 0, top)
    bar = _rectangle(-shank / 2, ring / 2, shank / 2, top - 0.25 * head)
    return _filleted(_union(open_end, bar, _ellipse(0, ring / 2, ring, ring)), 4)


def spoon(
    *, length: float, bowl_length: float, bowl_width: float, neck: float, end: float
) -> Polygon:
    """Bowl down: an egg, a thin neck, a handle that widens to its end."""
    scoop = egg(width=bowl_width, height=bowl_length, blunt=0.4 * bowl_length)
    scoop = affinity.translate(scoop, 0, 0.4 * bowl_length)
    handle = _revolved(
        [
            (neck / 2, 0.8 * bowl_length),
            *_ease(bowl_length, neck / 2, length - end, 0.9 * end / 2),
            (end / 2, length - 0.8 * end),
            (end / 2, length - 0.3 * end),
            (end / 4, length),
        ]
    )
    return _filleted(_union(scoop, handle), 6)


def knife(*, length: float, blade: float, blade_length: float, handle: float) -> Polygon:
    """Point up: a straight-backed blade on a handle."""
    grip = length - blade_length
    edge = [(blade - t * t * 0.9 * blade, grip + t * blade_length) for t in np.linspace(0, 1, 16)]
    shape = Polygon([(0, grip), *edge[:-1], (0.1 * blade, length), (0, length)])
    return _union(shape, _rectangle(0, 0, handle, grip + 1))


def bent_fruit(*, length: float, thickness: float, bend: float, tip: float) -> Polygon:
    """A banana: an arc bent by `bend` degrees along its length, thick in the middle."""
    share = np.linspace(0, 1, 3 * SAMPLES)
    angle = math.radians(bend) * (share - 0.5)
    radius = length / math.radians(bend)
    half = (tip + (thickness - tip) * np.sin(math.pi * share) ** 0.6) / 2
    normal = np.stack((np.sin(angle), -np.cos(angle)), 1)
    centre = radius * normal
    return Polygon([*(centre + half[:, None] * normal), *(centre - half[:, None] * normal)[::-1]])


def pear(*, width: float, height: float, crown: float) -> Polygon:
    """A large ball below, a small one above, blended."""
    crown = min(crown, 0.8 * width)
    low = _ellipse(0, width / 2, width, width)
    high = _ellipse(0, height - crown / 2, crown, crown)
    waist = _revolved([(0.42 * width, 0.5 * width), (0.47 * crown, height - 0.5 * crown)])
    return _filleted(_union(low, high, waist), 0.5 * width)


def apple(*, width: float, height: float, dimple: float) -> Polygon:
    """A rounded heart: wider above the middle, with a dimple at the stalk."""
    angle = np.linspace(-math.pi / 2, 1.5 * math.pi, 6 * ARC_SEGMENTS, endpoint=False)
    x = width / 2 * np.cos(angle) * (1 + 0.08 * np.sin(angle)) / 1.003
    z = height / 2 * np.sin(angle)
    z = z - dimple * np.exp(-((x / (0.22 * width)) ** 2)) * np.maximum(np.sin(angle), 0)
    z = z * height / np.ptp(z)
    return Polygon(np.stack((x, z), 1))


def c_clamp(
    *, opening: float, throat: float, bar: float, screw: float, screw_length: float
) -> Polygon:
    """A C-shaped frame, open to the right, with a spindle from below and its pad."""
    height = opening + 2 * bar
    frame = _rectangle(0, 0, throat + bar, height) - _rectangle(
        bar, bar, throat + 2 * bar, height - bar
    )
    axis = throat + bar - 0.7 * bar
    spindle = _rectangle(
        axis - screw / 2, -0.5 * screw_length, axis + screw / 2, 0.5 * screw_length
    )
    pad = _rectangle(axis - screw, 0.5 * screw_length - 6, axis + screw, 0.5 * screw_length)
    grip = _rectangle(
        axis - 2.5 * screw, -0.5 * screw_length - 7, axis + 2.5 * screw, -0.5 * screw_length
    )
    return _union(frame, spindle, pad, grip)


def toothbrush(
    *, length: float, handle: float, neck: float, head: float, head_length: float
) -> Polygon:
    """Head up, seen from the side of the bristles."""
    handle_length = 0.55 * length
    return _revolved(
        [
            (0.6 * handle / 2, 0),
            *_ease(0, 0.7 * handle / 2, 0.25 * length, handle / 2),
            *_ease(handle_length, handle / 2, 0.7 * length, neck / 2),
            *_ease(length - 1.3 * head_length, neck / 2, length - 0.9 * head_length, head / 2),
            (head / 2, length - 0.15 * head_length),
            (head / 4, length),
        ]
    )


def saucepan(*, diameter: float, height: float, handle_length: float, handle: float) -> Polygon:
    """A pot from the side with one long handle near its rim."""
    pot = _rectangle(-diameter / 2, 0, diameter / 2, height)
    grip = _rectangle(diameter / 2 - 2, -handle, diameter / 2 + handle_length, 0)
    grip = affinity.rotate(grip, 8, origin=(diameter / 2, -handle))
    return _union(pot, affinity.translate(grip, 0, height - 3))


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
    motor = _rectangle(-0.45 * body_length, -body / 2, 0.55 * body_length, body / 2)
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
    pack = _rectangle(-battery / 2 - slant, low - battery_height, battery / 2 - slant, low + 1)
    return _filleted(_union(motor, jaws, handle, pack), 4)


def dumbbell(*, length: float, head: float, head_length: float, grip: float) -> Polygon:
    """Two heads on a bar, lying."""
    head_length = min(head_length, 0.45 * length)
    bar = _rectangle(-length / 2, -grip / 2, length / 2, grip / 2)
    left = _rectangle(-length / 2, -head / 2, -length / 2 + head_length, head / 2)
    return _union(bar, left, affinity.scale(left, -1, 1, origin=(0, 0)))


def bracket(*, width: float, height: float, thickness: float) -> Polygon:
    """A shelf bracket: an L of flat steel."""
    return _union(_rectangle(0, 0, width, thickness), _rectangle(0, 0, thickness, height))


def pliers(*, length: float, jaw_length: float, width: float, arm: float, spread: float) -> Polygon:
    """Closed jaws up, two arms that spread by `spread` at their ends."""
    pivot = length - jaw_length
    jaws = _revolved([(width / 2, pivot), (0.3 * width, length)])
    joint = _ellipse(0, pivot, 1.25 * width, 1.25 * width)
    inner, outer = 0.1 * width, max(spread / 2, arm)
    side = [(inner, pivot), (0.8 * outer, 0.65 * pivot), (outer, 0.35 * pivot), (0.85 * outer, 0)]
    right = shapely.LineString(side).buffer(arm / 2, quad_segs=ARC_SEGMENTS)
    return _filleted(_union(jaws, joint, right, affinity.scale(right, -1, 1, origin=(0, 0))), 3)


def scissors(
    *, length: float, blade_length: float, blade: float, loop: float, loop_height: float
) -> Polygon:
    """Closed blades up, two finger loops below (filled)."""
    pivot = length - blade_length
    blades = Polygon([(-blade / 2, pivot - 10), (blade / 2, pivot - 10), (3, length), (-1, length)])
    loops = [
        affinity.rotate(_ellipse(side * 0.52 * loop, loop_height / 2, loop, loop_height), side * 10)
        for side in (-1, 1)
    ]
    arms = Polygon([(-0.6 * loop, loop_height / 2), (0.6 * loop, loop_height / 2), (0, pivot + 15)])
    return _filleted(_union(blades, arms, *loops), 4)


def padlock(*, width: float, height: float, shackle: float, shackle_height: float) -> Polygon:
    """A square body under its shackle (filled)."""
    bow = _ellipse(0, height + shackle_height - shackle / 2, shackle, shackle)
    post = _rectangle(-shackle / 2, height - 1, shackle / 2, height + shackle_height - shackle / 2)
    return _union(_rectangle(-width / 2, 0, width / 2, height), bow, post)


def stapler(*, length: float, base: float, gap: float, arm: float) -> Polygon:
    """Base plate and arm, hinged on the left, mouth open to the right."""
    plate = _rectangle(0, 0, length, base)
    upper = Polygon(
        [
            (0, base - 1),
            (length, base + gap),
            (length, base + gap + 0.7 * arm),
            (0.1 * length, base + arm),
            (0, base + 0.8 * arm),
        ]
    )
    return _union(plate, upper)


def _rectangle(left: float, bottom: float, right: float, top: float) -> Polygon:
    return shapely.box(left, bottom, right, top)


def _ellipse(x: float, z: float, width: float, height: float) -> Polygon:
    circle = shapely.Point(0, 0).buffer(0.5, quad_segs=ARC_SEGMENTS)
    return affinity.translate(affinity.scale(circle, width, height, origin=(0, 0)), x, z)


def _revolved(stations: Sequence[tuple[float, float]]) -> Polygon:
    """The silhouette of a body of revolution: stations (radius, height) from the bottom up."""
    right = [(radius, height) for radius, height in stations]
    return Polygon([*right, *((-radius, height) for radius, height in reversed(right))])


def _ease(
    low: float, low_radius: float, high: float, high_radius: float
) -> list[tuple[float, float]]:
    """Stations of a cosine ramp from one radius to another."""
    share = np.linspace(0, 1, SAMPLES)
    radius = low_radius + (high_radius - low_radius) * (1 - np.cos(math.pi * share)) / 2
    return list(zip(radius.tolist(), (low + share * (high - low)).tolist(), strict=True))


def _union(*parts: Polygon) -> Polygon:
    joined = shapely.union_all(list(parts))
    if not isinstance(joined, Polygon):
        raise ValueError("the parts do not hang together")
    return _outer(joined)


def _filleted(shape: Polygon, radius: float) -> Polygon:
    """Fill concave corners with a radius [mm]; convex ones stay as they are."""
    filled = shape.buffer(radius, quad_segs=ARC_SEGMENTS)
    return _outer(filled.buffer(-radius, quad_segs=ARC_SEGMENTS))


def _outer(shape: Polygon | MultiPolygon) -> Polygon:
    if not isinstance(shape, Polygon) or shape.is_empty:
        raise ValueError("the shape is not one piece")
    return Polygon(shape.exterior)
