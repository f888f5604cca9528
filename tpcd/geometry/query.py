"""The contact query: gap, normal and curvature of a surface at a point of the world.

`query(surfaces, e, t, x, z)` answers for surface t of environment e. A height field h over a plane
n·p = d, with the place s = n_z x - n_x z along its tangent, is the zero of

    f = n·p - d - h(s),      grad f = n - h'(s) tangent,                                         (4)

of which the gap is f / |grad f|, the distance to first order; it is exact on the surface, where all
that bears load is. The curvature k = -h'' / |grad f|^3 is how fast the normal turns along the
tangent, dn = k tangent ds: positive where the surface bulges out.

The functions on top give names and types; which body runs is chosen by the class of the table when
a loop is compiled (`overload`), and outside of compiled loops there is none.
"""

from __future__ import annotations

import math
from typing import Any, no_type_check

import numpy as np
from numba.extending import overload

from tpcd.geometry.surfaces import HEIGHT_FIELD, HalfPlanes, SurfaceTable
from tpcd.loops import inner

_OPTIONS = {"_nrt": False, "forceinline": True}


def query(surfaces: Any, e: int, t: int, x: float, z: float) -> tuple[float, float, float, float]:
    """Gap [m], unit normal (x, z) and curvature [1/m] of surface t of environment e; compiled."""
    raise NotImplementedError


def plane_of(surfaces: Any, e: int, t: int) -> tuple[float, float, float]:
    """Normal (x, z) and offset [m] of the plane that surface t is, or lies about; compiled."""
    raise NotImplementedError


def bent(surfaces: Any) -> bool:
    """Whether any surface may be curved, decided when a loop is compiled."""
    raise NotImplementedError


def spread(surfaces: Any, e: int, t: int) -> float:
    """How far a surface leaves its plane, at most [m]; compiled."""
    raise NotImplementedError


def own_surfaces(surfaces: Any) -> Any:
    """Room for those of one environment: half-planes are copied, which is faster; compiled."""
    raise NotImplementedError


def meet(own: Any, surfaces: Any, where: Any, e: int) -> None:
    """Take over environment e of a table, which is at `where[0]` of `own` from now on; compiled."""
    raise NotImplementedError


@overload(query, jit_options=_OPTIONS)
@no_type_check
def _query(surfaces, e, t, x, z):
    if surfaces.instance_class is HalfPlanes:
        return lambda surfaces, e, t, x, z: half_plane(surfaces, 0, t, x, z)
    assert surfaces.instance_class is SurfaceTable
    return lambda surfaces, e, t, x, z: by_kind(surfaces, e, t, x, z)


@overload(plane_of, jit_options=_OPTIONS)
@no_type_check
def _plane_of(surfaces, e, t):
    if surfaces.instance_class is HalfPlanes:
        return lambda surfaces, e, t: _plane(surfaces, 0, t)
    return lambda surfaces, e, t: _plane(surfaces, e, t)


@overload(bent, jit_options=_OPTIONS)
@no_type_check
def _bent(surfaces):
    if surfaces.instance_class is HalfPlanes:
        return lambda surfaces: False
    return lambda surfaces: True


@overload(spread, jit_options=_OPTIONS)
@no_type_check
def _spread(surfaces, e, t):
    if surfaces.instance_class is HalfPlanes:
        return lambda surfaces, e, t: 0.0
    return lambda surfaces, e, t: surfaces.spread[t]


@overload(own_surfaces)
@no_type_check
def _own_surfaces(surfaces):
    if surfaces.instance_class is HalfPlanes:
        return lambda surfaces: HalfPlanes(
            np.zeros((1, surfaces.offset.shape[1], 2)), np.zeros((1, surfaces.offset.shape[1]))
        )
    return lambda surfaces: surfaces


@overload(meet, jit_options=_OPTIONS)
@no_type_check
def _meet(own, surfaces, where, e):
    if surfaces.instance_class is HalfPlanes:
        return lambda own, surfaces, where, e: _copy_planes(own, surfaces, e)
    return lambda own, surfaces, where, e: _point_to(where, e)


@inner
@no_type_check
def _copy_planes(own, surfaces, e):
    for t in range(own.offset.shape[1]):
        own.normal[0, t, 0], own.normal[0, t, 1] = (
            surfaces.normal[e, t, 0],
            surfaces.normal[e, t, 1],
        )
        own.offset[0, t] = surfaces.offset[e, t]


@inner
@no_type_check
def _point_to(where, e):
    where[0] = e


@inner(forceinline=True)
@no_type_check
def _plane(surfaces, e, t):
    return surfaces.normal[e, t, 0], surfaces.normal[e, t, 1], surfaces.offset[e, t]


@inner(forceinline=True)
@no_type_check
def half_plane(surfaces, e, t, x, z):
    """The query of a half-plane."""
    nx, nz = surfaces.normal[e, t, 0], surfaces.normal[e, t, 1]
    return nx * x + nz * z - surfaces.offset[e, t], nx, nz, 0.0


@inner(error_model="numpy")
@no_type_check
def by_kind(surfaces, e, t, x, z):
    """The query of a surface of any kind."""
    gap, nx, nz, _ = half_plane(surfaces, e, t, x, z)
    if surfaces.kind[t] != HEIGHT_FIELD:
        return gap, nx, nz, 0.0
    rise, slope, bend = _height(surfaces, t, nz * x - nx * z)
    size = math.sqrt(1.0 + slope * slope)
    normal_x, normal_z = (nx - slope * nz) / size, (nz + slope * nx) / size
    return (gap - rise) / size, normal_x, normal_z, -bend / (size * size * size)


@inner(error_model="numpy")
@no_type_check
def _height(surfaces, t, s):
    """Rise of a height field at a place s, its slope, and how that changes."""
    cells, pitch, rise, slope = surfaces.cells[t], surfaces.pitch[t], surfaces.rise, surfaces.slope
    u = s / pitch - surfaces.first[t]
    if not 0.0 <= u < cells:
        return rise[t, 0 if not u >= 0.0 else cells], 0.0, 0.0
    g = int(u)
    u -= g
    a, b, c, d = rise[t, g], rise[t, g + 1], slope[t, g] * pitch, slope[t, g + 1] * pitch
    square, cube = 3.0 * (b - a) - 2.0 * c - d, 2.0 * (a - b) + c + d
    return (
        a + u * (c + u * (square + u * cube)),
        (c + u * (2.0 * square + 3.0 * u * cube)) / pitch,
        (2.0 * square + 6.0 * u * cube) / (pitch * pitch),
    )
