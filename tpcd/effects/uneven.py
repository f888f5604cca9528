"""Floors that are not straight within the width of an object: steps, waves and bumps.

The step knows one plane of the floor for each row. It is laid tangent to the floor where the
outline comes nearest to it, and every outline point is moved up or down such that it is as high
over that plane as it truly is over the floor. So an object rests on all that it touches, at the
pose that the floor is looked at from; that is where the row settled in the pass before. What
two points touch has one direction, that of the nearest one. Where an object comes to rest can
depend on what lies on its way, which is therefore gone in parts at first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tpcd.effects.conditions import FLOOR, Conditions, Outcome, Rows
from tpcd.effects.declare import DeclaredEffect, column
from tpcd.effects.geometry import with_plane
from tpcd.effects.protocol import EffectParameter
from tpcd.threads import in_parts

Relief = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""From the k parameters (m, k) of an effect and places x (m, r, p) [m] along the floor to heights
over its plane (m, r, p) [m] and their slopes there."""
NEAR = 0.02
"""Points that are further from the floor than this [m] only have to stay away from it."""
_RAMP = 0.0025
"""Half width of the ramp at a step of the floor [m]."""
_PITCH, _LONGEST = 0.00025, 2.0
"""A relief is looked up between places so far apart, along so much floor [m]; as much further apart
as there is more of it."""
_PARTS, _PASSES = 2, 2
"""As in `Effect`: more of either leave fewer rows wrong, and take longer (`eval/EVIDENCE.md`)."""


def on_uneven(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome, relief: Relief
) -> Conditions:
    """The conditions over a floor with a relief over its plane, as seen from where the rows are
    looked at (`Outcome.view`).

    `values` (m, k) are the parameters of the relief. Replaces normal (m, r, 2) and offset (m, r)
    [m] of the floor, in world axes, by those of its tangent where the outline comes nearest, and
    adds to `warp` (m, r, p, 2) [m] in the end-effector frame. Rows that follow no other stay as
    they are.
    """
    view = outcome.view + conditions.turned
    stays = rows.follows == torch.arange(len(rows.follows), device=view.device)
    normal = conditions.normal[:, :, FLOOR].expand(*view.shape[:2], 2)
    offset = conditions.offset[:, :, FLOOR].expand(view.shape[:2])
    seen = _Seen(outcome.outline, view, normal, offset, stays)
    warp, normal, offset = _laid(seen, values, relief)
    if bool(warp.any()):
        warp = conditions.warp + warp if conditions.warps else warp
        conditions = replace(conditions, warp=warp)
    return with_plane(conditions, FLOOR, normal, offset)


class _Seen(NamedTuple):
    """Outlines (m, p, 2) at poses `view` (m, r, 3) over planes with normals (m, r, 2) and offsets
    (m, r); rows that stay, (r,), meet the plane as it is."""

    outline: Tensor
    view: Tensor
    normal: Tensor
    offset: Tensor
    stays: Tensor


_Laid = tuple[Tensor, Tensor, Tensor]
"""What points are moved by (m, r, p, 2), and normals (m, r, 2) and offsets (m, r) of tangents."""


def _laid(seen: _Seen, values: Tensor, relief: Relief) -> _Laid:
    """Outlines over a relief, which is looked up."""
    from tpcd.effects.kernel_uneven import Laid, Profile, lay_range

    outline, view, normal, offset, stays = seen
    x, reach = view[..., 0].nan_to_num(), float(outline.norm(dim=-1).nan_to_num().max())
    least, most = float(x.min()) - reach, float(x.max()) + reach
    pitch = _PITCH * max(1, math.ceil((most - least) / _LONGEST))
    first = math.floor(least / pitch)
    cells = math.ceil(most / pitch) - first

    # Multiples of the pitch, so that where others are changes nothing.
    places = pitch * torch.arange(first, first + cells + 1, dtype=view.dtype)
    count, rows, points = *view.shape[:2], outline.shape[1]
    rise, slope = (
        part[:, 0].expand(count, -1).contiguous().numpy()
        for part in relief(values, places[None, None])
    )
    shapes = ((count, rows, 2), (count, rows), (count, rows, 2, points))
    laid = Laid(*(np.empty(shape) for shape in shapes))
    given = (value.contiguous().numpy() for value in (outline.mT, view, normal, offset, stays))
    work = partial(lay_range, *given, Profile(rise, slope, first, pitch), NEAR, laid)
    in_parts(work, count, rows)
    tangent, through, warp = (torch.from_numpy(value) for value in laid)
    return warp.mT, tangent, through


def _step(values: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    height, place = (column(values, i)[..., None] for i in range(2))
    ramp = ((x - place) / _RAMP).tanh()
    return height * (0.5 * (1.0 + ramp)), height * (0.5 / _RAMP) * (1.0 - ramp**2)


def _wave(values: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    sine, cosine, length = (column(values, i)[..., None] for i in range(3))
    number = 2 * math.pi / length
    s, c = (number * x).sin(), (number * x).cos()
    return sine * s + cosine * c, number * (sine * c - cosine * s)


def _bump(values: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    height, place, width = (column(values, i)[..., None] for i in range(3))
    away = (x - place) / width
    rise = height * (-0.5 * away**2).exp()
    return rise, -rise * away / width


def _relief_formula(
    name: str, relief: Relief, parameters: tuple[EffectParameter, ...], text: str
) -> DeclaredEffect:
    def change(
        conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
    ) -> Conditions:
        if outcome is None:
            return conditions
        return on_uneven(conditions, values, rows, outcome, relief)

    return DeclaredEffect(
        f"floor_height ~ {name}",
        "geometry",
        parameters,
        change,
        text,
        needs=("floor places",),
        passes=_PASSES,
        parts=_PARTS,
    )


def _millimetres(name: str, low: float, high: float, null: float | None = None) -> EffectParameter:
    where = null is not None
    return EffectParameter(name, "m", low, high, null or 0.0, "mm", 1e3, where)


RELIEFS = (
    _relief_formula(
        "step",
        _step,
        (_millimetres("height", -0.01, 0.01), _millimetres("place", -0.1, 0.2, 0.05)),
        "the floor is higher by {0} beyond x = {1}",
    ),
    _relief_formula(
        "wave",
        _wave,
        (
            _millimetres("sine", -0.005, 0.005),
            _millimetres("cosine", -0.005, 0.005),
            _millimetres("length", 0.03, 0.15, 0.06),
        ),
        "the floor rises by {0} sin(2πx / l) and {1} cos(2πx / l), with l = {2}",
    ),
    _relief_formula(
        "bump",
        _bump,
        (
            _millimetres("height", -0.01, 0.01),
            _millimetres("place", -0.1, 0.2, 0.05),
            _millimetres("width", 0.005, 0.05, 0.015),
        ),
        "the floor rises by {0} about x = {1}, over a width (sd) of {2}",
    ),
)
"""Formulas of an uneven floor."""
