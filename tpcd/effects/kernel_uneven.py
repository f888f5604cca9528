"""Outlines laid over an uneven floor in compiled loops; see `uneven`."""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.loops import njit


class Profile(NamedTuple):
    """Heights [m] over a plane and slopes (m, g) at places (`first` + k) `pitch` [m] along it,
    between which cubic Hermite splines are taken (de Boor 1978, chapter IV)."""

    rise: np.ndarray
    slope: np.ndarray
    first: int
    pitch: float


class Laid(NamedTuple):
    """What `lay_range` fills: tangent lines of the floor, normals (m, r, 2) and offsets (m, r) [m],
    and what outline points are moved by in the end-effector frame, (m, r, 2, p) [m]."""

    normal: np.ndarray
    offset: np.ndarray
    warp: np.ndarray


# Sums may be taken in another order, so that they run in vector registers.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
@no_type_check
def lay_range(outline, view, normal, offset, stays, profile, near, laid, first, last):
    """Particles from `first` up to `last`: outlines (m, 2, p) at poses `view` (m, r, 3) over floors
    with planes `normal` (m, r, 2) and `offset` (m, r) [m]. Rows that stay, (r,), are over the
    plane; points further from the floor than `near` [m] only stay away from the tangent."""
    cells, count = profile.rise.shape[1] - 1, outline.shape[2]
    cubic = np.empty((cells, 4))
    x, z, gap, slope, away = np.empty((5, count))
    for i in range(first, last):
        flat = True
        for g in range(cells):
            a, b = profile.rise[i, g], profile.rise[i, g + 1]
            c, d = profile.slope[i, g] * profile.pitch, profile.slope[i, g + 1] * profile.pitch
            cubic[g, 0], cubic[g, 1] = a, c
            cubic[g, 2], cubic[g, 3] = 3.0 * (b - a) - 2.0 * c - d, 2.0 * (a - b) + c + d
            flat &= a == 0.0 and b == 0.0 and c == 0.0 and d == 0.0
        for k in range(view.shape[1]):
            laid.normal[i, k, 0], laid.normal[i, k, 1] = normal[i, k, 0], normal[i, k, 1]
            laid.offset[i, k] = offset[i, k]
            laid.warp[i, k] = 0.0
            if flat or stays[k]:
                continue
            px, pz, angle = view[i, k, 0], view[i, k, 1], view[i, k, 2]
            if not math.isfinite(px + pz + angle):
                laid.offset[i, k] = np.nan
                continue
            c, s = math.cos(angle), math.sin(angle)
            tilt = -normal[i, k, 0] / normal[i, k, 1]
            level = offset[i, k] / normal[i, k, 1]
            for j in range(count):
                x[j] = px + c * outline[i, 0, j] - s * outline[i, 1, j]
                z[j] = pz + s * outline[i, 0, j] + c * outline[i, 1, j]
            for j in range(count):
                u = x[j] / profile.pitch
                whole = math.floor(u)
                u -= whole
                g = min(max(int(whole) - profile.first, 0), cells - 1)
                gap[j] = cubic[g, 0] + u * (cubic[g, 1] + u * (cubic[g, 2] + u * cubic[g, 3]))
                slope[j] = cubic[g, 1] + u * (2.0 * cubic[g, 2] + 3.0 * u * cubic[g, 3])
            for j in range(count):
                slope[j] = tilt + slope[j] / profile.pitch
                gap[j] = z[j] - (level + tilt * x[j] + gap[j])
                away[j] = gap[j] / math.sqrt(1.0 + slope[j] * slope[j])
            nearest = np.argmin(away)
            steep = slope[nearest]
            through = z[nearest] - gap[nearest] - steep * x[nearest]
            for j in range(count):
                above = z[j] - (through + steep * x[j])
                up = (gap[j] if gap[j] < near else max(above, near)) - above
                laid.warp[i, k, 0, j], laid.warp[i, k, 1, j] = up * s, up * c
            length = math.sqrt(1.0 + steep * steep)
            laid.normal[i, k, 0], laid.normal[i, k, 1] = -steep / length, 1.0 / length
            laid.offset[i, k] = through / length
