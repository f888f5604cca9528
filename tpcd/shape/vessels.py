"""Makers of what stands in a kitchen: boxes, cans, bottles, cups, fruit, bulbs.

Every maker draws one silhouette in millimetres, upright (z up), from its dimensions. Where its
origin lies means nothing, `builtin` centres it. Edges stay sharp here; `drawing.rounded`
rounds them afterwards. Dimensions are arguments, so that scaling them makes variants.
"""

from __future__ import annotations

import math

import numpy as np
from shapely.geometry import Polygon

from tpcd.shape.drawing import (
    ARC_SEGMENTS,
    STATIONS,
    eased,
    filleted,
    oval,
    rectangle,
    revolved,
    union,
)


def box(*, width: float, height: float) -> Polygon:
    """A rectangle: cans, cartons, books seen from the side."""
    return rectangle(-width / 2, 0, width / 2, height)


def card(*, width: float, height: float, corner: float) -> Polygon:
    """A rectangle with generous corners of a given radius: cards, phones, remote controls."""
    radius = min(corner, 0.49 * min(width, height))
    core = rectangle(-width / 2 + radius, radius, width / 2 - radius, height - radius)
    return core.buffer(radius, quad_segs=ARC_SEGMENTS)


def ellipse(*, width: float, height: float) -> Polygon:
    """An ellipse; a disc where both are equal."""
    return oval(0, 0, width, height)


def ball(*, diameter: float) -> Polygon:
    """A disc."""
    return oval(0, 0, diameter, diameter)


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
    return revolved([(bottom / 2, 0), (top / 2, height)])


def bottle(
    *, body: float, body_height: float, shoulder: float, neck: float, neck_height: float
) -> Polygon:
    """Body, smooth shoulder and neck of given diameters and heights."""
    neck = min(neck, body)
    top = body_height + shoulder
    return revolved(
        [(body / 2, 0), *eased(body_height, body / 2, top, neck / 2), (neck / 2, top + neck_height)]
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
    return union(vessel, rectangle(-cap / 2, top - 0.5, cap / 2, top + cap_height))


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
    return union(vessel, rectangle(left, top - 1, right, top + head_height), lever)


def mug(*, diameter: float, height: float, handle_reach: float, handle_height: float) -> Polygon:
    """A cylinder with an ear; the opening of the handle is filled."""
    ear = oval(diameter / 2, height / 2, 2 * handle_reach, min(handle_height, height))
    return union(rectangle(-diameter / 2, 0, diameter / 2, height), ear)


def bowl(*, rim: float, foot: float, height: float, foot_height: float) -> Polygon:
    """A round bowl on a foot, its open top closed by a straight line."""
    foot = min(foot, 0.9 * rim)
    rise = np.linspace(0, 1, STATIONS)
    radius = foot / 2 + (rim - foot) / 2 * np.sqrt(1 - (1 - rise) ** 2)
    side = list(zip(radius, foot_height + rise * (height - foot_height), strict=True))
    return revolved([(0.96 * foot / 2, 0), *side])


def wine_glass(
    *, foot: float, stem: float, stem_height: float, bowl: float, bowl_height: float
) -> Polygon:
    """Foot plate, stem, and a bowl: an ellipse cut at 80 % of its height."""
    ellipse_height = bowl_height / 0.8
    top = stem_height + bowl_height
    cup = oval(0, stem_height + ellipse_height / 2, bowl, ellipse_height)
    cup = cup & rectangle(-bowl, 0, bowl, top)
    plate = revolved([(foot / 2, 0), (foot / 2, 3), *eased(3, foot / 2, 14, stem / 2)])
    column = rectangle(-stem / 2, 1, stem / 2, stem_height + 5)
    return filleted(union(plate, column, cup), 6)


def light_bulb(*, globe: float, height: float, base: float, base_height: float) -> Polygon:
    """A globe that runs into a screw base at the bottom."""
    middle = max(height - globe / 2, base_height + globe / 4)
    neck = revolved([*eased(base_height, base / 2, middle, 0.97 * globe / 2)])
    cap = revolved([(base / 5, 0), (base / 2, 0.25 * base_height), (base / 2, base_height + 0.5)])
    return union(oval(0, middle, globe, globe), neck, cap)


def gable_carton(*, width: float, height: float, gable: float, fin: float) -> Polygon:
    """A milk carton seen from the side of its roof, with the sealed fin on top."""
    roof = Polygon([(-width / 2, height), (width / 2, height), (0, height + gable)])
    body = rectangle(-width / 2, 0, width / 2, height + 0.5)
    return union(body, roof, rectangle(-3, height, 3, height + gable + fin))


def squeeze_tube(
    *, crimp: float, shoulder: float, length: float, cap: float, cap_height: float
) -> Polygon:
    """A toothpaste tube standing on its cap."""
    return revolved(
        [
            (cap / 2, 0),
            (cap / 2, cap_height),
            (shoulder / 2, cap_height + 8),
            (crimp / 2, cap_height + length),
        ]
    )


def bent_fruit(*, length: float, thickness: float, bend: float, tip: float) -> Polygon:
    """A banana: an arc bent by `bend` degrees along its length, thick in the middle."""
    share = np.linspace(0, 1, 3 * STATIONS)
    angle = math.radians(bend) * (share - 0.5)
    radius = length / math.radians(bend)
    half = (tip + (thickness - tip) * np.sin(math.pi * share) ** 0.6) / 2
    normal = np.stack((np.sin(angle), -np.cos(angle)), 1)
    centre = radius * normal
    return Polygon([*(centre + half[:, None] * normal), *(centre - half[:, None] * normal)[::-1]])


def pear(*, width: float, height: float, crown: float) -> Polygon:
    """A large ball below, a small one above, blended."""
    crown = min(crown, 0.8 * width)
    low = oval(0, width / 2, width, width)
    high = oval(0, height - crown / 2, crown, crown)
    waist = revolved([(0.42 * width, 0.5 * width), (0.47 * crown, height - 0.5 * crown)])
    return filleted(union(low, high, waist), 0.5 * width)


def apple(*, width: float, height: float, dimple: float) -> Polygon:
    """A rounded heart: wider above the middle, with a dimple at the stalk."""
    angle = np.linspace(-math.pi / 2, 1.5 * math.pi, 6 * ARC_SEGMENTS, endpoint=False)
    x = width / 2 * np.cos(angle) * (1 + 0.08 * np.sin(angle)) / 1.003
    z = height / 2 * np.sin(angle)
    z = z - dimple * np.exp(-((x / (0.22 * width)) ** 2)) * np.maximum(np.sin(angle), 0)
    z = z * height / np.ptp(z)
    return Polygon(np.stack((x, z), 1))
