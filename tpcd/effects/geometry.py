"""Effects on where things are: tilted, bent and drifting terrains, a loose grasp."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tpcd.effects.conditions import FLOOR, WALL, Conditions, Outcome, Rows
from tpcd.effects.declare import DeclaredEffect, column
from tpcd.effects.protocol import EffectParameter
from tpcd.planar import wrap_angle

_DEGREE = {"shown_unit": "deg", "shown_factor": 57.29578}


def with_plane(
    conditions: Conditions, terrain: int, normal: Tensor | None = None, offset: Tensor | None = None
) -> Conditions:
    """The conditions with another normal (m, r, 2) or offset (m, r) of one terrain."""
    if normal is not None:
        normals = [n.expand(*normal.shape[:2], 2) for n in conditions.normal.unbind(2)]
        normals[terrain] = normal
        conditions = replace(conditions, normal=torch.stack(normals, dim=2))
    if offset is not None:
        offsets = [o.expand(offset.shape) for o in conditions.offset.unbind(2)]
        offsets[terrain] = offset
        conditions = replace(conditions, offset=torch.stack(offsets, dim=2))
    return conditions


def on_curve(conditions: Conditions, x: Tensor, height: Tensor, slope: Tensor) -> Conditions:
    """The conditions with the tangent of a bent floor at x (m, r) [m], where it is higher by
    `height` [m] and steeper by `slope` than the plane."""
    normal, offset = conditions.normal[:, :, FLOOR], conditions.offset[:, :, FLOOR]
    height = (offset - normal[..., 0] * x) / normal[..., 1] + height
    normal = turned(normal, slope.atan())
    return with_plane(conditions, FLOOR, normal, normal[..., 0] * x + normal[..., 1] * height)


def sunk(
    conditions: Conditions, terrain: int, sink: Tensor, rows: Rows, outcome: Outcome
) -> Conditions:
    """The conditions with one terrain lower by `sink` (m, r) [m] under the loads of `outcome`.

    It carries along what it holds, unless that touches another terrain too and is carried by it.
    """
    alone = outcome.load[:, :, terrain] > 0
    for other in range(outcome.load.shape[-1]):
        if other != terrain:
            alone = alone & ~(outcome.load[:, :, other] > 0)
    way = torch.where(alone, rows.before(sink) - sink, 0.0)
    give = conditions.give + pose_change(conditions.normal[:, :, terrain], way)
    offset = conditions.offset[:, :, terrain] - sink
    return with_plane(replace(conditions, give=give), terrain, offset=offset)


def pose_change(direction: Tensor, way: Tensor) -> Tensor:
    """A change of pose (m, r, 3) by a way (m, r) [m] along directions (m, r, 2)."""
    return torch.cat((way[..., None] * direction, torch.zeros_like(way)[..., None]), dim=-1)


def turned(normal: Tensor, angle: Tensor) -> Tensor:
    """Normals (m, r, 2) turned counter-clockwise by angles (m, r)."""
    x, z = normal[..., 0], normal[..., 1]
    cosine, sine = angle.cos(), angle.sin()
    return torch.stack((x * cosine - z * sine, z * cosine + x * sine), dim=-1)


def _tilt(terrain: int):
    def change(
        conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
    ) -> Conditions:
        angle = column(values, 0)
        # About the point where the plane crosses its axis: x = 0 (floor) or z = 0 (wall).
        offset = conditions.offset[:, :, terrain] * angle.cos()
        normal = turned(conditions.normal[:, :, terrain], angle.expand(offset.shape))
        return with_plane(conditions, terrain, normal, offset)

    return change


def _curvature(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    if outcome is None:
        return conditions
    bend, x = column(values, 0), outcome.place[:, :, FLOOR, 0]
    return on_curve(conditions, x, 0.5 * bend * x**2, bend * x)


def _floor_drift(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    offset = conditions.offset[:, :, FLOOR] + column(values, 0) * rows.share
    return with_plane(conditions, FLOOR, offset=offset)


def _grasp_compliance(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    if outcome is None:
        return conditions
    twist = wrap_angle(outcome.pose[..., 2:] - conditions.command[..., 2:])
    torque = conditions.stiffness[..., 2:] * twist - conditions.load[..., 2:]
    return replace(conditions, turn=conditions.turn + column(values, 0)[..., None] * torque)


def _grasp_slip(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    angle, shift, at = (column(values, i) for i in range(3))
    # A step over one row, linear in between so that its place has a slope.
    spacing = torch.nn.functional.pad(rows.share.diff(), (0, 1), value=1e-9).max()
    done = ((rows.share - at) / spacing + 1.0).clamp(0.0, 1.0)
    turn = conditions.command[..., 2]
    way = (shift * done)[..., None] * torch.stack((turn.cos(), turn.sin()), dim=-1)
    moved = (conditions.normal * way[:, :, None]).sum(-1)
    return replace(
        conditions,
        turn=conditions.turn + (angle * done)[..., None],
        offset=conditions.offset - moved,
    )


GEOMETRY_EFFECTS = (
    DeclaredEffect(
        "floor_tilt",
        "geometry",
        (EffectParameter("angle", "rad", -0.12, 0.12, **_DEGREE),),
        _tilt(FLOOR),
        "the floor is tilted by {0}",
        needs=("floor places",),
    ),
    DeclaredEffect(
        "wall_tilt",
        "geometry",
        (EffectParameter("angle", "rad", -0.2, 0.2, **_DEGREE),),
        _tilt(WALL),
        "the wall is tilted by {0}",
        needs=("wall places",),
    ),
    DeclaredEffect(
        "floor_curvature",
        "geometry",
        (EffectParameter("curvature", "1/m", -3.0, 3.0),),
        _curvature,
        "the floor is bent with a curvature of {0}",
        needs=("floor places",),
        passes=2,
    ),
    DeclaredEffect(
        "grasp_compliance",
        "geometry",
        (
            EffectParameter(
                "compliance", "rad/(N·m)", 0.0, 0.3, shown_unit="deg/(N·m)", shown_factor=57.29578
            ),
        ),
        _grasp_compliance,
        "the object turns in the hand by {0}",
        needs=("floor load",),
        passes=2,
    ),
    DeclaredEffect(
        "grasp_slip",
        "geometry",
        (
            EffectParameter("angle", "rad", -0.12, 0.12, **_DEGREE),
            EffectParameter("shift", "m", -0.01, 0.01, shown_unit="mm", shown_factor=1e3),
            EffectParameter(
                "at", "1", 0.02, 0.98, null=0.5, shown_unit="% of the run", shown_factor=100.0
            ),
        ),
        _grasp_slip,
        "the object slipped in the hand by {0} and {1}, after {2}",
        needs=("floor load",),
    ),
    DeclaredEffect(
        "floor_drift",
        "geometry",
        (EffectParameter("drift", "m", -0.01, 0.01, shown_unit="mm", shown_factor=1e3),),
        _floor_drift,
        "the floor moves by {0} over the run",
        needs=("floor load",),
    ),
)
