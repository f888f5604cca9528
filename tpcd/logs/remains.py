"""What w - K (x - u) is at rest, by cause: a factor, friction, a drift, an offset, a bend.

For each channel least squares of

    w = g K (x - u) + f s + d t + c

with the direction s in which the command went last, against which friction holds, and the time t
from 0 in the first row, which is free, to 1 in the last. A factor g is of the stiffness or of the
sensor; an offset c is of set points of another point or frame than the pose. A bend is what another
column K (x - u) |K (x - u)| then adds where that is largest, as of a sensor that saturates. What
scatters about the fit is noise, which `tpcd.data.noise` holds against what is stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

FEWEST = 8
"""Rows that show any of it."""
SURE = 5.0
"""Standard errors from which a cause is certain: by chance in one of a thousand recordings."""
LEAST_PULL = 1e-5
"""A command that changes by less is the same [m, rad]."""


@dataclass(frozen=True, eq=False)
class Remains:
    """Values and their standard errors, of F_x, F_z and tau; NaN where nothing shows them."""

    factor: Float[np.ndarray, "2 3"]
    """How many times K (x - u) the wrench is."""
    friction: Float[np.ndarray, "2 3"]
    """[N, N, N·m]"""
    drift: Float[np.ndarray, "2 3"]
    """From the first to the last row [N, N, N·m]."""
    offset: Float[np.ndarray, "2 3"]
    """In all rows [N, N, N·m]; NaN where it is not certain, and then left out of the fit."""
    bend: Float[np.ndarray, "2 3"]
    """What K (x - u) lacks where it is largest [N, N, N·m]."""


def remains(
    rows: Float[np.ndarray, "k 9"],
    expected: Float[np.ndarray, "k 3"],
    floor: Float[np.ndarray, " 3"],
) -> Remains:
    """Of pose, command and wrench at rest, where K (x - u) is `expected`.

    `floor` is added to what scatters of the wrench [N, N, N·m]: sensors that are off by less tell
    nothing.
    """
    found = np.full((5, 2, 3), np.nan)
    last = _directions(rows[:, 3:6])
    time, all_rows = np.linspace(0.0, 1.0, len(rows)), np.ones(len(rows))
    for c in range(3 if len(rows) >= FEWEST else 0):
        spring, wrench = expected[:, c], rows[:, 6 + c]
        columns = (spring, last[:, c], time, all_rows)
        whole = _fit(columns, wrench, floor[c])
        if not abs(whole[3, 0]) > SURE * whole[3, 1]:
            columns = columns[:3]
            whole = _fit(columns, wrench, floor[c])
        found[: len(whole), :, c] = whole
        largest = float(np.abs(spring).max())
        bent = spring * np.abs(spring) / max(largest, 1e-12)
        value, error = _fit((bent, *columns), wrench, floor[c])[0]
        # A straight line takes up what it can of a parabola.
        found[4, :, c] = value * largest / 4.0, error * largest / 4.0
    return Remains(*found)


def _directions(commands: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Which way each coordinate was pulled last, 1 or -1; 0 before it ever was."""
    pulled = np.diff(commands, axis=0, prepend=commands[:1])
    far = np.abs(pulled) > LEAST_PULL
    last = np.maximum.accumulate(np.where(far, np.arange(len(commands))[:, None], 0))
    return np.sign(np.take_along_axis(np.where(far, pulled, 0.0), last, axis=0))


def _fit(
    columns: tuple[Float[np.ndarray, " k"], ...], values: Float[np.ndarray, " k"], floor: float
) -> Float[np.ndarray, "p 2"]:
    """Least-squares coefficients of columns with their standard errors; NaN of columns that are
    zero or hardly differ from the others together."""
    design = np.column_stack(columns)
    scale = np.linalg.norm(design, axis=0)
    some = scale > 0
    unit = design[:, some] / scale[some]
    products = unit.T @ unit
    found = np.full((len(columns), 2), np.nan)
    if not some.any() or np.linalg.cond(products) > 1e6:
        return found
    inverse = np.linalg.inv(products)
    coefficients = inverse @ (unit.T @ values)
    left = values - unit @ coefficients
    variance = left @ left / (len(values) - some.sum()) + floor**2
    errors = np.sqrt(variance * np.diag(inverse))
    found[some] = np.column_stack((coefficients, errors)) / scale[some, None]
    return found
