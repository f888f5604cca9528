"""What the one law that needs no model, w = K (x - u), says of rows.

Where the rows as they are break it, and the same numbers in another order keep it, they were put
into the wrong order: commands, poses or wrenches of a neighbouring row, or two columns swapped.
Where it is broken by more than the noise, the stiffness, the sensor or the noise is another one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tpcd.planar import spring_wrench

LEAST_ROWS = 3
"""Rows beyond the noise that tell whether the law holds."""
BEYOND = 6.0
"""Standard deviations from which on a reading is no noise."""
BROKEN, KEPT = 0.5, 0.3
"""Part of the wrench that is left over where the law is broken, and where it is kept; it is kept
only where that is less than half of what the order as it is leaves: offsets and gains of a sensor
leave the same in either order."""
LARGE, SURE = 1.5, 1e-6
"""What is left over is told from so many times the noise (root mean square), where noise alone
leaves as much with less than this probability."""

Rows = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Commands, poses and wrenches, (n, 3) each [m, m, rad; m, m, rad; N, N, N·m]."""


def misplaced(
    rows: Rows, stiffness: Float[np.ndarray, " 3"], sensor_std: Float[np.ndarray, " 6"]
) -> tuple[str, str] | None:
    """What is said of rows that are in the wrong order, and what to do; None where they are not."""
    scale = _noise(stiffness, sensor_std) + 1e-9
    before = _left(rows, stiffness, scale)
    if before is None or before < BROKEN:
        return None
    found = []
    for (told, remedy), other in _orders(rows).items():
        left = _left(other, stiffness, scale)
        if left is not None and left < min(KEPT, 0.5 * before):
            found.append((left, told, remedy))
    if not found:
        return None
    left, told, remedy = min(found)
    return (
        f"{told}: K (pose - command) leaves {before:.0%} of the wrench over, and {left:.0%} with"
        " that put right",
        remedy,
    )


def departure(
    rows: Rows, stiffness: Float[np.ndarray, " 3"], sensor_std: Float[np.ndarray, " 6"]
) -> tuple[str, str] | None:
    """What is said of wrenches that differ from K (pose - command) by more than the noise, and what
    to do; None where they do not. The free start is no part of it."""
    from scipy.stats import chi2

    ratios, count = _ratios(rows, stiffness, sensor_std)
    together = noise_ratio(rows, stiffness, sensor_std)
    if together is None or together < LARGE or chi2.sf(count * together**2, count) > SURE:
        return None
    worst = int(np.nanargmax(ratios))
    name, unit = (("F_x", "N"), ("F_z", "N"), ("tau", "N·m"))[worst]
    left = ratios[worst] * _noise(stiffness, sensor_std)[worst]
    return (
        f"{name} differs from K (pose - command) by {left:.2g} {unit} (root mean square),"
        f" {ratios[worst]:.2g} times the noise",
        "the stiffness, the sensor or sensor_std is not what the YAML says, and an estimate is off"
        " by more than its intervals: let scripts/diagnose.py find which",
    )


def noise_ratio(
    rows: Rows, stiffness: Float[np.ndarray, " 3"], sensor_std: Float[np.ndarray, " 6"]
) -> float | None:
    """What K (pose - command) leaves of the wrench over its noise, root mean square; about 1 where
    all is as it should be, None where no noise is stated."""
    ratios, _ = _ratios(rows, stiffness, sensor_std)
    return None if np.isnan(ratios).all() else float(np.sqrt(np.nanmean(np.square(ratios))))


def _ratios(
    rows: Rows, stiffness: Float[np.ndarray, " 3"], sensor_std: Float[np.ndarray, " 6"]
) -> tuple[Float[np.ndarray, " 3"], int]:
    """The same for each channel, NaN without noise, and how many readings that is of."""
    scale = _noise(stiffness, sensor_std)
    scale = np.where(scale > 0, scale, np.nan)
    left = (rows[2] - spring_wrench(rows[1], rows[0], stiffness))[1:] / scale
    return np.sqrt(np.square(left).mean(0)), int(np.isfinite(left).sum())


def _noise(
    stiffness: Float[np.ndarray, " 3"], sensor_std: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, " 3"]:
    """Standard deviation of w - K (x - u) by the noise of the sensors."""
    return np.hypot(sensor_std[3:], stiffness * sensor_std[:3])


def _orders(rows: Rows) -> dict[tuple[str, str], Rows]:
    """The rows in other orders, with what was wrong with them then."""
    found = {}
    for moved, name in enumerate(("commands", "poses", "wrenches")):
        for late, when in ((True, "before"), (False, "after")):
            own, others = (slice(1, None), slice(-1)) if late else (slice(-1), slice(1, None))
            told = f"each row seems to hold the {name} of the row {when} it"
            remedy = f"move the {name} one row {'up' if late else 'down'}"
            found[told, remedy] = tuple(
                part[own if k == moved else others] for k, part in enumerate(rows)
            )
    for k, (first, second) in enumerate((("u_x", "u_z"), ("x", "z"), ("F_x", "F_z"))):
        swapped = rows[k][:, [1, 0, 2]]
        told = f"{first} and {second} seem to be swapped"
        found[told, "swap these columns"] = (*rows[:k], swapped, *rows[k + 1 :])
    commands, poses, wrenches = rows
    told = "commands seem to be relative to the pose of the row before"
    found[told, "add that pose to them"] = (commands[1:] + poses[:-1], poses[1:], wrenches[1:])
    return found


def _left(
    rows: Rows, stiffness: Float[np.ndarray, " 3"], scale: Float[np.ndarray, " 3"]
) -> float | None:
    """Part of the wrench, in its noise, that K (pose - command) leaves over in the rows in which
    one of the two is beyond the noise; None where these are few."""
    expected, felt = spring_wrench(rows[1], rows[0], stiffness) / scale, rows[2] / scale
    some = (np.maximum(np.abs(expected), np.abs(felt)) > BEYOND).any(1)
    if some.sum() < LEAST_ROWS:
        return None
    size = max(float(np.linalg.norm(part[some])) for part in (expected, felt))
    return float(np.linalg.norm((felt - expected)[some])) / size
