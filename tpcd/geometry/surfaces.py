"""Tables of the surfaces that an environment is made of, as compiled loops read them.

The class of a table selects the code of `query` when a loop is compiled: half-planes alone are the
fast case, and a `SurfaceTable` may mix what its `kind` says.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

PLANE, HEIGHT_FIELD = 0, 1
"""Kinds of surfaces in a `SurfaceTable`."""


class HalfPlanes(NamedTuple):
    """Half-planes n·p <= offset of s environments with t of them each: outward unit normals
    `normal` (s, t, 2) and `offset` (s, t) [m]."""

    normal: np.ndarray
    offset: np.ndarray


class SurfaceTable(NamedTuple):
    """Surfaces of mixed kinds, of s environments with t of them each.

    `kind` (t). All have a plane, `normal` (s, t, 2) and `offset` (s, t) [m], over which a height
    field rises by `rise` (t, g) [m] with the `slope` (t, g) at `cells` (t) + 1 places (`first` + k)
    `pitch` [m] along its tangent (n_z, -n_x), between which cubic Hermite splines are taken (de
    Boor, "A practical guide to splines", 1978, chapter IV); beyond them it goes on level. `spread`
    (t) is how much the rise differs at most [m].
    """

    kind: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    rise: np.ndarray
    slope: np.ndarray
    cells: np.ndarray
    first: np.ndarray
    pitch: np.ndarray
    spread: np.ndarray
